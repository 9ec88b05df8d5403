"""Every picture of the study: arrays, nouns and tables in, a figure out.

Nothing here runs a method or touches a disk; a notebook shows a figure that a cell returns, `png` gives its bytes.
Each module names what it shares in its own ``__all__``, the only list there is: a new figure is named there.
"""
# ruff: noqa: F403

from study.figures import (
    alignment,
    anatomy,
    canvas,
    clouds,
    comparisons,
    controls,
    distributions,
    evidence,
    graphs,
    landmarks,
    registration,
    style,
    ultrasound,
)
from study.figures.alignment import *
from study.figures.anatomy import *
from study.figures.canvas import *
from study.figures.clouds import *
from study.figures.comparisons import *
from study.figures.controls import *
from study.figures.distributions import *
from study.figures.evidence import *
from study.figures.graphs import *
from study.figures.landmarks import *
from study.figures.registration import *
from study.figures.style import *
from study.figures.ultrasound import *

__all__ = [
    *alignment.__all__,
    *anatomy.__all__,
    *canvas.__all__,
    *clouds.__all__,
    *comparisons.__all__,
    *controls.__all__,
    *distributions.__all__,
    *evidence.__all__,
    *graphs.__all__,
    *landmarks.__all__,
    *registration.__all__,
    *style.__all__,
    *ultrasound.__all__,
]
