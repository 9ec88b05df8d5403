"""The surface of a mask of parts, and the cloud sampled from it (sec. II-C.1: volume → parts → surface → cloud)."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from skimage.measure import marching_cubes

from study.errors import StudyError
from study.geometry.points import nearest
from study.types import Mesh, Part, PointCloud, Volume

DISC_TO_LATTICE = 0.79  # mean gap of Open3D's Poisson discs over that of a triangular lattice of as many points


def surface(mask: Volume, smooth_mm: float = 1.0) -> Mesh:
    """The outer surface of a mask of parts.

    The mask becomes a signed distance, smoothed before marching cubes: thick slices leave no steps, and unlike a
    smoothed 0/1 mask it keeps thin cartilage from shrinking.

    Args:
        mask: `Part` values, `Part.UNKNOWN` outside.
        smooth_mm: standard deviation of the Gaussian.

    Returns:
        closed triangles in RAS+ mm with the nearest voxel's part a vertex.

    Raises:
        StudyError: an empty mask.
    """
    inside = np.pad(mask.values > Part.UNKNOWN, 3)
    if not inside.any():
        raise StudyError(f"{mask.name}: expected voxels of sternum and cartilages, got an empty mask; check the labels")
    spacing = mask.spacing_mm
    field = ndimage.distance_transform_edt(inside, sampling=spacing)
    field -= ndimage.distance_transform_edt(~inside, sampling=spacing)
    field = ndimage.gaussian_filter(field, smooth_mm / spacing)
    vertices, faces, _, _ = marching_cubes(field, level=0.0, spacing=tuple(spacing), gradient_direction="ascent")
    vertices = mask.T_ras_index.apply(vertices.astype(np.float64) - 3 * spacing)
    labelled = np.argwhere(inside) - 3
    _, index = nearest(vertices, mask.to_mm(labelled))
    parts = np.asarray(mask.values[tuple(labelled[index].T)], dtype=np.int64)
    return Mesh(vertices, faces.astype(np.int64), parts, mask.name)


def sample_cloud(mesh: Mesh, n_points: int, rng: np.random.Generator) -> PointCloud:
    """Poisson-disc sampling of a surface (sec. II-C.1), labelled by the nearest vertex.

    Args:
        mesh: the surface.
        n_points: how many; `points_for_spacing` turns a distance into a number.
        rng: gives Open3D's seed.

    Raises:
        StudyError: ``n_points`` below 50.
    """
    import open3d as o3d  # slow to import; its objects stay in here

    if n_points < 50:
        raise StudyError(f"{mesh.name}: expected at least 50 points, got {n_points}")
    triangles = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.copy()),  # Open3D wants writeable arrays
        o3d.utility.Vector3iVector(mesh.faces.astype(np.int32)),
    )
    o3d.utility.random.seed(int(rng.integers(2**31)))
    points = np.asarray(triangles.sample_points_poisson_disk(n_points, init_factor=5).points).copy()
    _, index = nearest(points, mesh.vertices)
    return PointCloud(points, mesh.name, mesh.parts[index])


def points_for_spacing(mesh: Mesh, spacing_mm: float) -> int:
    """How many Poisson-disc points have their nearest neighbour ``spacing_mm`` away on average.

    Raises:
        StudyError: a spacing that is not positive.
    """
    if not spacing_mm > 0:
        raise StudyError(f"expected a positive spacing, got {spacing_mm} mm")
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    return int(np.ceil(area / (np.sqrt(3) / 2 * (spacing_mm / DISC_TO_LATTICE) ** 2)))
