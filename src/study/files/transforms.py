"""A registration as ITK stores one: the rigid part as ``.tfm``, the whole as a displacement field.

Both map places of the fixed image, here the US frame, to places of the moving one, the CT, as resampling the CT into
the US frame asks for, and count in LPS as everything in ITK does.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import map_coordinates

from study.errors import StudyError
from study.files.atomic import replacing
from study.files.headers import ORTHOGONAL_ATOL, check_spacing, itk_geometry
from study.files.spaces import LPS_TO_RAS
from study.files.volumes import HEADERS
from study.guidance import pull_back
from study.registration import Registration
from study.types import Floats, RigidTransform

KNOT_MM = 8.0  # between places at which the field is worked out; interpolating between them costs up to 0.3 mm
MARGIN_MM = 20.0  # of a grid of one's own around the warped cloud
MAX_VOXELS = 50_000_000
MAX_GRID_MM = 20.0  # spacing of a grid of one's own


@dataclass(frozen=True)
class Grid:
    """The voxels of an image of the US frame, in the file's own order of axes.

    Attributes:
        shape: voxels along i, j, k.
        spacing_mm: (3,).
        axes: (3, 3), columns the directions of i, j and k in RAS.
        origin: (3,) mm, RAS, centre of voxel (0, 0, 0).
        name: for messages.
    """

    shape: tuple[int, int, int]
    spacing_mm: Floats
    axes: Floats
    origin: Floats
    name: str

    def to_mm(self, indices: Floats) -> Floats:
        """RAS places (n, 3) mm of voxel indices (n, 3)."""
        return (indices * self.spacing_mm) @ self.axes.T + self.origin

    def to_index(self, points: Floats) -> Floats:
        """Fractional voxel indices (n, 3) of RAS places (n, 3) mm."""
        return np.linalg.solve(self.axes, (points - self.origin).T).T / self.spacing_mm


@dataclass(frozen=True)
class Field:
    """A displacement field on a grid.

    Attributes:
        grid: its voxels.
        displacements: (ni, nj, nk, 3) mm float32, RAS: from a voxel's place in the US frame to its place in the CT's.
        in_grid_share: of the warped points that lie in the grid.
        return_mm: (n,) how far from its CT point the field takes each warped point in the grid.
        unknown_share: of the places worked out near the warped points at which the deformation has no inverse.
    """

    grid: Grid
    displacements: NDArray[np.float32]
    in_grid_share: float
    return_mm: Floats
    unknown_share: float


def write_rigid(T_us_ct: RigidTransform, path: str | os.PathLike[str]) -> None:
    """Write the inverse of ``T_us_ct`` as ITK wants it: fixed (US) to moving (CT), LPS, ``.tfm``."""
    back = T_us_ct.inverse
    transform = sitk.AffineTransform(3)  # what 3D Slicer writes too; it is rigid
    transform.SetMatrix((LPS_TO_RAS @ back.rotation @ LPS_TO_RAS).ravel().tolist())
    transform.SetTranslation((LPS_TO_RAS @ back.translation).tolist())
    with replacing(Path(path)) as temporary:
        sitk.WriteTransform(transform, str(temporary))


def read_grid(path: str | os.PathLike[str]) -> Grid:
    """The grid of an image file; its pixels are not read.

    Raises:
        StudyError: no such file, another suffix, a header as `study.files.read_volume` refuses it, or too many voxels.
    """
    path = Path(path)
    name = path.name
    suffix = next((suffix for suffix in HEADERS if name.lower().endswith(suffix)), None)
    if suffix is None or not path.is_file():
        raise StudyError(
            f"expected an image of the US frame ({', '.join(HEADERS)}) or a spacing in mm, got {str(path)!r}; "
            "3 makes a grid of 3 mm around the result"
        )
    shape = HEADERS[suffix](path, name).shape
    spacing, axes, origin = itk_geometry(path, shape, name)
    check_spacing(spacing, name, "a grid of")
    if not np.allclose(axes.T @ axes, np.eye(3), atol=ORTHOGONAL_ATOL):
        raise StudyError(f"{name}: expected orthogonal axes, got a sheared grid; resample it to an orthogonal grid")
    return _sized(Grid(shape, spacing, LPS_TO_RAS @ axes, LPS_TO_RAS @ origin, name))


def grid_around(points: Floats, spacing_mm: float) -> Grid:
    """A grid along the axes of the US frame that holds points (n, 3) mm and a margin of ``MARGIN_MM``.

    Raises:
        StudyError: a spacing that is none, or so small that the grid has too many voxels.
    """
    if not 0 < spacing_mm <= MAX_GRID_MM:
        raise StudyError(f"expected a grid spacing of 0 to {MAX_GRID_MM:g} mm, got {spacing_mm:g}; 3 is fine enough")
    low, high = points.min(axis=0) - MARGIN_MM, points.max(axis=0) + MARGIN_MM
    ni, nj, nk = (int(n) for n in np.ceil((high - low) / spacing_mm) + 1)
    origin = np.array([high[0], high[1], low[2]])  # axes of LPS, as most images of this field have
    return _sized(Grid((ni, nj, nk), np.full(3, spacing_mm), LPS_TO_RAS, origin, f"a grid of {spacing_mm:g} mm"))


def _sized(grid: Grid) -> Grid:
    if (n := int(np.prod(grid.shape, dtype=np.int64))) > MAX_VOXELS:
        raise StudyError(
            f"{grid.name}: expected at most {MAX_VOXELS:,} voxels, got {n:,}; crop it or resample it to 2 or 3 mm"
        )
    return grid


def sample_field(result: Registration, grid: Grid) -> Field:
    """The displacement from each voxel's place in the US frame to its place in the CT frame.

    Raises:
        StudyError: a grid that holds none of the warped points.
    """
    index = grid.to_index(result.warped)
    inside = ((index >= 0) & (index <= np.array(grid.shape) - 1)).all(axis=1)
    if not inside.any():
        low, high = result.warped.min(axis=0).round(), result.warped.max(axis=0).round()
        raise StudyError(
            f"{grid.name}: expected a grid around the result, from {low.tolist()} to {high.tolist()} mm of the US "
            "frame, RAS, got one that holds none of it; give an image of the US frame, or a spacing such as 3"
        )
    # Whole knots beyond the last voxel, so that interpolation never leaves them.
    steps = np.maximum(1, np.floor(KNOT_MM / grid.spacing_mm)).astype(int)
    knots = [np.arange(0, n - 1 + step, step, dtype=np.float64) for n, step in zip(grid.shape, steps, strict=True)]
    places = grid.to_mm(np.stack(np.meshgrid(*knots, indexing="ij"), axis=-1).reshape(-1, 3))
    origins, known = pull_back(result, places)
    coarse = (origins - places).reshape(*(len(axis) for axis in knots), 3)
    values = np.empty((*grid.shape, 3), dtype=np.float32)
    between = RegularGridInterpolator(knots, coarse)
    voxels = np.stack(np.meshgrid(*map(np.arange, grid.shape[1:]), indexing="ij"), axis=-1).reshape(-1, 2)
    for i in range(grid.shape[0]):  # a slice at a time, to bound memory
        values[i] = between(np.column_stack([np.full(len(voxels), i), voxels])).reshape(*grid.shape[1:], 3)
    there = result.warped[inside]
    back = there + np.column_stack([map_coordinates(values[..., c], index[inside].T, order=1) for c in range(3)])
    return Field(
        grid,
        values,
        float(inside.mean()),
        np.linalg.norm(back - result.source[inside], axis=1),
        float((~known).mean()),
    )


def write_field(field: Field, path: str | os.PathLike[str]) -> None:
    """Write a field as a NIfTI image of vectors, LPS, as ITK and ANTs store one (intent code 1007).

    Equal fields give equal bytes.

    Raises:
        StudyError: another suffix than .nii.gz.
    """
    path = Path(path)
    if not path.name.endswith(".nii.gz"):
        raise StudyError(f"expected a name ending in .nii.gz, got {path.name!r}; rename it")
    turned = field.displacements * np.diag(LPS_TO_RAS).astype(np.float32)
    image = sitk.GetImageFromArray(np.ascontiguousarray(turned.transpose(2, 1, 0, 3)), isVector=True)
    image.SetSpacing(field.grid.spacing_mm.tolist())
    image.SetOrigin((LPS_TO_RAS @ field.grid.origin).tolist())
    image.SetDirection((LPS_TO_RAS @ field.grid.axes).ravel().tolist())
    with replacing(path) as temporary:
        sitk.WriteImage(image, str(temporary), useCompression=True)
