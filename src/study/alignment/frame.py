"""The frame of a labelled chest: where its sternum lies, where its cartilages leave it and how far they reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from study.errors import StudyError
from study.types import CARTILAGES, Floats, Part, PointCloud, RigidTransform


@dataclass(frozen=True)
class ChestFrame:
    """Where the sternum lies in a cloud: the frame in which the template is drawn.

    Attributes:
        origin: (3,) mm, centre of the sternum.
        left, up, front: (3,) unit vectors, orthogonal; left is the patient's, so left × up = front.
        width_mm: sternum along ``left``.
        root_mm: height of each cartilage's root along ``up``, by part.
        reach_mm: how far each cartilage extends from the sternum's edge along ``left``, by part.
    """

    origin: Floats
    left: Floats
    up: Floats
    front: Floats
    width_mm: float
    root_mm: Mapping[Part, float]
    reach_mm: Mapping[Part, float]

    @property
    def T_cloud_chest(self) -> RigidTransform:
        """Chest coordinates (left, up, front) to the cloud's own frame."""
        return RigidTransform(np.column_stack([self.left, self.up, self.front]), self.origin)


def chest_frame(cloud: PointCloud) -> ChestFrame:
    """The frame the template graph is drawn in (sec. III-B), from a labelled cloud.

    Args:
        cloud: (n, 3) mm with ``parts``, any frame.

    Raises:
        StudyError: a cloud without parts, or with fewer than 3 points on one.
    """
    missing = [part.name for part in (Part.STERNUM, *CARTILAGES) if len(cloud.only(part)) < 3]
    if missing:
        raise StudyError(f"{cloud.name}: expected points on every part, got none on {', '.join(missing)}")
    sternum = cloud.only(Part.STERNUM)
    origin = sternum.mean(axis=0)
    left, up = _left_and_up(cloud, sternum - origin)
    x = (sternum - origin) @ left
    x0, x1 = np.percentile(x, [2, 98])
    origin = origin + (x0 + x1) / 2 * left
    half_width = (x1 - x0) / 2
    root, reach = {}, {}
    for part in CARTILAGES:
        away = cloud.only(part) - origin
        lateral = np.abs(away @ left)
        medial = lateral <= np.percentile(lateral, 15)
        root[part] = float((away @ up)[medial].mean())
        reach[part] = float(np.percentile(lateral, 98) - half_width)
    return ChestFrame(origin, left, up, np.cross(left, up), float(x1 - x0), root, reach)


def _left_and_up(cloud: PointCloud, sternum: Floats) -> tuple[Floats, Floats]:
    """Unit vectors to the patient's left and along the centred sternum (n, 3) to the head, orthogonal."""
    centre = {part: cloud.only(part).mean(axis=0) for part in CARTILAGES}
    left = np.mean([centre[p] - centre[q] for p, q in zip(CARTILAGES[4:], CARTILAGES[:4], strict=True)], axis=0)
    up = np.linalg.svd(sternum, full_matrices=False)[2][0]
    heads = np.mean([centre[p] for p in CARTILAGES if p.level == 2], axis=0)
    feet = np.mean([centre[p] for p in CARTILAGES if p.level == 5], axis=0)
    up = up * np.sign(up @ (heads - feet))
    left = left - (left @ up) * up
    left /= np.linalg.norm(left)
    return left, up
