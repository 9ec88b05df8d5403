"""Rows of dots and bars: one a method, the same in every figure that compares methods on one axis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from study.evaluation.metrics import METRICS
from study.evaluation.statistics import population_sd
from study.figures.style import method_style
from study.types import Floats


def judged_by(metric: str) -> str:
    """A metric's title and, where its name does not tell, by whose judgement it is."""
    title = METRICS[metric].title if metric in METRICS else metric
    by_truth = metric.startswith(("true_", "registered_"))
    return title if by_truth or metric not in METRICS else f"{title}, by the paper's protocol"


def stripe_rows(ax: Axes, n: int) -> None:
    """Shade every other of ``n`` rows, so that the eye keeps to one."""
    for y in range(0, n, 2):
        ax.axhspan(y - 0.5, y + 0.5, color="#f3f3f3", lw=0, zorder=0)


def name_rows(ax: Axes, names: Sequence[str]) -> None:
    """Write the names at the left, the first on top."""
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)


def method_row(ax: Axes, y: float, values: Floats, method: str, **bar: Any) -> None:
    """A dot a value and, above them, mean ± population SD in the method's style; nothing where there is no value."""
    if not len(values):
        return
    style = method_style(method)
    ax.scatter(values, np.full(len(values), y + 0.2), s=8, c=style.colour, alpha=0.6, lw=0)
    bar |= {"mfc": style.face, "mec": style.edge, "ecolor": style.colour, "ms": 7, "capsize": 2.5}
    ax.errorbar(float(values.mean()), y - 0.08, xerr=population_sd(values), fmt=style.marker, **bar)


def spread(n: int, width: float) -> Floats:
    """(n,) offsets within ± half of ``width`` that keep dots apart: even, and the same every time."""
    return np.asarray(((np.arange(n) * 0.618) % 1 - 0.5) * width)
