"""Where each cartilage ends on both clouds: what tells how far along itself it must move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from study.errors import StudyError
from study.types import CARTILAGES, Floats, PointCloud

_OUTER_SHARE = 0.04  # of a branch's points that are its end


@dataclass(frozen=True)
class BranchEnds:
    """Soft equations: the outer end of a CT branch comes to lie as far out as that of the US branch.

    Along a smooth tube the surface itself holds nothing. A strip that the sweep missed may hide the US end, though,
    and so a pull inwards counts less than one outwards.

    Attributes:
        outwards_mm: standard deviation of an equation that pulls outwards.
        inwards_mm: of one that pulls inwards.
    """

    outwards_mm: float = 1.5
    inwards_mm: float = 2.5

    def __post_init__(self) -> None:
        if not (self.outwards_mm > 0 and self.inwards_mm > 0):
            raise StudyError(
                f"branch ends: expected standard deviations > 0, got {self.outwards_mm} and {self.inwards_mm} mm; "
                "large ones switch the ends off"
            )

    def precisions(self, pull_mm: Floats) -> Floats:
        """Weights (e,) mm⁻² of equations that pull outwards by (e,) mm."""
        weights: Floats = np.where(pull_mm > 0, self.outwards_mm, self.inwards_mm) ** -2.0
        return weights


def branch_ends(chest: PointCloud) -> Floats:
    """The outer end (8, 3) mm of each cartilage, by part: the mean of the outermost of its points.

    Args:
        chest: labelled, in chest coordinates: a branch reaches outwards along the first.

    Raises:
        StudyError: a cartilage without points.
    """
    ends = []
    for part in CARTILAGES:
        branch = chest.only(part)
        if not len(branch):
            raise StudyError(f"{chest.name}: expected points on every cartilage, got none on {part.name}")
        out = np.abs(branch[:, 0])
        ends.append(branch[out >= np.quantile(out, 1 - _OUTER_SHARE)].mean(axis=0))
    return np.array(ends)
