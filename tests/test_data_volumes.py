"""Images keep their place: every orientation, every format, and no guessed geometry."""

from __future__ import annotations

import gzip
import itertools
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from study.data.volumes import check_same_grid, read_labels, read_masks, read_volume, write_volume
from study.errors import StudyError
from study.types import RigidTransform, Volume

SPACING = (0.7, 0.9, 2.5)
SIZE = (6, 7, 5)
MARKED = (4, 1, 3)  # voxel i, j, k of the stored image
LPS_TO_RAS = np.array([-1.0, -1.0, 1.0])


def stored_image(direction: np.ndarray | None = None, dtype: type = np.int16) -> sitk.Image:
    values = np.full(SIZE[::-1], -1000, dtype=dtype)
    values[MARKED[::-1]] = 300
    image = sitk.GetImageFromArray(values)
    image.SetSpacing(SPACING)
    image.SetOrigin((-120.0, 80.0, -340.0))
    image.SetDirection((np.eye(3) if direction is None else direction).ravel().tolist())
    return image


def axis_directions() -> list[np.ndarray]:
    """The 48 ways to store a volume with its axes along R/L, A/P, S/I."""
    return [
        np.eye(3)[:, list(order)] * np.array(signs)
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]


def marked_mm(volume: Volume) -> np.ndarray:
    return volume.to_mm(np.argwhere(volume.values == 300))[0]


def test_every_orientation_lands_at_the_same_millimetres(tmp_path: Path) -> None:
    directions = axis_directions()
    assert len(directions) == 48
    for direction in directions:
        image = stored_image(direction)
        sitk.WriteImage(image, str(tmp_path / "a.nrrd"))
        volume = read_volume(tmp_path / "a.nrrd")
        expected = np.array(image.TransformIndexToPhysicalPoint(MARKED)) * LPS_TO_RAS
        np.testing.assert_allclose(marked_mm(volume), expected, atol=1e-6)
        np.testing.assert_allclose(volume.T_ras_index.rotation, np.eye(3), atol=1e-9)
        assert volume.values.sum() == sitk.GetArrayViewFromImage(image).sum()


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".nrrd", ".mha"])
def test_every_format_keeps_an_oblique_grid(tmp_path: Path, suffix: str) -> None:
    tilted = RigidTransform.random(np.random.default_rng(3)).rotation
    image = stored_image(tilted)
    sitk.WriteImage(image, str(tmp_path / f"a{suffix}"))
    volume = read_volume(tmp_path / f"a{suffix}")
    expected = np.array(image.TransformIndexToPhysicalPoint(MARKED)) * LPS_TO_RAS
    np.testing.assert_allclose(marked_mm(volume), expected, atol=1e-3)
    assert (np.diag(volume.T_ras_index.rotation) > 0).all()
    np.testing.assert_allclose(sorted(volume.spacing_mm), sorted(SPACING), atol=1e-6)


def test_write_then_read_gives_the_same_volume_and_the_same_bytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frame = RigidTransform(RigidTransform.random(rng).rotation, np.array([10.0, -20.0, 30.0]))
    small = Volume(rng.integers(-1000, 1000, (5, 6, 7)).astype(np.int16), np.array([1.0, 2.0, 3.0]), frame)
    first = write_volume(small, tmp_path / "a" / "x.nii.gz")
    second = write_volume(small, tmp_path / "y.nii.gz")
    assert first.read_bytes() == second.read_bytes()
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["y.nii.gz"]
    again = read_volume(first)
    corners = np.array(list(itertools.product((0, 4), (0, 5), (0, 6))))
    rows = np.rint(again.to_index(small.to_mm(corners))).astype(int)
    assert (again.values[tuple(rows.T)] == small.values[tuple(corners.T)]).all()
    with pytest.raises(StudyError, match=r"\.nii\.gz"):
        write_volume(small, tmp_path / "x.nrrd")


def test_index_and_millimetres_are_inverse_and_crop_stays_in_place() -> None:
    rng = np.random.default_rng(1)
    volume = Volume(rng.normal(size=(8, 9, 10)), np.array([0.7, 0.8, 2.5]), RigidTransform.random(rng))
    index = rng.uniform(0, 8, (20, 3))
    np.testing.assert_allclose(volume.to_index(volume.to_mm(index)), index, atol=1e-9)
    np.testing.assert_allclose(volume.to_mm(index), index @ volume.affine[:3, :3].T + volume.affine[:3, 3], atol=1e-9)
    part = volume.crop([2, 3, 4], [6, 99, 8])
    assert part.shape == (4, 6, 4)
    np.testing.assert_allclose(part.to_mm([[1, 1, 1]]), volume.to_mm([[3, 4, 5]]))
    assert part.values[1, 1, 1] == volume.values[3, 4, 5]
    with pytest.raises(ValueError, match="read-only"):
        part.values[0, 0, 0] = 1.0


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


def test_labels_must_be_whole_and_on_the_grid(tmp_path: Path) -> None:
    ct = Volume(np.zeros((6, 7, 5), np.int16), np.array(SPACING), name="ct")
    labels = write_volume(ct.with_values(np.ones(ct.shape, np.float32)), tmp_path / "l.nii.gz")
    read = read_labels(labels, like=ct)
    assert np.issubdtype(read.values.dtype, np.integer)
    assert (read.values == 1).all()
    with pytest.raises(StudyError, match="fractions"):
        read_labels(write_volume(ct.with_values(np.full(ct.shape, 0.5, np.float32)), tmp_path / "f.nii.gz"))
    with pytest.raises(StudyError, match="expected the grid of ct"):
        read_labels(labels, like=ct.crop([0, 0, 0], [6, 7, 4]))
    moved = Volume(ct.values, ct.spacing_mm, RigidTransform(translation=np.array([0.0, 0.5, 0.0])), "moved")
    with pytest.raises(StudyError, match=r"0\.50 mm away"):
        check_same_grid(moved, ct)


def test_one_file_per_structure_becomes_one_label_volume(tmp_path: Path) -> None:
    grid = Volume(np.zeros((6, 7, 5), np.float32), np.array(SPACING), name="ct")
    paths = {}
    for index, name in enumerate(("sternum", "rib_left_2")):
        values = np.zeros(grid.shape, np.float32)
        values[index] = 1.0
        paths[name] = write_volume(grid.with_values(values), tmp_path / f"{name}.nii.gz")
    labels, ids = read_masks(paths, like=grid)
    assert (labels.values == ids["rib_left_2"]).sum() == (labels.values == ids["sternum"]).sum() == 35
    assert labels.values[1, 0, 0] == ids["rib_left_2"]
    with pytest.raises(StudyError, match="at least one mask"):
        read_masks({})
