"""Distances between clouds (sec. IV-A, Eq. 5) and errors of corresponding points (sec. IV-B), mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from study.errors import StudyError
from study.geometry.points import nearest
from study.types import Floats, as_points


def directed_distances_mm(a: Floats, b: Floats) -> Floats:
    """Distance (n,) mm of each of ``a``, (n, 3) mm, to its nearest of ``b``, (m, 3) mm.

    Raises:
        StudyError: an array that is empty, not (n, 3) or not finite.
    """
    return nearest(as_points(a, "first cloud"), as_points(b, "second cloud"))[0]


@dataclass(frozen=True)
class CloudDistances:
    """The directed distances between two clouds, from which every measure of their likeness follows.

    Attributes:
        forth: (n,) mm, each point of the first cloud to the nearest of the second.
        back: (m,) mm, the other way round.
    """

    forth: Floats
    back: Floats

    @classmethod
    def between(cls, a: Floats, b: Floats) -> CloudDistances:
        """Those of ``a`` (n, 3) mm and ``b`` (m, 3) mm."""
        return cls(directed_distances_mm(a, b), directed_distances_mm(b, a))

    @property
    def hausdorff_mm(self) -> float:
        """Hausdorff distance of all points (Eq. 5)."""
        return float(max(self.forth.max(), self.back.max()))  # Eq. 5

    @property
    def hd95_mm(self) -> float:
        """The larger of the two directions' 95th percentiles."""
        return float(max(np.percentile(self.forth, 95), np.percentile(self.back, 95)))

    @property
    def mean_mm(self) -> float:
        """Mean of both directions' means: both clouds count the same, however many points they have."""
        return float((self.forth.mean() + self.back.mean()) / 2)


def hausdorff_mm(a: Floats, b: Floats) -> float:
    """Hausdorff distance of all points of two clouds, (n, 3) and (m, 3) mm (Eq. 5)."""
    return CloudDistances.between(a, b).hausdorff_mm


def sampling_floor_mm(points: Floats, n_points: int, rng: np.random.Generator, n_draws: int = 10) -> float:
    """Hausdorff distance of two draws of the same surface, mm: no method can be told from a perfect one below it.

    Args:
        points: (n, 3) mm, a dense cloud of the surface.
        n_points: points a draw, at most n / 2 as the two draws share none.
        rng: source of the draws.
        n_draws: pairs of draws to average.

    Raises:
        StudyError: fewer than ``2 * n_points`` points.
    """
    points = as_points(points, "surface")
    if not 1 <= n_points <= len(points) // 2:
        raise StudyError(
            f"expected two draws of {n_points} points without a shared one, got {len(points)} points; "
            f"draw at most {len(points) // 2}, or sample the surface more densely"
        )
    floors = []
    for _ in range(n_draws):
        rows = rng.permutation(len(points))[: 2 * n_points]
        floors.append(hausdorff_mm(points[rows[:n_points]], points[rows[n_points:]]))
    return float(np.mean(floors))


def point_errors_mm(
    points: Floats, reference: Floats, plane_normal: ArrayLike | None = None, *, depth: bool = False
) -> Floats:
    """Distance (k,) mm of corresponding rows of (k, 3) mm; with ``plane_normal`` (3,) its part in that plane.

    Both clouds' antero-posterior error is half a cartilage where CT shows a tube and ultrasound its front, so the
    part in the feature plane is what a method can be judged by.

    Args:
        points: (k, 3) mm.
        reference: (k, 3) mm, row i belongs to ``points[i]``.
        plane_normal: (3,) of the plane, of any length.
        depth: the part along ``plane_normal`` instead, without its sign.

    Raises:
        StudyError: rows that do not pair, values that are not finite, a normal without direction.
    """
    points, reference = as_points(points, "points"), as_points(reference, "reference points")
    if points.shape != reference.shape:
        raise StudyError(f"expected one reference per point, got {points.shape} and {reference.shape}")
    offsets = points - reference
    if plane_normal is None and depth:
        raise StudyError("expected a plane normal to measure depth along, got none; pass that of the feature plane")
    if plane_normal is not None:
        normal = np.asarray(plane_normal, dtype=np.float64)
        length = float(np.linalg.norm(normal))
        if normal.shape != (3,) or not np.isfinite(length) or length == 0:
            raise StudyError(f"expected a plane normal of shape (3,) and some length, got {normal!r}")
        if depth:
            return np.abs(offsets @ (normal / length))
        offsets = offsets - np.outer(offsets @ (normal / length), normal / length)
    lengths: Floats = np.linalg.norm(offsets, axis=1)
    return lengths


def waypoint_errors_mm(
    transferred: Floats, reference: Floats, plane_normal: ArrayLike | None = None, *, depth: bool = False
) -> Floats:
    """Error (k,) mm of transferred waypoints against those defined on the target (sec. IV-B); see `point_errors_mm`."""
    return point_errors_mm(transferred, reference, plane_normal, depth=depth)
