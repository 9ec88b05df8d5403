"""One DICOM series as one image: sorted and checked by ImagePositionPatient."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import SimpleITK as sitk

from study.errors import StudyError
from study.files.headers import ORTHOGONAL_ATOL, explain
from study.types import Floats

TILT_MM = 0.1  # per slice: DICOM positions are rounded to 0.001 mm, a tilt of 1 degree shifts 1 mm slices by 0.02 mm
STEP_RTOL = 0.05  # slice positions of a real series vary by rounding; a missing slice doubles one


def read_dicom(folder: Path, name: str) -> sitk.Image:
    """Read a folder that holds one series; LPS+ mm, slices along their normal.

    GDCM only warns of gaps and drops the tilt, so the slices' own headers decide.

    Args:
        folder: its files.
        name: for messages.

    Raises:
        StudyError: no series, several, a single slice, unknown geometry, missing slices, or gantry tilt.
    """
    files = _one_series(folder, name)
    headers = [_dicom_header(file, name) for file in files]
    positions = np.array([position for position, _ in headers])
    orientations = np.array([orientation for _, orientation in headers])
    if np.abs(orientations - orientations[0]).max() > ORTHOGONAL_ATOL:
        raise StudyError(f"{name}: expected one ImageOrientationPatient, got several; is this a localiser?")
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
    return files


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


def _dicom_header(file: str, name: str) -> tuple[list[float], list[float]]:
    """A slice's ImagePositionPatient (3) and ImageOrientationPatient (6); its PixelSpacing must be there."""
    reader = sitk.ImageFileReader()
    reader.SetFileName(file)
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise explain(error, name) from error
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
