"""Images of one frame (RAS+ mm) and one axis order (R, A, S): reading and writing, no guessed geometry.

SimpleITK reads the geometry of NIfTI, NRRD, MHA and DICOM series, all into LPS+ mm; here they are turned at the edge.
Pixels are unpacked here, because ITK stops before the checksum of a compressed stream and so never compares it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from study.errors import StudyError
from study.files.atomic import replacing
from study.files.dicom import read_dicom
from study.files.headers import ORTHOGONAL_ATOL, itk_geometry
from study.files.nifti import read_nifti_header
from study.files.spaces import LPS_TO_RAS
from study.files.stored import read_pixels
from study.files.text_images import read_metaimage_header, read_nrrd_header
from study.types import Floats, RigidTransform, Volume

HEADERS = {
    ".nii": read_nifti_header,
    ".nii.gz": read_nifti_header,
    ".nrrd": read_nrrd_header,
    ".nhdr": read_nrrd_header,
    ".mha": read_metaimage_header,
    ".mhd": read_metaimage_header,
}
INT16 = np.iinfo(np.int16)


def read_volume(path: str | os.PathLike[str], name: str | None = None) -> Volume:
    """Read an image from a file or a folder holding one DICOM series.

    Args:
        path: ``.nii``, ``.nii.gz``, ``.nrrd``, ``.mha``, ``.mhd`` or a DICOM folder.
        name: for messages; the file's name when None.

    Returns:
        the image with axes closest to R, A, S; int16 or float32 values as stored, in Hounsfield units for a CT.

    Raises:
        StudyError: missing file, unknown format, truncated or damaged file, not 3-D, a header whose spacing, unit,
            origin or orientation is missing or contradicts itself, axes not orthogonal, or (DICOM) several series,
            missing or damaged slices or gantry tilt.
    """
    path = Path(path)
    name = name or path.name
    if not path.exists():
        raise StudyError(f"{name}: expected a file or DICOM folder at {path}, got nothing there; check the path")
    if path.is_dir():
        image = read_dicom(path, name)
        values = sitk.GetArrayFromImage(image).T  # SimpleITK hands out (k, j, i)
        spacing, origin = np.array(image.GetSpacing()), np.array(image.GetOrigin())
        return _to_ras(values, spacing, np.array(image.GetDirection()).reshape(3, 3), origin, name)
    suffix = next((suffix for suffix in HEADERS if path.name.lower().endswith(suffix)), None)
    if suffix is None:
        raise StudyError(
            f"{name}: expected {', '.join(HEADERS)} or a DICOM folder, got {path.suffix!r}; convert the file"
        )
    stored = HEADERS[suffix](path, name)
    values = read_pixels(stored, name)
    return _to_ras(values, *itk_geometry(path, stored.shape, name), name)


def read_labels(path: str | os.PathLike[str], like: Volume | None = None, name: str | None = None) -> Volume:
    """Read a label volume (integer ids, int16), on the grid of ``like`` when that is given.

    Raises:
        StudyError: as `read_volume`; values that are not whole numbers or beyond int16; a grid that is not the CT's.
    """
    labels = read_volume(path, name)
    values = labels.values
    if not np.issubdtype(values.dtype, np.integer):
        with np.errstate(invalid="ignore"):
            whole = bool((values == np.round(values)).all())
        if not whole:
            raise StudyError(
                f"{labels.name}: expected whole label ids, got fractions or NaN; resample labels by nearest neighbour"
            )
        if values.min() < INT16.min or values.max() > INT16.max:  # a cast would wrap them to other ids
            raise StudyError(
                f"{labels.name}: expected label ids of {INT16.min} to {INT16.max}, got {values.min():g} to"
                f" {values.max():g}; is this an image, not labels?"
            )
        values = values.astype(np.int16)
    labels = labels.with_values(values)
    if like is not None:
        check_same_grid(labels, like)
    return labels


def read_masks(
    paths: Mapping[str, str | os.PathLike[str]], like: Volume | None = None
) -> tuple[Volume, dict[str, int]]:
    """Read one binary mask per structure (TotalSegmentator's layout) as one label volume.

    Args:
        paths: structure name to mask file; a voxel above 0.5 belongs to it. Where masks overlap the later name wins.
        like: the CT whose grid they must share.

    Returns:
        int16 labels (0 is background) and the id of every name.

    Raises:
        StudyError: as `read_labels`; no masks; masks on different grids.
    """
    if not paths:
        raise StudyError("expected at least one mask file, got none; check the subject's folder")
    values: NDArray[np.int16] | None = None
    grid = like
    ids = {structure: index for index, structure in enumerate(paths, start=1)}
    for structure, path in paths.items():
        mask = read_volume(path, f"mask {structure}")
        if grid is None:
            grid = mask
        check_same_grid(mask, grid)
        if values is None:
            values = np.zeros(mask.shape, dtype=np.int16)
        values[mask.values > 0.5] = ids[structure]
    assert grid is not None
    assert values is not None
    return Volume(values, grid.spacing_mm, grid.T_ras_index, f"labels of {grid.name}"), ids


def masks_in(folder: str | os.PathLike[str], structures: Iterable[str]) -> dict[str, Path]:
    """The mask files of a folder as TotalSegmentator writes it, ``sternum.nii.gz`` and so on, by structure.

    Raises:
        StudyError: none of the structures has a file there.
    """
    folder = Path(folder)
    found = {
        name: folder / f"{name}{suffix}"
        for name in structures
        for suffix in reversed(HEADERS)
        if (folder / f"{name}{suffix}").is_file()
    }
    if not found:
        raise StudyError(
            f"{folder}: expected masks such as sternum.nii.gz and rib_left_2.nii.gz, got none; "
            "give the folder that TotalSegmentator wrote"
        )
    return found


def write_volume(volume: Volume, path: str | os.PathLike[str]) -> Path:
    """Write ``.nii.gz``; equal volumes give equal bytes, and a half-written file never bears the name.

    Raises:
        StudyError: another suffix.
    """
    path = Path(path)
    if not path.name.endswith(".nii.gz"):
        raise StudyError(f"expected a name ending in .nii.gz, got {path.name!r}; rename it")
    image = sitk.GetImageFromArray(np.ascontiguousarray(volume.values.T))
    image.SetSpacing(volume.spacing_mm.tolist())
    image.SetOrigin((LPS_TO_RAS @ volume.T_ras_index.translation).tolist())
    image.SetDirection((LPS_TO_RAS @ volume.T_ras_index.rotation).ravel().tolist())
    with replacing(path) as temporary:
        sitk.WriteImage(image, str(temporary), useCompression=True)
    return path


def check_same_grid(labels: Volume, ct: Volume) -> None:
    """Two images share a grid: same size, and corner voxels within a tenth of a voxel.

    Raises:
        StudyError: they do not.
    """
    if labels.shape != ct.shape:
        raise StudyError(
            f"{labels.name}: expected the grid of {ct.name} {ct.shape}, got {labels.shape}; "
            "resample the labels to the CT"
        )
    corners = np.array(np.meshgrid(*[(0, n - 1) for n in ct.shape])).reshape(3, -1).T
    off_mm = float(np.linalg.norm(labels.to_mm(corners) - ct.to_mm(corners), axis=1).max())
    if off_mm > 0.1 * ct.spacing_mm.min():
        raise StudyError(
            f"{labels.name}: expected the position of {ct.name}, got corners {off_mm:.2f} mm away; "
            "spacing, origin or orientation differ: resample the labels to the CT"
        )


def _to_ras(values: NDArray[Any], spacing: Floats, axes_lps: Floats, origin_lps: Floats, name: str) -> Volume:
    """Values (i, j, k) on a grid in LPS+, turned to the axes closest to R, A, S; axes are the matrix's columns."""
    if values.ndim != 3 or min(values.shape) < 2:
        raise StudyError(f"{name}: expected a 3-D image, got {values.shape}; give the whole series, one time point")
    axes: Floats = LPS_TO_RAS @ axes_lps
    if not np.allclose(axes.T @ axes, np.eye(3), atol=ORTHOGONAL_ATOL):
        raise StudyError(
            f"{name}: expected orthogonal axes, got a sheared grid (gantry tilt?); resample it to an orthogonal grid"
        )
    if (spacing <= 0).any() or not np.isfinite(spacing).all():
        raise StudyError(f"{name}: expected a positive voxel spacing, got {spacing}; repair the header")
    _, order = linear_sum_assignment(-np.abs(axes))  # row r is best served by index axis order[r]
    origin = LPS_TO_RAS @ origin_lps
    values, spacing, axes = values.transpose(order), spacing[order], axes[:, order]
    for axis in range(3):
        if axes[axis, axis] < 0:
            origin = origin + axes[:, axis] * spacing[axis] * (values.shape[axis] - 1)
            values, axes[:, axis] = np.flip(values, axis), -axes[:, axis]
    u, _, vt = np.linalg.svd(axes)  # the rotation closest to cosines of few digits
    if np.linalg.det(u @ vt) < 0:
        raise StudyError(
            f"{name}: expected a grid that can be turned to R, A, S, got {axes.round(2).tolist()}; resample it"
        )
    if values.dtype == np.float64:
        values = values.astype(np.float32)
    return Volume(values, spacing, RigidTransform(u @ vt, origin), name)
