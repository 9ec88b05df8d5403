"""The skin over an anatomy that has none: the surface a probe is moved on."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import distance_transform_edt, gaussian_filter, maximum_filter

from study.errors import StudyError
from study.geometry.points import unit
from study.geometry.rays import first_hits
from study.types import Floats, Mesh

MARGIN_MM = 60.0  # of skin beside the anatomy, so that lines may run past it


class Skin:
    """A smooth skin over an anatomy, as a height over the frontal plane.

    Attributes:
        axes: (3, 3), rows left-right a, up b and front c of the plane, right-handed, in the mesh's frame.
        low: (3,) mm, least a, b and c of the anatomy.
        high: (3,) mm, largest.

    Args:
        mesh: the anatomy, mm.
        front: (3,) direction towards the skin, in the mesh's frame.
        up: (3,) direction towards the head; made perpendicular to ``front``.
        skin_mm: tissue in front of the most prominent bone around.
        step_mm: edge of the grid on which the height is known.

    Raises:
        StudyError: directions that are none or nearly parallel, or a surface that is not seen from the front.
    """

    def __init__(self, mesh: Mesh, front: ArrayLike, up: ArrayLike, skin_mm: float, step_mm: float = 2.0) -> None:
        self.axes = _frontal_axes(front, up)
        local = mesh.vertices @ self.axes.T
        self.low, self.high = local.min(axis=0), local.max(axis=0)
        grid = [np.arange(self.low[i] - MARGIN_MM, self.high[i] + MARGIN_MM + step_mm, step_mm) for i in range(2)]
        skin = _drape(_bone_height(mesh, self.axes, grid, self.high[2] + 10.0), skin_mm, step_mm)
        # A hand does not follow every dent: the probe's tilt is that of a smoother skin.
        slopes = np.gradient(gaussian_filter(skin, 10.0 / step_mm, mode="nearest"), step_mm)
        self._height, self._slope_a, self._slope_b = (
            RegularGridInterpolator(grid, values, bounds_error=False, fill_value=None) for values in (skin, *slopes)
        )

    def points(self, ab: Floats) -> tuple[Floats, Floats]:
        """Skin points (n, 3) mm and outward normals (n, 3) over plane positions (n, 2) mm, in the mesh's frame."""
        local = np.column_stack([ab, self._height(ab)])
        normals = np.column_stack([-self._slope_a(ab), -self._slope_b(ab), np.ones(len(ab))])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        return local @ self.axes, normals @ self.axes


def _frontal_axes(front: ArrayLike, up: ArrayLike) -> Floats:
    """Rows left-right, up and front (3, 3) of the frontal plane."""
    c = unit(front, "front")
    b = unit(up, "up")
    if abs(b @ c) > 0.9:
        raise StudyError(f"expected up and front at an angle, got {b} and {c}; give the direction of the head as up")
    b = unit(b - (b @ c) * c, "up")
    return np.stack([np.cross(b, c), b, c])


def _bone_height(mesh: Mesh, axes: Floats, grid: list[Floats], above: float) -> Floats:
    """Height (na, nb) mm of the anatomy over a grid of the plane, that of the nearest bone where there is none."""
    A, B = np.meshgrid(*grid, indexing="ij")
    origins = np.column_stack([A.ravel(), B.ravel(), np.full(A.size, above)]) @ axes
    distance, _ = first_hits(mesh, origins, np.broadcast_to(-axes[2], origins.shape))
    height = (above - distance).reshape(A.shape)
    hit = np.isfinite(height)
    if not hit.any():
        raise StudyError(
            f"{mesh.name}: expected a surface to be seen from the front {axes[2]}, got none; is it inside out?"
        )
    rows, columns = distance_transform_edt(~hit, return_distances=False, return_indices=True)
    filled: Floats = height[rows, columns]
    return filled


def _drape(bone: Floats, skin_mm: float, step_mm: float) -> Floats:
    """Height (na, nb) mm of a smooth skin over that of the bone."""
    smooth = gaussian_filter(bone, 15.0 / step_mm, mode="nearest")
    # Whatever stands out of the smooth surface lifts the skin around it, so that tissue covers every bone.
    proud = maximum_filter(np.maximum(bone - smooth, 0.0), size=round(24.0 / step_mm) + 1)
    skin: Floats = smooth + gaussian_filter(proud, 12.0 / step_mm, mode="nearest") + skin_mm
    return skin
