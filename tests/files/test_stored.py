"""Pixels are read as ITK reads them, and a file that its checksum does not confirm is never an image."""

from __future__ import annotations

import bz2
import gzip
import zlib
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from stored_images import LPS_TO_RAS, SPACING

from study.errors import StudyError
from study.files.volumes import read_volume

FLIPS = 40  # files of each format
ANY_HEADER = zlib.MAX_WBITS | 32  # zlib's or gzip's


def chest_like(dtype: type = np.int16) -> sitk.Image:
    """Soft shapes and noise: a stream with literals, matches and more than one block."""
    rng = np.random.default_rng(5)
    k, j, i = np.meshgrid(*[np.linspace(-1, 1, n) for n in (20, 40, 36)], indexing="ij")
    values = np.where(i**2 + j**2 + k**2 < 0.7, rng.normal(60, 9, i.shape), 0)
    image = sitk.GetImageFromArray(values.clip(0, 120).astype(dtype))
    image.SetSpacing(SPACING)
    image.SetOrigin((-120.0, 80.0, -340.0))
    return image


def written(path: Path, dtype: type = np.int16) -> Path:
    sitk.WriteImage(chest_like(dtype), str(path), useCompression=True)
    return path


def stream_start(path: Path) -> int:
    """Where the compressed stream begins: before it stands a header in plain text, which has no checksum."""
    raw = path.read_bytes()
    return {".gz": 0, ".nrrd": raw.find(b"\n\n") + 2, ".mha": raw.find(b"LOCAL\n") + 6}[path.suffix]


def same_content(packed: bytes, other: bytes) -> bool:
    """Whether zlib finds a sound stream with the same content in both."""
    try:
        return zlib.decompress(packed, ANY_HEADER) == zlib.decompress(other, ANY_HEADER)
    except zlib.error:
        return False


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd", ".mha"])
def test_one_flipped_bit_is_always_seen(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path / f"whole{suffix}")
    whole, start = path.read_bytes(), stream_start(path)
    packed = whole[start:]
    assert len(zlib.decompress(packed, ANY_HEADER)) >= 20 * 40 * 36 * 2
    first = {".mha": 2}.get(suffix, 10)  # gzip's and zlib's own headers: the next test
    refused = unchanged = 0
    for bit in np.random.default_rng(11).permutation(np.arange(8 * first, 8 * len(packed))):
        flipped = bytearray(packed)
        flipped[bit // 8] ^= 1 << (bit % 8)
        if same_content(bytes(flipped), packed):  # a bit that deflate does not use: one in a hundred in so small a file
            unchanged += 1
            continue
        path.write_bytes(whole[:start] + bytes(flipped))
        with pytest.raises(StudyError, match=r"damaged|truncated|behind"):
            read_volume(path)
        refused += 1
        if refused == FLIPS:
            break
    assert refused == FLIPS
    assert unchanged <= 4


def test_a_flip_in_gzip_s_own_header_is_refused_or_changes_nothing(tmp_path: Path) -> None:
    path = written(tmp_path / "whole.nii.gz")
    whole, expected = path.read_bytes(), read_volume(path).values
    same = 0
    for bit in range(80):
        flipped = bytearray(whole)
        flipped[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(bytes(flipped))
        try:
            values = read_volume(path).values
        except StudyError:
            continue
        np.testing.assert_array_equal(values, expected)
        same += 1
    assert same == 49  # time of writing (32), compression hint (8), system (8), "is text" (1)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".nrrd", ".mha"])
def test_bytes_behind_the_end_and_bytes_missing_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    sitk.WriteImage(chest_like(), str(path), useCompression=suffix != ".nii")
    whole = path.read_bytes()
    for changed in (whole + b"\0", whole + b"tail", whole + whole, whole[:-1], whole[:-9]):
        path.write_bytes(changed)
        with pytest.raises(StudyError, match=r"truncated|damaged|behind|left over"):
            read_volume(path)


def test_a_header_that_asks_for_more_or_less_than_there_is(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mha")
    whole = path.read_bytes()
    for size, told in ((b"36 40 19", "left over"), (b"36 40 21", "truncated"), (b"3600 4000 2000", "cannot hold")):
        path.write_bytes(whole.replace(b"DimSize = 36 40 20", b"DimSize = " + size))
        with pytest.raises(StudyError, match=told):
            read_volume(path)
    path.write_bytes(whole.replace(b"CompressedDataSize = ", b"CompressedDataSize = 1"))
    with pytest.raises(StudyError, match="compressed bytes"):
        read_volume(path)


@pytest.mark.parametrize("dtype", [np.uint8, np.int8, np.uint16, np.int16, np.int32, np.uint32, np.float32, np.float64])
@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd", ".mha", ".mhd", ".nhdr"])
def test_every_type_is_read_as_itk_reads_it(tmp_path: Path, suffix: str, dtype: type) -> None:
    path = written(tmp_path / f"a{suffix}", dtype)
    volume = read_volume(path)
    image = sitk.ReadImage(str(path))
    expected = sitk.GetArrayFromImage(image).T[::-1, ::-1]  # LPS to RAS
    assert volume.values.dtype == (np.float32 if dtype is np.float64 else dtype)
    np.testing.assert_array_equal(volume.values, expected.astype(volume.values.dtype))
    last = np.array(image.TransformIndexToPhysicalPoint((35, 39, 0))) * LPS_TO_RAS
    np.testing.assert_allclose(volume.T_ras_index.translation, last, atol=1e-4)


def test_big_endian_and_rescaled_files_are_read_as_itk_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "a.nrrd"
    sitk.WriteImage(chest_like(), str(path))
    header, data = path.read_bytes().split(b"\n\n", 1)
    swapped = np.frombuffer(data, "<i2").astype(">i2").tobytes()
    path.write_bytes(header.replace(b"endian: little", b"endian: big") + b"\n\n" + swapped)
    np.testing.assert_array_equal(read_volume(path).values, sitk.GetArrayFromImage(chest_like()).T[::-1, ::-1])
    path = tmp_path / "a.nii"
    sitk.WriteImage(chest_like(), str(path))
    raw = bytearray(path.read_bytes())
    raw[112:120] = np.array([0.37, -1024.3], "<f4").tobytes()  # scl_slope, scl_inter
    path.write_bytes(bytes(raw))
    values = read_volume(path).values
    assert values.dtype == np.float32
    np.testing.assert_array_equal(values, sitk.GetArrayFromImage(sitk.ReadImage(str(path))).T[::-1, ::-1])


def test_bzip2_and_files_of_several_gzip_members(tmp_path: Path) -> None:
    path = tmp_path / "a.nrrd"
    sitk.WriteImage(chest_like(), str(path))
    expected = read_volume(path).values
    header, data = path.read_bytes().split(b"\n\n", 1)
    packed = bz2.compress(data)
    bzip2 = header.replace(b"encoding: raw", b"encoding: bzip2") + b"\n\n"
    path.write_bytes(bzip2 + packed)
    np.testing.assert_array_equal(read_volume(path).values, expected)
    for damaged in (packed[:-4], packed + b"tail", packed[:900] + bytes([packed[900] ^ 16]) + packed[901:]):
        path.write_bytes(bzip2 + damaged)
        with pytest.raises(StudyError, match=r"truncated|damaged|behind"):
            read_volume(path)
    sitk.WriteImage(chest_like(), str(tmp_path / "a.nii"))
    plain = (tmp_path / "a.nii").read_bytes()
    (tmp_path / "b.nii.gz").write_bytes(gzip.compress(plain[:5000]) + gzip.compress(plain[5000:]))
    np.testing.assert_array_equal(read_volume(tmp_path / "b.nii.gz").values, expected)


def test_pixels_beside_the_header_must_be_one_file(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mhd")
    text = path.read_text(encoding="latin-1")
    for name in ("LIST", "slice%03d.raw 1 9 1", "absent.raw"):
        path.write_text(text.replace("a.zraw", name), encoding="latin-1")
        with pytest.raises(StudyError, match="one file of pixels"):
            read_volume(path)
