"""Iterative closest point (Besl and McKay), the rigid baseline of sec. IV, by Open3D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from study.errors import StudyError
from study.geometry.points import principal_axes
from study.registration import Registration
from study.types import Floats, PointCloud, RigidTransform


@dataclass(frozen=True)
class Icp:
    """Rigid ICP; the defaults are Open3D's.

    Attributes:
        max_distance_mm: pairs farther apart are left out. Open3D has no default; the classic algorithm leaves no pair
            out, which is what 1 m means on a chest.
        point_to_plane: distances to the target's tangent planes instead of its points.
        max_iterations: limit of updates.
        relative_fitness: stop when the share of paired points changes by less, and
        relative_rmse: the paired points' root mean square distance changes by less than this, mm.
    """

    name: ClassVar[str] = "icp"

    max_distance_mm: float = 1000.0
    point_to_plane: bool = False
    max_iterations: int = 30
    relative_fitness: float = 1e-6
    relative_rmse: float = 1e-6

    def __post_init__(self) -> None:
        if not (self.max_distance_mm > 0 and self.max_iterations >= 1):
            raise StudyError(
                "icp: expected max_distance_mm > 0 and max_iterations >= 1, "
                f"got {self.max_distance_mm} and {self.max_iterations}; 1000 mm leaves no pair out"
            )
        if not (self.relative_fitness >= 0 and self.relative_rmse >= 0):
            raise StudyError(
                "icp: expected relative_fitness >= 0 and relative_rmse >= 0, "
                f"got {self.relative_fitness} and {self.relative_rmse}; 0 runs to the limit"
            )

    @classmethod
    def tuned(cls) -> Icp:
        """The best row of ``results/tuning/icp.csv``: the visible surface of development subjects, by tools/tune.py."""
        return cls(max_distance_mm=7.0, max_iterations=200)

    @classmethod
    def tuned_whole(cls) -> Icp:
        """The best row of ``results/tuning/icp_whole.csv``: the whole tube of the same subjects."""
        return cls(max_distance_mm=5.0, max_iterations=200)

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """Fit ``source`` to ``target`` rigidly; nothing is drawn from ``rng``.

        ``history`` is the root mean square distance of the paired points, mm.

        Raises:
            StudyError: no target point within ``max_distance_mm`` of any source point.
        """
        # Its point-to-plane update turns about the origin in small angles, so it runs in the source's own axes: the
        # answer does not depend on where a tracker has its origin.
        centre, axes = principal_axes(source.points)
        T_axes = RigidTransform(axes, -axes @ centre)
        matrix, history, converged = self._run(T_axes.apply(source.points), T_axes.apply(target.points))
        T_us_ct = T_axes.inverse @ RigidTransform.from_matrix(matrix) @ T_axes
        limit = f"iteration limit of {self.max_iterations} reached"
        return Registration(
            source=source.points,
            warped=T_us_ct.apply(source.points),
            T_us_ct=T_us_ct,
            converged=converged,
            n_iterations=len(history),
            stop_reason="share of pairs and their distance stopped changing" if converged else limit,
            history=tuple(history),
        )

    def _run(self, source: Floats, target: Floats) -> tuple[Floats, list[float], bool]:
        """Open3D's loop, one update a call: called once, it does not tell whether or when it converged."""
        import open3d as o3d  # takes seconds; who reads results by their method's name needs none of it

        registration = o3d.pipelines.registration
        moving, fixed = (
            o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(points))) for points in (source, target)
        )
        estimation = registration.TransformationEstimationPointToPoint()
        if self.point_to_plane:
            fixed.estimate_normals()
            estimation = registration.TransformationEstimationPointToPlane()
        once = registration.ICPConvergenceCriteria(max_iteration=1)

        state = registration.evaluate_registration(moving, fixed, self.max_distance_mm, np.eye(4))
        history: list[float] = []
        for _ in range(self.max_iterations):
            before = state
            state = registration.registration_icp(
                moving, fixed, self.max_distance_mm, before.transformation, estimation, once
            )
            if state.fitness == 0:
                raise StudyError(
                    f"icp: expected target points within {self.max_distance_mm:g} mm of the source, got none; "
                    "check the coarse alignment or raise max_distance_mm"
                )
            history.append(state.inlier_rmse)
            if (
                abs(state.fitness - before.fitness) < self.relative_fitness
                and abs(state.inlier_rmse - before.inlier_rmse) < self.relative_rmse
            ):
                return state.transformation, history, True
        return state.transformation, history, False
