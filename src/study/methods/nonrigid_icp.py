"""Optimal-step non-rigid ICP (Amberg et al.), a baseline of sec. IV, by trimesh."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter
from typing import ClassVar

import numpy as np
import open3d as o3d
import trimesh
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from study.errors import StudyError
from study.geometry import farthest_points, principal_axes, sample_spacing_mm
from study.types import Floats, Ints, PointCloud, Registration, RigidTransform

Step = tuple[float, float, float, int]  # smoothness, landmark weight, exponent of the normals' cosine, iterations

_NORMAL_NEIGHBOURS = 10
_BALL_RADII = (1.0, 1.5, 2.0)  # in spacings: small ones first, so that no ball rolls over an intercostal gap
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

    steps: tuple[Step, ...] = (
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
        if not self.steps or self.steps[-1][2] != 0:
            raise StudyError("nonrigid_icp: expected a last step with normal exponent 0; convergence is judged there")
        if self.max_vertices < _MIN_PIECE or self.distance_threshold <= 0:
            raise StudyError(
                f"nonrigid_icp: expected max_vertices >= {_MIN_PIECE} and distance_threshold > 0, "
                f"got {self.max_vertices} and {self.distance_threshold}"
            )

    @classmethod
    def tuned(cls) -> NonrigidIcp:
        """The best row of ``results/tuning/nonrigid_icp.csv``, found on development subjects by tools/tune.py."""
        return cls(
            steps=((0.003, 10, 0.5, 10), (0.006, 5, 0.5, 10), (0.009, 2.5, 0.5, 10), (0.003, 0, 0.0, 10)), gamma=30.0
        )

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """Bend ``source`` onto ``target``; nothing is drawn from ``rng``.

        ``history`` is the mean distance of the vertices to their partners after each iteration, mm.

        Raises:
            StudyError: the source points form no surface, or the equations have no solution.
        """
        start = perf_counter()
        # trimesh measures in boxes along the axes; in the source's own axes its numbers mean the same in every pose.
        centre, axes = principal_axes(source.points)
        moving, fixed = (source.points - centre) @ axes.T, (target.points - centre) @ axes.T
        with threadpool_limits(limits=1):  # sums of a threaded BLAS depend on the number of threads
            vertices, faces = _surface(moving, self.max_vertices, source.name)
            self._require_partners(vertices, faces, fixed, source.name)
            records = self._bend(trimesh.Trimesh(vertices, faces, process=False), fixed)
            if not np.isfinite(records[-1]).all():
                raise StudyError(
                    f"nonrigid_icp: expected a solution for {source.name!r}, got NaN; "
                    "raise distance_threshold or the smoothness in steps"
                )
            warped = moving + _carry(records[-1] - vertices, vertices, faces, moving)
        diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        history = _residuals(records, fixed, self.distance_threshold * diagonal)
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
            seconds=perf_counter() - start,
            method=self.name,
            extras={"n_vertices": len(vertices), "n_faces": len(faces)},
        )

    def _require_partners(self, vertices: Floats, faces: Ints, target: Floats, name: str) -> None:
        """Refuse a piece of surface that nothing holds: its equations are singular and their solution arbitrary."""
        piece = trimesh.graph.connected_component_labels(faces[:, [0, 1, 1, 2]].reshape(-1, 2), len(vertices))
        near = KDTree(target).query(vertices)[0] <= self.distance_threshold * np.linalg.norm(np.ptp(vertices, axis=0))
        held = np.bincount(piece, weights=near)
        if held.min() < _MIN_HELD:
            raise StudyError(
                f"nonrigid_icp: expected every piece of {name!r} to have target points within reach, "
                f"got {held.min():.0f} vertices of one; check the coarse alignment or raise distance_threshold"
            )

    def _bend(self, mesh: trimesh.Trimesh, target: Floats) -> list[Floats]:
        return trimesh.registration.nricp_amberg(
            mesh,
            trimesh.PointCloud(target),
            steps=self.steps,
            eps=self.eps,
            gamma=self.gamma,
            distance_threshold=self.distance_threshold,
            use_faces=False,  # the target is points
            neighbors_count=self.neighbors_count,
            return_records=True,
        )


def _residuals(records: list[Floats], target: Floats, threshold: float) -> tuple[float, ...]:
    """The library's own error after each iteration (where its normals have no say), which it keeps to itself."""
    tree = KDTree(target)
    errors = []
    for before, after in pairwise(records):
        distance, partner = tree.query(before)
        errors.append(float((np.linalg.norm(target[partner] - after, axis=1) * (distance <= threshold)).mean()))
    return tuple(errors)


def _surface(points: Floats, max_vertices: int, name: str) -> tuple[Floats, Ints]:
    """Vertices (v, 3) and faces (f, 3) of a surface through evenly spread ``points``, each piece large enough."""
    vertices = points[farthest_points(points, max_vertices)]
    tree = KDTree(vertices)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(vertices))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
    cloud.orient_normals_consistent_tangent_plane(_NORMAL_NEIGHBOURS)
    # That leaves one sign open, and it would depend on the pose: a bulge's middle lies below its surface.
    normals = np.asarray(cloud.normals)
    middles = vertices[tree.query(vertices, k=min(4 * _NORMAL_NEIGHBOURS, len(vertices)))[1]].mean(axis=1)
    if np.einsum("ni,ni->", normals, vertices - middles) < 0:
        cloud.normals = o3d.utility.Vector3dVector(-normals)
    radii = o3d.utility.DoubleVector([sample_spacing_mm(vertices) * radius for radius in _BALL_RADII])
    mesh = o3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii)
    faces = np.array(mesh.triangles, dtype=np.int64).reshape(-1, 3)

    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pieces = trimesh.graph.connected_components(edges, min_len=_MIN_PIECE) if len(edges) else []
    kept = np.sort(np.concatenate([*pieces, np.empty(0, dtype=np.int64)]).astype(np.int64))
    if len(kept) < len(vertices) / 2:
        raise StudyError(
            f"nonrigid_icp: expected {name!r} to be points of a surface, got triangles for {len(kept)} of "
            f"{len(vertices)}; thin out noise, or raise max_vertices"
        )
    row = np.full(len(vertices), -1)
    row[kept] = np.arange(len(kept))
    faces = row[faces]
    return vertices[kept], faces[(faces >= 0).all(axis=1)]


def _carry(displacements: Floats, vertices: Floats, faces: Ints, points: Floats) -> Floats:
    """Displacement (n, 3) of each of ``points`` from its closest place on the mesh, barycentric."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    closest, _, triangle = trimesh.proximity.closest_point(mesh, points)
    weights = trimesh.triangles.points_to_barycentric(vertices[faces[triangle]], closest)
    return np.einsum("nk,nki->ni", weights, displacements[faces[triangle]])
