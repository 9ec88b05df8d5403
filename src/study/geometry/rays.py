"""Rays and points against a triangle surface: what a beam meets first, and how far a point lies from the surface."""

from __future__ import annotations

from typing import Any

import numpy as np

from study.types import Floats, Ints, Mesh


def first_hits(mesh: Mesh, origins: Floats, directions: Floats) -> tuple[Floats, Ints]:
    """What rays meet first of a surface.

    Args:
        mesh: the surface, mm, normals outwards.
        origins: (n, 3) mm, in the mesh's frame.
        directions: (n, 3), of any length.

    Returns:
        distance (n,) in lengths of the direction, infinite for no hit or one from inside; face (n,), -1 likewise.
    """
    scene, rays = _scene_and_query(mesh, origins, directions)
    answer = scene.cast_rays(rays, nthreads=1)
    distance = answer["t_hit"].numpy().astype(np.float64)
    face = answer["primitive_ids"].numpy().astype(np.int64)
    # A beam that meets a face from behind began inside the body part: it saw no surface.
    seen = np.isfinite(distance) & (np.einsum("ni,ni->n", answer["primitive_normals"].numpy(), directions) < 0)
    return np.where(seen, distance, np.inf), np.where(seen, face, -1)


def surface_distance_mm(points: Floats, mesh: Mesh) -> Floats:
    """Distance (n,) mm from points (n, 3) mm to the triangles of a surface in the same frame, 0 or more."""
    scene, query = _scene_and_query(mesh, points)
    distance: Floats = scene.compute_distance(query, nthreads=1).numpy().astype(np.float64)
    return distance


def _scene_and_query(mesh: Mesh, points: Floats, *more: Floats) -> tuple[Any, Any]:
    """Open3D's ray-casting scene of a surface, and the rows to ask it about: points, then any other columns."""
    import open3d as o3d  # takes seconds to import, and most users of sweeps cast no ray

    # Open3D computes in single precision: near the origin of coordinates that is 1e-5 mm, elsewhere it may not be.
    centre = mesh.vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor((mesh.vertices - centre).astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32))
    )
    query = np.concatenate([np.asarray(points) - centre, *more], axis=1).astype(np.float32)
    return scene, o3d.core.Tensor(query)
