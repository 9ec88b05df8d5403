from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from planted_registration import SOURCE, T_US_CT, planted
from scipy.spatial import KDTree

from study.errors import StudyError
from study.files.atomic import sha256_of
from study.files.transforms import Grid, grid_around, read_grid, sample_field, write_field, write_rigid
from study.types import RigidTransform

FLIP = np.diag([-1.0, -1.0, 1.0])


def lps_image(values: np.ndarray, origin: np.ndarray, spacing: float, path: Path) -> Path:
    """An image (i, j, k) along x, y, z of LPS."""
    image = sitk.GetImageFromArray(np.ascontiguousarray(values.T))
    image.SetOrigin(origin.tolist())
    image.SetSpacing([spacing] * 3)
    sitk.WriteImage(image, str(path))
    return path


def test_simpleitk_maps_places_of_the_us_frame_to_the_ct(tmp_path: Path) -> None:
    write_rigid(T_US_CT, tmp_path / "rigid.tfm")
    transform = sitk.ReadTransform(str(tmp_path / "rigid.tfm"))
    for ct, us in zip(SOURCE[:5], T_US_CT.apply(SOURCE[:5]), strict=True):
        assert np.allclose(FLIP @ transform.TransformPoint((FLIP @ us).tolist()), ct, rtol=0, atol=1e-9)
    assert (tmp_path / "rigid.tfm").read_text(encoding="utf-8").startswith("#Insight Transform File V1.0")


@pytest.mark.parametrize(("field", "limit_mm"), [(True, 0.5), (False, 1.0)])
def test_resampling_by_the_field_lands_the_ct_where_warped_is(tmp_path: Path, field: bool, limit_mm: float) -> None:
    """SimpleITK resamples balls of a CT onto a grid of the US frame; each must come to lie at its warped point."""
    result = planted(field=field)
    grid = grid_around(result.warped, 4.0)
    made = sample_field(result, grid)
    write_field(made, tmp_path / "d.nii.gz")
    chosen = [
        int(np.argmin(np.linalg.norm(SOURCE - place, axis=1)))
        for place in np.add(SOURCE.mean(0), [[-60, 0, 0], [50, 0, 40]])
    ]
    origin = FLIP @ np.array([SOURCE[:, 0].max() + 20, SOURCE[:, 1].max() + 20, SOURCE[:, 2].min() - 20])
    sizes = np.ceil((np.ptp(SOURCE, axis=0) + 40) / 2).astype(int)
    voxels = origin + 2.0 * np.stack(np.meshgrid(*map(np.arange, sizes), indexing="ij"), axis=-1)
    transform = sitk.DisplacementFieldTransform(
        sitk.Cast(sitk.ReadImage(str(tmp_path / "d.nii.gz")), sitk.sitkVectorFloat64)
    )
    reference = sitk.Image(*[int(n) for n in grid.shape], sitk.sitkUInt8)
    reference.SetOrigin((FLIP @ grid.origin).tolist())
    reference.SetSpacing(grid.spacing_mm.tolist())
    reference.SetDirection((FLIP @ grid.axes).ravel().tolist())
    for point in chosen:
        ball = (np.linalg.norm(voxels - FLIP @ SOURCE[point], axis=-1) < 8.0).astype(np.float32)
        ct = sitk.ReadImage(str(lps_image(ball, origin, 2.0, tmp_path / "ct.nii.gz")))
        moved = sitk.GetArrayFromImage(sitk.Resample(ct, reference, transform, sitk.sitkLinear)).T
        weight = moved / moved.sum()
        centre = grid.to_mm(np.argwhere(weight > 0).astype(float)).T @ weight[weight > 0]
        assert np.linalg.norm(centre - result.warped[point]) < limit_mm
        assert np.linalg.norm(result.warped[point] - T_US_CT.apply(SOURCE[point])) > 2 * limit_mm  # the bend counts


def test_the_field_says_how_well_it_takes_points_back() -> None:
    result = planted()
    made = sample_field(result, grid_around(result.warped, 3.0))
    assert made.in_grid_share == 1.0
    assert made.unknown_share == 0.0
    assert made.return_mm.shape == (len(SOURCE),)
    assert made.return_mm.max() < 0.2  # of interpolating between knots


@pytest.mark.parametrize(
    "turn", [np.eye(3), np.diag([-1.0, -1.0, 1.0]), RigidTransform.random(np.random.default_rng(2)).rotation]
)
def test_the_field_lies_on_the_grid_of_the_file_in_its_own_order(tmp_path: Path, turn: np.ndarray) -> None:
    result = planted()
    image = sitk.Image(24, 30, 36, sitk.sitkInt16)
    image.SetSpacing((9.0, 8.0, 7.0))
    image.SetDirection(turn.ravel().tolist())
    centre = FLIP @ result.warped.mean(axis=0)
    image.SetOrigin((centre - turn @ (np.array([24, 30, 36]) * [9.0, 8.0, 7.0] / 2)).tolist())
    sitk.WriteImage(image, str(tmp_path / "us.nii.gz"))
    grid = read_grid(tmp_path / "us.nii.gz")
    write_field(sample_field(result, grid), tmp_path / "d.nii.gz")
    written = sitk.ReadImage(str(tmp_path / "d.nii.gz"))
    assert written.GetSize() == image.GetSize()
    assert np.allclose(written.GetOrigin(), image.GetOrigin(), atol=1e-3)
    assert np.allclose(written.GetDirection(), image.GetDirection(), atol=1e-5)
    index = (13, 11, 20)
    there = np.array(image.TransformIndexToPhysicalPoint(index)) + written.GetPixel(index)
    away = KDTree(result.warped).query(FLIP @ image.TransformIndexToPhysicalPoint(index))[0]
    assert away < 50  # where the deformation is known
    assert (
        np.linalg.norm(result.carry((FLIP @ there)[None], 8)[0] - FLIP @ image.TransformIndexToPhysicalPoint(index))
        < 0.5
    )
    first = sha256_of(tmp_path / "d.nii.gz")
    write_field(sample_field(result, grid), tmp_path / "d.nii.gz")
    assert sha256_of(tmp_path / "d.nii.gz") == first


def test_grids_that_are_none_or_elsewhere_are_refused(tmp_path: Path) -> None:
    result = planted()
    with pytest.raises(StudyError, match=r"expected an image of the US frame .* got 'none\.nii\.gz'"):
        read_grid("none.nii.gz")
    with pytest.raises(StudyError, match="grid spacing of 0 to 20 mm, got -1"):
        grid_around(result.warped, -1.0)
    with pytest.raises(StudyError, match="at most 50,000,000 voxels"):
        grid_around(result.warped, 0.2)
    elsewhere = Grid((10, 10, 10), np.ones(3), np.eye(3), result.warped.max(axis=0) + 100, "ct.nii.gz")
    with pytest.raises(StudyError, match=r"ct\.nii\.gz: expected a grid around the result"):
        sample_field(result, elsewhere)
    with pytest.raises(StudyError, match=r"ending in \.nii\.gz"):
        write_field(sample_field(result, grid_around(result.warped, 15.0)), tmp_path / "d.nrrd")
    path = lps_image(np.zeros((4, 4, 4), dtype=np.int16), np.zeros(3), 1.0, tmp_path / "cut.nii.gz")
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(StudyError, match=r"cut\.nii\.gz"):
        read_grid(path)
    metres = lps_image(np.zeros((4, 4, 4), dtype=np.int16), np.zeros(3), 1.0, tmp_path / "metres.nii")
    content = bytearray(metres.read_bytes())
    content[123] = 1  # xyzt_units
    metres.write_bytes(bytes(content))
    with pytest.raises(StudyError, match=r"metres\.nii: expected mm"):
        read_grid(metres)
