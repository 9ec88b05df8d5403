"""Optimal-step non-rigid ICP (Amberg et al.), a baseline of sec. IV, by trimesh."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np
from scipy.spatial import KDTree

from study.errors import StudyError
from study.geometry.points import principal_axes
from study.registration import Registration
from study.types import Floats, Ints, PointCloud, RigidTransform

Stage = tuple[float, float, float, int]  # smoothness, landmark weight, exponent of the normals' cosine, iterations

_MIN_PIECE = 20  # vertices; smaller pieces of surface have too few partners to be fitted
_MIN_HELD = 4  # vertices with a partner that fix a piece's affine map


@dataclass(frozen=True)
class NonrigidIcp:
    """Amberg's N-ICP; the defaults are trimesh's.

    The algorithm moves a mesh, and a cloud has none: at most ``max_vertices`` source points, spread evenly, are joined
    by ball pivoting (it makes surface of tubes and of open sheets alike, and does not bridge the intercostal gaps as
    alpha shapes do or close the ends as Poisson reconstruction does). Every source point then takes the displacement
    of its place on that mesh.

    Attributes:
        steps: one row a stage: smoothness, landmark weight (unused), exponent of the normals' cosine, iterations.
        eps: a stage ends when its residual falls by less, and
        distance_threshold: partners farther apart are left out; both in units of the source mesh's box diagonal.
        gamma: weight of translation against rotation and skew.
        neighbors_count: target points that define a target normal.
        max_vertices: vertices of the source mesh.
    """

    name: ClassVar[str] = "nonrigid_icp"

    steps: tuple[Stage, ...] = (
        (0.01, 10, 0.5, 10),
        (0.02, 5, 0.5, 10),
        (0.03, 2.5, 0.5, 10),
        (0.01, 0, 0.0, 10),
    )
    eps: float = 1e-4
    distance_threshold: float = 0.1
    gamma: float = 1.0
    neighbors_count: int = 8
    max_vertices: int = 1500

    def __post_init__(self) -> None:
        for stage in self.steps:
            if not (len(stage) == 4 and stage[0] > 0 and stage[1] >= 0 and stage[2] >= 0 and stage[3] >= 1):
                raise StudyError(
                    "nonrigid_icp: expected steps of smoothness > 0, landmark weight >= 0, normal exponent >= 0 and "
                    f"iterations >= 1, got {stage}; NonrigidIcp().steps are trimesh's"
                )
        if not self.steps or self.steps[-1][2] != 0:
            raise StudyError(
                f"nonrigid_icp: expected a last step with normal exponent 0, got {self.steps[-1:]}; convergence is "
                "judged there"
            )
        if not (self.max_vertices >= _MIN_PIECE and self.distance_threshold > 0):
            raise StudyError(
                f"nonrigid_icp: expected max_vertices >= {_MIN_PIECE} and distance_threshold > 0, "
                f"got {self.max_vertices} and {self.distance_threshold}; a chest needs some 1000 vertices and 0.1"
            )
        if not (self.eps >= 0 and self.gamma > 0 and self.neighbors_count >= 3):
            raise StudyError(
                "nonrigid_icp: expected eps >= 0, gamma > 0 and neighbors_count >= 3, which span a plane, "
                f"got {self.eps}, {self.gamma} and {self.neighbors_count}; NonrigidIcp() has trimesh's own"
            )

    @classmethod
    def tuned(cls) -> NonrigidIcp:
        """The best row of ``results/tuning/nonrigid_icp.csv``: the visible surface of development subjects."""
        return cls(distance_threshold=0.05)

    @classmethod
    def tuned_whole(cls) -> NonrigidIcp:
        """The best row of ``results/tuning/nonrigid_icp_whole.csv``: the whole tube of the same subjects."""
        steps = ((0.003, 10, 0.5, 10), (0.006, 5, 0.5, 10), (0.009, 2.5, 0.5, 10), (0.003, 0, 0.0, 10))
        return cls(steps=steps, distance_threshold=0.05)

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """Bend ``source`` onto ``target``; nothing is drawn from ``rng``.

        ``history`` is the mean distance of the vertices to their partners after each iteration, mm.

        Raises:
            StudyError: the source points form no surface, or the equations have no solution.
        """
        # Open3D and trimesh take seconds to import; who reads results by their method's name needs neither.
        from study.methods.mesh import carry, piece_of_each, surface_through

        # trimesh measures in boxes along the axes; in the source's own axes its numbers mean the same in every pose.
        centre, axes = principal_axes(source.points)
        moving, fixed = (source.points - centre) @ axes.T, (target.points - centre) @ axes.T
        vertices, faces = surface_through(moving, self.max_vertices, _MIN_PIECE, source.name)
        diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        reach = self.distance_threshold * diagonal
        _require_partners(vertices, piece_of_each(faces, len(vertices)), fixed, reach, source.name)
        records = self._bend(vertices, faces, fixed, source.name)
        warped = moving + carry(records[-1] - vertices, vertices, faces, moving)
        history = _residuals(records, fixed, reach)
        converged = len(history) > 1 and history[-2] - history[-1] <= self.eps * diagonal
        stages = f"{len(self.steps)} stages done, residual "
        return Registration(
            source=source.points,
            warped=warped @ axes + centre,
            T_us_ct=RigidTransform(),
            converged=converged,
            n_iterations=len(history),
            stop_reason=stages + ("stopped falling" if converged else "still falling at the last one's limit"),
            history=history,
        )

    def _bend(self, vertices: Floats, faces: Ints, target: Floats, name: str) -> list[Floats]:
        """Vertices (v, 3) before and after every iteration."""
        from study.methods.mesh import amberg  # see `register`

        records = amberg(
            vertices,
            faces,
            target,
            steps=self.steps,
            eps=self.eps,
            gamma=self.gamma,
            distance_threshold=self.distance_threshold,
            neighbors_count=self.neighbors_count,
        )
        if not np.isfinite(records[-1]).all():
            raise StudyError(
                f"nonrigid_icp: expected a solution for {name!r}, got NaN; "
                "raise distance_threshold or the smoothness in steps"
            )
        return records


def _require_partners(vertices: Floats, pieces: Ints, target: Floats, reach_mm: float, name: str) -> None:
    """Refuse a piece of surface that nothing holds: its equations are singular and their solution arbitrary."""
    near = KDTree(target).query(vertices)[0] <= reach_mm
    held = np.bincount(pieces, weights=near)
    if held.min() < _MIN_HELD:
        raise StudyError(
            f"nonrigid_icp: expected every piece of {name!r} to have target points within reach, "
            f"got {held.min():.0f} vertices of one; check the coarse alignment or raise distance_threshold"
        )


def _residuals(records: list[Floats], target: Floats, threshold: float) -> tuple[float, ...]:
    """The library's own error after each iteration (where its normals have no say), which it keeps to itself."""
    tree = KDTree(target)
    errors = []
    for before, after in pairwise(records):
        distance, partner = tree.query(before)
        errors.append(float((np.linalg.norm(target[partner] - after, axis=1) * (distance <= threshold)).mean()))
    return tuple(errors)
