"""Images keep their place: every orientation, every format."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from stored_images import LPS_TO_RAS, MARKED, SPACING, marked_mm, stored_image

from study.errors import StudyError
from study.files.volumes import check_same_grid, read_labels, read_masks, read_volume, write_volume
from study.types import RigidTransform, Volume


def axis_directions() -> list[np.ndarray]:
    """The 48 ways to store a volume with its axes along R/L, A/P, S/I."""
    return [
        np.eye(3)[:, list(order)] * np.array(signs)
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]


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


def test_labels_must_be_whole_and_on_the_grid(tmp_path: Path) -> None:
    ct = Volume(np.zeros((6, 7, 5), np.int16), np.array(SPACING), name="ct")
    labels = write_volume(ct.with_values(np.ones(ct.shape, np.float32)), tmp_path / "l.nii.gz")
    read = read_labels(labels, like=ct)
    assert np.issubdtype(read.values.dtype, np.integer)
    assert (read.values == 1).all()
    with pytest.raises(StudyError, match="fractions"):
        read_labels(write_volume(ct.with_values(np.full(ct.shape, 0.5, np.float32)), tmp_path / "f.nii.gz"))
    for wrong in (40_000.0, -40_000.0, np.inf):
        values = np.where(np.arange(5) == 2, wrong, 1.0) * np.ones(ct.shape)
        with pytest.raises(StudyError, match="label ids of -32768 to 32767"):  # 40,000 would become -25,536
            read_labels(write_volume(ct.with_values(values.astype(np.float32)), tmp_path / "w.nii.gz"))
    values = np.where(np.arange(5) == 2, np.nan, 1.0) * np.ones(ct.shape)
    with pytest.raises(StudyError, match="fractions or NaN"):
        read_labels(write_volume(ct.with_values(values.astype(np.float32)), tmp_path / "n.nii.gz"))
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
