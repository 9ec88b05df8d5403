"""A DICOM series is one image, or is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from stored_images import LPS_TO_RAS, MARKED, SIZE, SPACING, marked_mm, stored_image

from study.errors import StudyError
from study.files.volumes import read_volume


def write_series(folder: Path, shift_mm: float = 0.0, skip: int | None = None, uid: str = "1.2.3") -> sitk.Image:
    folder.mkdir(exist_ok=True)
    image = stored_image()
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k in range(SIZE[2]):
        if k == skip:
            continue
        one = image[:, :, k]
        x, y, z = image.TransformIndexToPhysicalPoint((0, 0, k))
        for tag, value in {
            "0008|0060": "CT",
            "0020|000e": uid,
            "0020|000d": "1.2.4",
            "0008|0018": f"{uid}.{k + 1}",
            "0020|0013": str(k),
            "0020|0032": f"{x}\\{y + shift_mm * k}\\{z}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0028|0030": f"{SPACING[1]}\\{SPACING[0]}",
            "0028|1052": "0",
            "0028|1053": "1",
        }.items():
            one.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"{uid}-{SIZE[2] - k}.dcm"))  # names against the order of the slices
        writer.Execute(one)
    return image


def test_dicom_series_is_sorted_by_position(tmp_path: Path) -> None:
    image = write_series(tmp_path / "series")
    volume = read_volume(tmp_path / "series")
    expected = np.array(image.TransformIndexToPhysicalPoint(MARKED)) * LPS_TO_RAS
    np.testing.assert_allclose(marked_mm(volume), expected, atol=1e-3)
    np.testing.assert_allclose(volume.spacing_mm, SPACING, atol=1e-6)


def test_faulty_dicom_series_are_refused(tmp_path: Path) -> None:
    write_series(tmp_path / "tilted", shift_mm=0.4)
    with pytest.raises(StudyError, match=r"gantry tilt of 9\.1 degrees"):
        read_volume(tmp_path / "tilted")
    write_series(tmp_path / "gap", skip=2)
    with pytest.raises(StudyError, match="slices are missing"):
        read_volume(tmp_path / "gap")
    write_series(tmp_path / "two", uid="1.2.3")
    write_series(tmp_path / "two", uid="1.2.9")
    with pytest.raises(StudyError, match="one DICOM series, got 2"):
        read_volume(tmp_path / "two")
    (tmp_path / "none").mkdir()
    with pytest.raises(StudyError, match="expected a DICOM series"):
        read_volume(tmp_path / "none")


@pytest.mark.parametrize("k", [0, 2, 4])
@pytest.mark.parametrize("damage", ["cut", "short", "rubbish", "empty"])
def test_a_damaged_slice_is_named_wherever_it_lies(tmp_path: Path, k: int, damage: str) -> None:
    write_series(tmp_path)
    file = sorted(tmp_path.iterdir())[k]
    whole = file.read_bytes()
    file.write_bytes({"cut": whole[:300], "short": whole[:-2], "rubbish": b"x" * 900, "empty": b""}[damage])
    with pytest.raises(StudyError, match=f"damaged slice {file.name}"):
        read_volume(tmp_path)


def test_what_lies_beside_the_slices_of_a_disc_is_no_slice(tmp_path: Path) -> None:
    write_series(tmp_path)
    for name in ("DICOMDIR", ".hidden.dcm", "README.txt", "report.pdf"):
        (tmp_path / name).write_bytes(bytes(128) + b"DICM" if name == "DICOMDIR" else b"text")
    assert read_volume(tmp_path).shape == SIZE


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (".9\\.7 ", ".8\\.7 ", "slices of one size and PixelSpacing"),
        (".9\\.7 ", ".9\\.0 ", "positive voxel spacing"),
        (".9\\.7 ", ".9\\nan", "finite numbers as PixelSpacing"),
        ("-120\\80\\-335", "-120\\80\\-inf", "finite numbers as ImagePositionPatient, the origin"),
        ("1\\0\\0\\0\\1\\0", "1\\0\\0\\1\\0\\0", "at right angles"),
    ],
)
def test_a_slice_with_a_header_of_its_own_is_refused(tmp_path: Path, old: str, new: str, told: str) -> None:
    write_series(tmp_path)
    file = sorted(tmp_path.iterdir())[2]  # the third slice, at -335 mm
    whole = file.read_bytes()
    assert whole.count(old.encode()) == 1
    file.write_bytes(whole.replace(old.encode(), new.encode()))
    with pytest.raises(StudyError, match=told):
        read_volume(tmp_path)
