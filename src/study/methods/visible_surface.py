"""A method on the part of the CT surface that ultrasound can see."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from study.alignment.frame import ChestFrame, chest_frame
from study.errors import StudyError
from study.geometry.points import foremost_in_cells, sample_spacing_mm
from study.registration import Method, Registration
from study.types import Bools, Floats, PointCloud


def faces_front(points: Floats, frame: ChestFrame, cell_mm: float = 4.0, depth_mm: float = 3.0) -> Bools:
    """Points (n,) that nothing else hides from the front: within ``depth_mm`` of the foremost of their cell.

    Args:
        points: (n, 3) mm.
        frame: the chest's left, up and front.
        cell_mm: edge of the cells across the view; wider where a sparse cloud would leave one point in each.
        depth_mm: how far behind the foremost point still counts.
    """
    local = frame.T_cloud_chest.inverse.apply(points)
    cell_mm = max(cell_mm, 2.5 * sample_spacing_mm(points))
    cells, foremost = foremost_in_cells(local, cell_mm)
    front: Bools = local[:, 2] > foremost[cells] - depth_mm
    return front


@dataclass(frozen=True)
class VisibleSurface:
    """Run ``method`` on the visible half of the tubes, then carry the hidden half along.

    CT gives a cartilage's whole surface, ultrasound only its front. Matching the whole tube to the visible sheet
    pulls every point back by about half a thickness; matching like with like does not.

    Attributes:
        method: what registers the visible points.
        neighbours: visible points whose rigid motion carries a hidden point; a method with a field needs none.
    """

    name: ClassVar[str] = "visible_surface"

    method: Method
    neighbours: int = 12

    def __post_init__(self) -> None:
        if not isinstance(self.method, Method):
            raise StudyError(
                f"visible_surface: expected a registration method, got {self.method!r}; pass an instance such as Icp()"
            )
        if not self.neighbours >= 3:
            raise StudyError(
                f"visible_surface: expected neighbours >= 3, got {self.neighbours}; fewer points fix no rotation"
            )

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """Register labelled, coarsely aligned clouds; the result is what ``method`` returns, on every source point.

        Raises:
            StudyError: fewer visible points than ``neighbours``, or what ``method`` raises.
        """
        seen = faces_front(source.points, chest_frame(source))
        if seen.sum() < self.neighbours:
            raise StudyError(
                f"{source.name}: expected {self.neighbours} visible points or more, got {seen.sum()}; "
                "pass a denser cloud or fewer neighbours"
            )
        result = self.method.register(source.subset(seen), target, rng)
        warped = np.empty_like(source.points)
        warped[seen] = result.warped
        warped[~seen] = result.carry(source.points[~seen], self.neighbours)
        return replace(result, source=source.points, warped=warped)
