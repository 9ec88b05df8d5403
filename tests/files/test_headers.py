"""Images whose header or bytes are not all there are refused."""

from __future__ import annotations

import gzip
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from stored_images import stored_image

from study.errors import StudyError
from study.files.volumes import read_volume


def nrrd_without(path: Path, *fields: str) -> None:
    sitk.WriteImage(stored_image(), str(path))
    header, data = path.read_bytes().split(b"\n\n", 1)
    kept = [line for line in header.split(b"\n") if not line.startswith(tuple(f.encode() for f in fields))]
    path.write_bytes(b"\n".join(kept) + b"\n\n" + data)


def test_missing_geometry_is_refused(tmp_path: Path) -> None:
    nrrd_without(tmp_path / "a.nrrd", "space directions", "space origin", "space:", "kinds")
    with pytest.raises(StudyError, match="no spacing"):
        read_volume(tmp_path / "a.nrrd")
    nrrd_without(tmp_path / "b.nrrd", "space:")
    with pytest.raises(StudyError, match="unknown orientation"):
        read_volume(tmp_path / "b.nrrd")
    for key, message in (("ElementSpacing", "expected ElementSpacing"), ("TransformMatrix", "unknown orientation")):
        sitk.WriteImage(stored_image(), str(tmp_path / "a.mha"))
        raw = re.sub(rb"(?m)^" + key.encode() + rb" = .*\n", b"", (tmp_path / "a.mha").read_bytes())
        (tmp_path / "b.mha").write_bytes(raw)
        with pytest.raises(StudyError, match=message):
            read_volume(tmp_path / "b.mha")


def nifti(path: Path, *edits: tuple[str, int, list[float]]) -> None:
    """A NIfTI file with header fields overwritten: (struct code, offset, values)."""
    sitk.WriteImage(stored_image(), str(path))
    raw = bytearray(path.read_bytes())
    for code, offset, values in edits:
        struct.pack_into(f"<{len(values)}{code}", raw, offset, *values)
    path.write_bytes(bytes(raw))


def test_faulty_nifti_headers_are_refused(tmp_path: Path) -> None:
    nifti(tmp_path / "a.nii", ("h", 252, [0, 0]))  # qform_code, sform_code
    with pytest.raises(StudyError, match="unknown orientation"):
        read_volume(tmp_path / "a.nii")
    nifti(tmp_path / "b.nii", ("f", 80, [0.7, 0.9, 0.0]), ("h", 252, [1, 0]))  # pixdim
    with pytest.raises(StudyError, match="positive voxel spacing"):
        read_volume(tmp_path / "b.nii")
    sheared = [-0.7, 0, 0, 120, 0, -0.9, 0.6, -80, 0, 0, 2.5, -340]  # srow: a tilted gantry
    nifti(tmp_path / "c.nii", ("h", 252, [0, 2]), ("f", 280, sheared))
    with pytest.raises(StudyError, match="orthogonal"):
        read_volume(tmp_path / "c.nii")


def test_damaged_and_wrong_files_are_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noisy = sitk.GetImageFromArray(rng.integers(-1000, 1000, (20, 40, 40)).astype(np.int16))
    for suffix in (".nii", ".nii.gz", ".nrrd", ".mha"):
        whole = tmp_path / f"whole{suffix}"
        sitk.WriteImage(noisy, str(whole), useCompression=suffix != ".nii")
        (tmp_path / f"cut{suffix}").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
        with pytest.raises(StudyError, match=f"cut{suffix}.*truncated"):
            read_volume(tmp_path / f"cut{suffix}")
    (tmp_path / "empty.nii.gz").write_bytes(gzip.compress(b""))
    with pytest.raises(StudyError, match="truncated"):
        read_volume(tmp_path / "empty.nii.gz")
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((8, 9), np.int16)), str(tmp_path / "flat.mha"))
    with pytest.raises(StudyError, match="3-D image"):
        read_volume(tmp_path / "flat.mha")
    colour = sitk.GetImageFromArray(np.zeros((4, 5, 6, 3), np.int16), isVector=True)
    sitk.WriteImage(colour, str(tmp_path / "colour.mha"))
    with pytest.raises(StudyError, match="one value a voxel"):
        read_volume(tmp_path / "colour.mha")
    with pytest.raises(StudyError, match="nothing there"):
        read_volume(tmp_path / "absent.nii.gz")
    (tmp_path / "a.jpg").write_bytes(b"x")
    with pytest.raises(StudyError, match="convert the file"):
        read_volume(tmp_path / "a.jpg")
