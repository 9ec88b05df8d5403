"""The mesh that non-rigid ICP bends, by Open3D and trimesh; `study.methods.nonrigid_icp` imports it on first use."""

# mypy: disable-error-code="no-untyped-call"
# trimesh is typed in part.

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import open3d as o3d
import trimesh
from scipy.spatial import KDTree

from study.errors import StudyError
from study.geometry.points import farthest_points, sample_spacing_mm
from study.types import Floats, Ints

_NORMAL_NEIGHBOURS = 10
_BALL_RADII = (1.0, 1.5, 2.0)  # in spacings: small ones first, so that no ball rolls over an intercostal gap


def surface_through(points: Floats, max_vertices: int, min_piece: int, name: str) -> tuple[Floats, Ints]:
    """Vertices (v, 3) and faces (f, 3) of a surface through evenly spread ``points`` (n, 3).

    Args:
        points: (n, 3) mm.
        max_vertices: how many of them to join.
        min_piece: vertices of a connected piece; smaller ones are left out.
        name: of the cloud, for messages.

    Raises:
        StudyError: fewer than half of the vertices lie on such a piece.
    """
    vertices = points[farthest_points(points, max_vertices)]
    faces = _ball_pivoting(vertices)
    kept = _large_pieces(faces, min_piece)
    if len(kept) < len(vertices) / 2:
        raise StudyError(
            f"nonrigid_icp: expected {name!r} to be points of a surface, got triangles for {len(kept)} of "
            f"{len(vertices)}; thin out noise, or raise max_vertices"
        )
    row = np.full(len(vertices), -1)
    row[kept] = np.arange(len(kept))
    faces = row[faces]
    return vertices[kept], faces[(faces >= 0).all(axis=1)]


def _ball_pivoting(vertices: Floats) -> Ints:
    """Triangles (f, 3) on which balls rolling over ``vertices`` (v, 3) come to rest, wound outwards."""
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
    return np.array(mesh.triangles, dtype=np.int64).reshape(-1, 3)


def _large_pieces(faces: Ints, min_piece: int) -> Ints:
    """Numbers (k,) of the vertices on pieces of ``min_piece`` vertices or more, in order."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pieces = trimesh.graph.connected_components(edges, min_len=min_piece) if len(edges) else []
    return np.sort(np.concatenate([*pieces, np.empty(0, dtype=np.int64)]).astype(np.int64))


def piece_of_each(faces: Ints, n_vertices: int) -> Ints:
    """The number of the connected piece that each of ``n_vertices`` lies on."""
    pieces: Ints = trimesh.graph.connected_component_labels(faces[:, [0, 1, 1, 2]].reshape(-1, 2), n_vertices)
    return pieces


def amberg(
    vertices: Floats,
    faces: Ints,
    target: Floats,
    *,
    steps: Sequence[tuple[float, float, float, int]],
    eps: float,
    gamma: float,
    distance_threshold: float,
    neighbors_count: int,
) -> list[Floats]:
    """trimesh's optimal-step non-rigid ICP of a mesh to ``target`` points (n, 3).

    Returns:
        vertices (v, 3) before and after every iteration.
    """
    with _no_collection():
        records: list[Floats] = trimesh.registration.nricp_amberg(
            trimesh.Trimesh(vertices, faces, process=False),
            trimesh.PointCloud(target),
            steps=steps,
            eps=eps,
            gamma=gamma,
            distance_threshold=distance_threshold,
            use_faces=False,  # the target is points
            neighbors_count=neighbors_count,
            return_records=True,
        )
    return records


@contextmanager
def _no_collection() -> Iterator[None]:
    """trimesh makes a list a row of its equations; looking for rubbish among them is two thirds of its time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def carry(displacements: Floats, vertices: Floats, faces: Ints, points: Floats) -> Floats:
    """Displacement (n, 3) of each of ``points`` from its closest place on the mesh, barycentric."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    closest, _, triangle = trimesh.proximity.closest_point(mesh, points)
    weights = trimesh.triangles.points_to_barycentric(vertices[faces[triangle]], closest)
    carried: Floats = np.einsum("nk,nki->ni", weights, displacements[faces[triangle]])
    return carried
