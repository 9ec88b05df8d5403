"""Every fault of a NIfTI header has its own error."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK as sitk
from stored_images import stored_image

from study.errors import StudyError
from study.files.nifti import HEADER_BYTES, LAYOUT
from study.files.volumes import read_volume

NAN, INF = float("nan"), float("inf")


def damaged(folder: Path, changes: dict[str, Any]) -> Path:
    """A small image after changes to its header."""
    sitk.WriteImage(stored_image(), str(folder / "plain.nii"))
    raw = bytearray((folder / "plain.nii").read_bytes())
    names, formats, offsets = zip(*LAYOUT, strict=True)
    kind = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": HEADER_BYTES})
    header = np.ndarray(1, kind, buffer=raw)[0]
    for key, value in changes.items():
        header[key] = value
    (folder / "a.nii.gz").write_bytes(gzip.compress(bytes(raw), mtime=0))
    return folder / "a.nii.gz"


MOVED = [[-0.7, 0, 0, 120], [0, -0.9, 0, -80], [0, 0, 2.5, -335]]  # 5 mm from the qform
MIRRORED = [[0.7, 0, 0, 120], [0, -0.9, 0, -80], [0, 0, 2.5, -340]]
STEPS = [[-0.7, 0, 0, 120], [0, -0.9, 0, -80], [0, 0, 3.5, -340]]

FAULTS = [
    ({"magic": b"ni1"}, "magic"),
    ({"magic": b""}, "magic"),
    ({"pixdim": [1, 0.7, 0.9, NAN, 0, 0, 0, 0]}, "positive voxel spacing, got pixdim"),
    ({"pixdim": [1, 0.7, INF, 2.5, 0, 0, 0, 0]}, "positive voxel spacing, got pixdim"),
    ({"pixdim": [1, 0.0, 0.9, 2.5, 0, 0, 0, 0]}, "positive voxel spacing, got pixdim"),
    ({"pixdim": [1, -0.7, 0.9, 2.5, 0, 0, 0, 0]}, "positive voxel spacing, got pixdim"),
    ({"sform_code": 0, "qform_code": 0}, "unknown orientation"),
    ({"srow": STEPS}, "one voxel spacing, got .* in pixdim and .* in the sform"),
    ({"srow": MOVED}, r"qform and an sform whose corners are 5\.00 mm apart"),
    ({"srow": MIRRORED}, "qform and an sform"),
    ({"srow": [[-0.7, 0, 0, NAN], *MOVED[1:]]}, "finite origin, got sform"),
    ({"srow": [[NAN, 0, 0, 120], *MOVED[1:]]}, "finite sform"),
    ({"qoffset": [INF, 0, 0]}, "finite origin, got qoffset"),
    ({"quatern": [1.0, 1.0, 0.0]}, "unit quaternion"),
    ({"quatern": [NAN, 0.0, 0.0]}, "unit quaternion"),
    ({"xyzt_units": 1}, "mm as the unit of space, got metres"),
    ({"xyzt_units": 3 + 8}, "mm as the unit of space, got micrometres"),
    ({"xyzt_units": 5}, "mm as the unit of space, got code 5"),
    ({"datatype": 128, "bitpix": 24}, "colour"),
    ({"datatype": 4, "bitpix": 8}, "number type and its size"),
    ({"datatype": 7}, "number type and its size"),
    ({"dim": [3, 6, 7, -5, 1, 1, 1, 1]}, "sizes of 1-7 axes"),
    ({"dim": [9, 6, 7, 5, 1, 1, 1, 1]}, "sizes of 1-7 axes"),
    ({"dim": [4, 6, 7, 5, 2, 1, 1, 1]}, "3-D image, got 6 x 7 x 5 x 2"),
    ({"vox_offset": 100}, "pixels behind the header"),
    ({"scl_slope": NAN}, "finite rescaling"),
    ({"scl_slope": 1, "scl_inter": INF}, "finite rescaling"),
]


@pytest.mark.parametrize(("changes", "told"), FAULTS)
def test_each_fault_is_told(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    with pytest.raises(StudyError, match=rf"^a\.nii\.gz: expected .*{told}"):
        read_volume(damaged(tmp_path, changes))


@pytest.mark.parametrize(
    "changes",
    [{}, {"xyzt_units": 0}, {"xyzt_units": 2 + 8}, {"sform_code": 0}, {"qform_code": 0}, {"scl_slope": 0},
     {"dim": [4, 6, 7, 5, 1, 1, 1, 1]}, {"srow": [[-0.70003, 0, 0, 120.05], [0, -0.9, 0, -80], [0, 0, 2.5, -340]]}],
)  # fmt: skip
def test_what_real_writers_do_is_read(tmp_path: Path, changes: dict[str, Any]) -> None:
    (tmp_path / "other").mkdir()
    sitk.WriteImage(stored_image(), str(tmp_path / "other" / "whole.nii"))
    expected = read_volume(tmp_path / "other" / "whole.nii")
    volume = read_volume(damaged(tmp_path, changes))
    np.testing.assert_array_equal(volume.values, expected.values)
    np.testing.assert_allclose(volume.T_ras_index.translation, expected.T_ras_index.translation, atol=0.1)


def test_a_damaged_file_is_called_damaged_even_where_its_header_reads_oddly(tmp_path: Path) -> None:
    path = damaged(tmp_path, {"xyzt_units": 1})
    whole = gzip.compress(gzip.decompress(path.read_bytes()) + bytes(1 << 20))  # the end is blocks away
    path.write_bytes(whole)
    with pytest.raises(StudyError, match="got metres"):
        read_volume(path)
    path.write_bytes(whole[:-6] + bytes([whole[-6] ^ 1]) + whole[-5:])
    with pytest.raises(StudyError, match="checksum"):
        read_volume(path)


def test_version_2_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.nii").write_bytes((540).to_bytes(4, "little") + bytes(800))
    with pytest.raises(StudyError, match="got version 2; save it"):
        read_volume(tmp_path / "a.nii")
