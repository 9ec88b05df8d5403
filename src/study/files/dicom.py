"""One DICOM series as one image: sorted and checked by ImagePositionPatient."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import SimpleITK as sitk

from study.errors import StudyError
from study.files.headers import ORTHOGONAL_ATOL, check_spacing, explain
from study.types import Floats

TILT_MM = 0.1  # per slice: DICOM positions are rounded to 0.001 mm, a tilt of 1 degree shifts 1 mm slices by 0.02 mm
PREAMBLE_BYTES, MAGIC = 128, b"DICM"
NOT_SLICES = ("dicomdir", "lockfile", "version")  # what writers of media put beside the slices
STEP_RTOL = 0.05  # slice positions of a real series vary by rounding; a missing slice doubles one


def read_dicom(folder: Path, name: str) -> sitk.Image:
    """Read a folder that holds one series; LPS+ mm, slices along their normal.

    GDCM only warns of gaps and drops the tilt, so the slices' own headers decide.

    Args:
        folder: its files.
        name: for messages.

    Raises:
        StudyError: no series, several, a single slice, unknown geometry, missing or damaged slices, or gantry tilt.
    """
    files = _one_series(folder, name)
    headers = [_dicom_header(file, name) for file in files]
    positions = np.array([header.position for header in headers])
    orientations = np.array([header.orientation for header in headers])
    for file, header in zip(files, headers, strict=True):
        if header.layout != headers[0].layout:
            raise StudyError(
                f"{name}: expected slices of one size and PixelSpacing, got {header.layout} in {Path(file).name} and"
                f" {headers[0].layout} in {Path(files[0]).name}; fetch the series again"
            )
    if np.abs(orientations - orientations[0]).max() > ORTHOGONAL_ATOL:
        raise StudyError(
            f"{name}: expected one ImageOrientationPatient, got several in one series; take the localiser out"
        )
    normal = np.cross(orientations[0, :3], orientations[0, 3:])
    order = np.argsort(positions @ normal)
    height_mm = _slice_height_mm(positions[order], normal, name)
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([files[index] for index in order])
    try:
        image: sitk.Image = reader.Execute()
    except RuntimeError as error:
        raise explain(error, name) from error
    image.SetSpacing((*image.GetSpacing()[:2], height_mm))
    image.SetDirection(np.column_stack([orientations[0, :3], orientations[0, 3:], normal]).ravel().tolist())
    image.SetOrigin(positions[order[0]].tolist())
    return image


def _one_series(folder: Path, name: str) -> tuple[str, ...]:
    """The files of the folder's only series."""
    series = sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    if len(series) == 0:
        raise StudyError(f"{name}: expected a DICOM series in {folder}, got none; check the folder")
    if len(series) > 1:
        raise StudyError(
            f"{name}: expected one DICOM series, got {len(series)} in {folder}; put each in a folder of its own"
        )
    files: tuple[str, ...] = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series[0])
    if len(files) < 2:
        raise StudyError(f"{name}: expected a 3-D series, got {len(files)} DICOM slice; give the whole series")
    _check_others(folder, files, name)
    return files


def _check_others(folder: Path, files: tuple[str, ...], name: str) -> None:
    """No other file of the folder looks like a slice: GDCM drops one that it cannot read without a word.

    In the middle of a series that leaves a gap; at its end the image would only be shorter.
    """
    taken = {Path(file).name for file in files}
    suffixes = {Path(file).suffix.lower() for file in files}
    for path in sorted(folder.iterdir()):
        if path.name in taken or path.name.startswith(".") or path.stem.lower() in NOT_SLICES or not path.is_file():
            continue
        with path.open("rb") as file:
            file.seek(PREAMBLE_BYTES)
            dicom = file.read(len(MAGIC)) == MAGIC
        if dicom or path.suffix.lower() in suffixes:
            raise StudyError(
                f"{name}: expected every slice to be readable, got a damaged slice {path.name}, or a file that is none;"
                " fetch it again, or take it out of the folder if it does not belong to the series"
            )


def _slice_height_mm(positions: Floats, normal: Floats, name: str) -> float:
    """Mean step between sorted slices (n, 3) mm, which must stack evenly along their normal."""
    steps = np.diff(positions, axis=0)
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
    return float(heights.mean())


class _Slice(NamedTuple):
    position: list[float]  # (3,) LPS+ mm
    orientation: list[float]  # (6,)
    layout: str  # size and spacing


def _dicom_header(file: str, name: str) -> _Slice:
    """A slice's ImagePositionPatient, ImageOrientationPatient, size and PixelSpacing, which must all be there."""
    reader = sitk.ImageFileReader()
    reader.SetFileName(file)
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise explain(error, name) from error

    def values(what: str, count: int, *tags: str) -> list[float]:
        text = next((reader.GetMetaData(tag) for tag in tags if reader.HasMetaDataKey(tag)), "")
        try:
            found = [float(part) for part in text.split("\\")]
        except ValueError:
            found = []
        if len(found) != count or not np.isfinite(found).all():
            raise StudyError(
                f"{name}: expected {count} finite numbers as {what} in every slice, got {text!r} in"
                f" {Path(file).name}; export the series again"
            )
        return found

    position = values("ImagePositionPatient, the origin,", 3, "0020|0032")
    orientation = values("ImageOrientationPatient", 6, "0020|0037")
    spacing = values("PixelSpacing", 2, "0028|0030", "0018|1164")
    check_spacing(np.array(spacing), name, f"in {Path(file).name} PixelSpacing")
    axes = np.array(orientation).reshape(2, 3)
    if not np.allclose(axes @ axes.T, np.eye(2), atol=ORTHOGONAL_ATOL):
        raise StudyError(
            f"{name}: expected an ImageOrientationPatient of two unit vectors at right angles, got {orientation} in"
            f" {Path(file).name}; export the series again"
        )
    size = reader.GetSize()
    return _Slice(position, orientation, f"{size[0]} x {size[1]} pixels of {spacing[0]:g} x {spacing[1]:g} mm")
