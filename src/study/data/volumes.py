"""Reading and writing images: one frame (RAS+ mm), one axis order (R, A, S), no guessed geometry.

SimpleITK reads NIfTI, NRRD, MHA and DICOM series, all into LPS+ mm. What it does not do is say that a header left
the geometry out: it fills in 1 mm and an identity direction. A registration in millimetres cannot be built on that,
so the headers are checked before the pixels are read.
"""

from __future__ import annotations

import gzip
import math
import os
import re
import struct
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from study.errors import StudyError
from study.types import Floats, RigidTransform, Volume

LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0])
SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")
ORTHOGONAL_ATOL = 1e-3  # direction cosines are stored with 4-6 digits
TILT_MM = 0.1  # per slice: DICOM positions are rounded to 0.001 mm, a tilt of 1 degree shifts 1 mm slices by 0.02 mm
NIFTI1_BYTES = 348  # header size, and its first field
STEP_RTOL = 0.05  # slice positions of a real series vary by rounding; a missing slice doubles one


def read_volume(path: str | os.PathLike[str], name: str | None = None) -> Volume:
    """Read an image from a file or a folder holding one DICOM series.

    Args:
        path: ``.nii``, ``.nii.gz``, ``.nrrd``, ``.mha``, ``.mhd`` or a DICOM folder.
        name: for messages; the file's name when None.

    Returns:
        the image with axes closest to R, A, S; int16 or float32 values as stored, in Hounsfield units for a CT.

    Raises:
        StudyError: missing file, unknown format, truncated file, not 3-D, spacing or orientation missing, axes not
            orthogonal, or (DICOM) several series, missing slices or gantry tilt.
    """
    path = Path(path)
    name = name or path.name
    if not path.exists():
        raise StudyError(f"{name}: expected a file or DICOM folder at {path}, got nothing there; check the path")
    if path.is_dir():
        image = _read_dicom(path, name)
    elif path.name.lower().endswith(SUFFIXES):
        _check_header(path, name)
        image = _read_image(path, name)
    else:
        raise StudyError(
            f"{name}: expected {', '.join(SUFFIXES)} or a DICOM folder, got {path.suffix!r}; convert the file"
        )
    return _to_ras(image, name)


def read_labels(path: str | os.PathLike[str], like: Volume | None = None, name: str | None = None) -> Volume:
    """Read a label volume (integer ids, int16), on the grid of ``like`` when that is given.

    Raises:
        StudyError: as `read_volume`; values that are not whole numbers; a grid that is not the CT's.
    """
    labels = read_volume(path, name)
    values = labels.values
    if not np.issubdtype(values.dtype, np.integer):
        if not (values == np.round(values)).all():
            raise StudyError(
                f"{labels.name}: expected whole label ids, got fractions; resample labels by nearest neighbour"
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


def write_volume(volume: Volume, path: str | os.PathLike[str]) -> Path:
    """Write ``.nii.gz``; equal volumes give equal bytes, and a half-written file never bears the name.

    Raises:
        StudyError: another suffix.
    """
    path = Path(path)
    if not path.name.endswith(".nii.gz"):
        raise StudyError(f"expected a name ending in .nii.gz, got {path.name!r}")
    image = sitk.GetImageFromArray(np.ascontiguousarray(volume.values.T))
    image.SetSpacing(volume.spacing_mm.tolist())
    image.SetOrigin((LPS_TO_RAS @ volume.T_ras_index.translation).tolist())
    image.SetDirection((LPS_TO_RAS @ volume.T_ras_index.rotation).ravel().tolist())
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, half = tempfile.mkstemp(prefix=".half-", suffix=".nii.gz", dir=path.parent)
    os.close(handle)
    try:
        sitk.WriteImage(image, half, useCompression=True)
        os.chmod(half, 0o644)  # mkstemp makes private files
        os.replace(half, path)
    finally:
        Path(half).unlink(missing_ok=True)
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


def _read_image(path: Path, name: str) -> sitk.Image:
    try:
        return sitk.ReadImage(str(path))
    except RuntimeError as error:
        raise _explain(error, name) from error


def _explain(error: Exception, name: str) -> StudyError:
    """ITK's paragraph in one line, with the remedy."""
    text = " ".join(str(error).split())
    reason = text.split("ITK ERROR:")[-1].strip()[:200]
    if "orthonormal" in text.lower() or "orthogonal" in text.lower():
        return StudyError(
            f"{name}: expected orthogonal axes, got a sheared grid (gantry tilt?); resample it to an orthogonal grid"
        )
    if "spacing" in text.lower():
        return StudyError(f"{name}: expected a positive voxel spacing, got none or zero; repair the header ({reason})")
    return StudyError(f"{name}: expected a readable image, got a truncated or damaged file; fetch it again ({reason})")


def _check_header(path: Path, name: str) -> None:
    """Refuse what SimpleITK would fill in silently: spacing, orientation and missing bytes."""
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    suffix = path.name.lower()
    if suffix.endswith((".nrrd", ".nhdr")):
        fields = _text_header(path, end="")
        if not ({"space directions", "spacings"} & fields.keys()):
            raise StudyError(f"{name}: expected 'space directions' in the NRRD header, got no spacing; export it again")
        if "space directions" not in fields or "space" not in fields:
            raise StudyError(
                f"{name}: expected 'space' and 'space directions' in the NRRD header, got an unknown orientation; "
                "export it again as left-posterior-superior or right-anterior-superior"
            )
    elif suffix.endswith((".mha", ".mhd")):
        fields = _text_header(path, end="elementdatafile")
        if not ({"elementspacing", "elementsize"} & fields.keys()):
            raise StudyError(f"{name}: expected ElementSpacing in the MetaImage header, got none; export it again")
        if not ({"transformmatrix", "rotation", "orientation"} & fields.keys()):
            raise StudyError(f"{name}: expected TransformMatrix in the MetaImage header, got an unknown orientation")
    else:
        _check_nifti(path, name)
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise _explain(error, name) from error
    _check_size(reader, path, name)


def _check_nifti(path: Path, name: str) -> None:
    """ITK replaces a zero spacing by 1 mm and missing voxels by zeros, without a word."""
    unpack = gzip.open if path.name.lower().endswith(".gz") else open
    with unpack(path, "rb") as stream:
        try:
            header = stream.read(NIFTI1_BYTES)
        except (OSError, EOFError) as error:
            raise _explain(error, name) from error
        order = "<" if header[:4] == NIFTI1_BYTES.to_bytes(4, "little") else ">"
        if len(header) < NIFTI1_BYTES or struct.unpack_from(f"{order}i", header)[0] != NIFTI1_BYTES:
            if header[:4] in ((540).to_bytes(4, "little"), (540).to_bytes(4, "big")):
                return  # NIfTI-2, with another layout
            raise StudyError(f"{name}: expected a NIfTI header, got a truncated or damaged file; fetch it again")
        dims = struct.unpack_from(f"{order}8h", header, 40)
        bits = struct.unpack_from(f"{order}h", header, 72)[0]
        pixdim = struct.unpack_from(f"{order}8f", header, 76)
        first = int(struct.unpack_from(f"{order}f", header, 108)[0])
        codes = struct.unpack_from(f"{order}2h", header, 252)
        if codes == (0, 0):
            raise StudyError(
                f"{name}: expected a qform or sform in the NIfTI header, got an unknown orientation "
                "(both codes are 0); export it again with its affine"
            )
        if min(abs(step) for step in pixdim[1:4]) < 1e-6:
            raise StudyError(f"{name}: expected a positive voxel spacing, got pixdim {pixdim[1:4]}; repair the header")
        expected = first + math.prod(max(n, 1) for n in dims[1 : dims[0] + 1]) * bits // 8
        if _stream_bytes(path, stream, expected) < expected:
            raise StudyError(f"{name}: expected {expected} bytes, got a truncated or damaged file; fetch it again")


def _stream_bytes(path: Path, stream: IO[bytes] | gzip.GzipFile, expected: int) -> int:
    """Length of an open file's content; a gzip file states it in its last 4 bytes, else it is unpacked to count."""
    if not path.name.lower().endswith(".gz"):
        return path.stat().st_size
    with path.open("rb") as packed:
        packed.seek(-4, os.SEEK_END)
        if int.from_bytes(packed.read(4), "little") == expected % 2**32:
            return expected
    try:
        while stream.read(1 << 24):
            pass
        return stream.tell()
    except (OSError, EOFError, zlib.error):
        return 0


def _text_header(path: Path, end: str) -> dict[str, str]:
    """Lower-case keys of an NRRD (``key: value``) or MetaImage (``Key = value``) header, up to line ``end``."""
    fields: dict[str, str] = {}
    with path.open("rb") as stream:
        for raw in stream:
            line = raw.decode("latin-1").strip()
            if end == "" and line == "":
                break
            key, _, value = (part.strip() for part in re.sub("[:=]+", "\0", line, count=1).partition("\0"))
            if not line.startswith("#"):
                fields[key.lower()] = value
            if key.lower() == end and end:
                break
    return fields


def _check_size(reader: sitk.ImageFileReader, path: Path, name: str) -> None:
    if reader.GetDimension() != 3 or min(reader.GetSize()) < 2:
        size = " x ".join(str(n) for n in reader.GetSize())
        raise StudyError(f"{name}: expected a 3-D image, got {size}; give the whole series, one time point")
    if reader.GetNumberOfComponents() != 1:
        raise StudyError(
            f"{name}: expected one value a voxel, got {reader.GetNumberOfComponents()}; colour or vector image?"
        )


def _read_dicom(folder: Path, name: str) -> sitk.Image:
    """One series, sorted and checked by ImagePositionPatient: GDCM only warns of gaps and drops the tilt."""
    series = sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    if len(series) == 0:
        raise StudyError(f"{name}: expected a DICOM series in {folder}, got none; check the folder")
    if len(series) > 1:
        raise StudyError(
            f"{name}: expected one DICOM series, got {len(series)} in {folder}; put each in a folder of its own"
        )
    files = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series[0])
    if len(files) < 2:
        raise StudyError(f"{name}: expected a 3-D series, got {len(files)} DICOM slice; give the whole series")
    headers = [_dicom_header(file, name) for file in files]
    positions = np.array([position for position, _ in headers])
    orientations = np.array([orientation for _, orientation in headers])
    if np.abs(orientations - orientations[0]).max() > ORTHOGONAL_ATOL:
        raise StudyError(f"{name}: expected one ImageOrientationPatient, got several; is this a localiser?")
    normal = np.cross(orientations[0, :3], orientations[0, 3:])
    order = np.argsort(positions @ normal)
    steps = np.diff(positions[order], axis=0)
    heights = steps @ normal
    if heights.min() < 1e-3:
        raise StudyError(f"{name}: expected one slice per position, got two at the same place; is this a 4-D series?")
    tilt = np.linalg.norm(steps.mean(axis=0) - heights.mean() * normal)
    if tilt > max(TILT_MM, 0.01 * heights.mean()) or tilt * len(steps) > 2.0:
        angle = np.degrees(np.arctan2(tilt, heights.mean()))
        raise StudyError(
            f"{name}: expected slices stacked along their normal, got a gantry tilt of {angle:.1f} degrees; "
            "resample the series to an orthogonal grid"
        )
    if np.abs(heights - np.median(heights)).max() > STEP_RTOL * np.median(heights) + 2e-3:
        raise StudyError(
            f"{name}: expected evenly spaced slices, got steps of {heights.min():.3f} to {heights.max():.3f} mm; "
            "slices are missing"
        )
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([files[index] for index in order])
    try:
        image = reader.Execute()
    except RuntimeError as error:
        raise _explain(error, name) from error
    image.SetSpacing((*image.GetSpacing()[:2], float(heights.mean())))
    image.SetDirection(np.column_stack([orientations[0, :3], orientations[0, 3:], normal]).ravel().tolist())
    image.SetOrigin(positions[order[0]].tolist())
    return image


def _dicom_header(file: str, name: str) -> tuple[list[float], list[float]]:
    reader = sitk.ImageFileReader()
    reader.SetFileName(file)
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise _explain(error, name) from error
    found = []
    for tag, what, count in (("0020|0032", "ImagePositionPatient", 3), ("0020|0037", "ImageOrientationPatient", 6)):
        text = reader.GetMetaData(tag) if reader.HasMetaDataKey(tag) else ""
        try:
            numbers = [float(part) for part in text.split("\\")]
        except ValueError:
            numbers = []
        if len(numbers) != count:
            raise StudyError(
                f"{name}: expected {what} in every slice, got {text!r} in {Path(file).name}; unknown orientation"
            )
        found.append(numbers)
    if not (reader.HasMetaDataKey("0028|0030") or reader.HasMetaDataKey("0018|1164")):
        raise StudyError(
            f"{name}: expected PixelSpacing in every slice, got none in {Path(file).name}; missing spacing"
        )
    return found[0], found[1]


def _to_ras(image: sitk.Image, name: str) -> Volume:
    if image.GetDimension() != 3 or min(image.GetSize()) < 2:
        raise StudyError(f"{name}: expected a 3-D image, got {image.GetSize()}; give the whole series, one time point")
    values = sitk.GetArrayFromImage(image).T  # SimpleITK hands out (k, j, i)
    spacing = np.array(image.GetSpacing())
    axes: Floats = LPS_TO_RAS @ np.array(image.GetDirection()).reshape(3, 3)  # column: where an index axis points
    if not np.allclose(axes.T @ axes, np.eye(3), atol=ORTHOGONAL_ATOL):
        raise StudyError(
            f"{name}: expected orthogonal axes, got a sheared grid (gantry tilt?); resample it to an orthogonal grid"
        )
    if (spacing <= 0).any() or not np.isfinite(spacing).all():
        raise StudyError(f"{name}: expected a positive voxel spacing, got {spacing}; repair the header")
    _, order = linear_sum_assignment(-np.abs(axes))  # row r is best served by index axis order[r]
    origin = LPS_TO_RAS @ np.array(image.GetOrigin())
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
