"""The two ways in which files count x and y: RAS, as here, and LPS, as those of DICOM, ITK and 3D Slicer."""

from __future__ import annotations

from typing import Literal, cast

import numpy as np

from study.errors import StudyError
from study.types import Floats

Space = Literal["RAS", "LPS"]

LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0])  # half a turn about z, and its own inverse


def as_space(text: str, where: str) -> Space:
    """What a file calls its space.

    Raises:
        StudyError: neither RAS nor LPS.
    """
    if text.upper() not in ("RAS", "LPS"):
        raise StudyError(f"{where}: expected the space RAS or LPS, got {text!r}; export it in one of them")
    return cast(Space, text.upper())


def to_ras(points: Floats, space: Space) -> Floats:
    """Points (..., 3) of a file in ``space`` in RAS; of RAS points their places in ``space`` too."""
    return points if space == "RAS" else points * np.diag(LPS_TO_RAS)
