"""People between two synthetic people, and beyond: one deformation in several sizes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from study.errors import StudyError
from study.geometry.points import fit_rigid
from study.phantom.deformation import INVERSE_TOLERANCE_MM, Deformation
from study.phantom.subject import SyntheticSubject
from study.phantom.surface import canonical_surface
from study.types import Floats, RigidTransform

MAX_ROUNDS = 200  # of the inverse


@dataclass(frozen=True)
class Between:
    """``(1 - share) start(p) + share T end(p)``: a straight way from one map of space to another.

    Attributes:
        start, end: the two maps.
        T_start_end: rigid motion that takes the end's frame nearest to the start's.
        share: 0 is the start, 1 the end, more is beyond it.
    """

    start: Deformation
    end: Deformation
    T_start_end: RigidTransform
    share: float

    def apply(self, points: Floats) -> Floats:
        """Map (n, 3) mm."""
        moved: Floats = (1 - self.share) * self.start.apply(points)
        return moved + self.share * self.T_start_end.apply(self.end.apply(points))

    def inverse(self, points: Floats) -> Floats:
        """Undo `apply` by fixed-point steps through the start's own inverse.

        Raises:
            StudyError: a map so far from its start that the steps do not come to rest.
        """
        found = self.start.inverse(points)
        for _ in range(MAX_ROUNDS):
            missed = points - self.apply(found)
            if np.abs(missed).max(initial=0.0) < INVERSE_TOLERANCE_MM:
                return found
            found = self.start.inverse(self.start.apply(found) + missed)
        raise StudyError(f"expected a map that can be undone, got a share of {self.share:g}; take less of the way")


def between(start: SyntheticSubject, end: SyntheticSubject, share: float) -> SyntheticSubject:
    """The person a ``share`` of the way from one to another, in the pose of the first; beyond the other above 1.

    Args:
        start: who the way begins at: 0.
        end: who it leads to: 1. Their name and tissue are kept.
        share: 0 or more; people differ by 1, and beyond 2 cartilages may cross.

    Raises:
        StudyError: a share that is negative or not finite.
    """
    if not 0 <= share < np.inf:
        raise StudyError(f"expected a share of 0 or more, got {share}; 1 is the other person")
    vertices = canonical_surface().vertices
    T_start_end = fit_rigid(end.phi.apply(vertices), start.phi.apply(vertices))
    return replace(end, phi=Deformation((Between(start.phi, end.phi, T_start_end, share),)))
