"""Eq. 1: the rectangle is found where it was planted, whatever lies around it."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import correlate

from study.alignment import sternum
from study.alignment.sternum import (
    SternumParams,
    feature_plane,
    rectangle_mask,
    sternum_candidates,
    sternum_scores,
    symmetry_axis,
)
from study.errors import StudyError
from study.geometry.points import close_gaps, pixelise, sample_spacing_mm
from study.types import PointCloud, RigidTransform


def turned(points: np.ndarray, angle_deg: float) -> np.ndarray:
    """Counter-clockwise in the plane."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return points @ np.array([[c, s], [-s, c]])


def drawing(rng: np.random.Generator) -> np.ndarray:
    """A 30 × 90 mm plate and four thin bars a side, upright around the origin, (n, 2) mm."""
    plate = rng.uniform([-15, -45], [15, 45], (3000, 2))
    bars = [
        np.column_stack([side * rng.uniform(15, 60, 250), row + rng.uniform(-5, 5, 250)])
        for side in (-1, 1)
        for row in (-38, -14, 12, 38)
    ]
    return np.concatenate([plate, *bars])


def test_the_defaults_are_the_papers():
    params = SternumParams()
    assert (params.width_mm, params.height_mm) == (30, 90)
    assert params.scales_mm == (5, 3, 2)
    assert params.steps_deg == (10, 2, 1)


@pytest.mark.parametrize("angle_deg", [0.0, 37.0, -68.0, 90.0])
def test_the_planted_rectangle_is_found(angle_deg):
    centre = np.array([123.0, -45.0])
    points = turned(drawing(np.random.default_rng(0)), angle_deg) + centre
    fit = next(sternum_candidates(points))
    assert fit.overlap > 0.95
    # Two pixels of the last scale across; along, the bars at the ends leave the rectangle a little play.
    assert np.linalg.norm(fit.centre - centre) < 4.0
    assert abs((fit.angle_deg - angle_deg + 90) % 180 - 90) <= 3.0  # a rectangle is its own half turn


def test_the_best_candidate_comes_first_and_none_twice():
    fits = list(sternum_candidates(drawing(np.random.default_rng(0))))
    assert len(fits) > 1
    # Candidates come in the order of the coarse scale: a finer one may overtake, by a pixel's rounding.
    assert fits[0].overlap == max(fit.overlap for fit in fits)
    for i, one in enumerate(fits):
        for other in fits[:i]:
            apart = np.linalg.norm(one.centre - other.centre)
            assert apart > 5 or abs((one.angle_deg - other.angle_deg + 90) % 180 - 90) > 3


def test_thin_bars_alone_cover_no_sternum():
    points = drawing(np.random.default_rng(0))
    bars = points[np.abs(points[:, 0]) > 15]
    assert max(fit.overlap for fit in sternum_candidates(bars)) < SternumParams().min_overlap


def test_a_rectangle_has_one_area_at_every_angle_and_turns_counter_clockwise():
    for pixel_mm in (5.0, 3.0, 2.0):
        areas = [rectangle_mask(30, 90, pixel_mm, angle).sum() * pixel_mm**2 for angle in range(-90, 90, 10)]
        assert areas == pytest.approx([2700] * 18, rel=0.05)  # five sub-pixels of 1 mm along 30 mm round by that
    upright, half = rectangle_mask(30, 90, 2.0, 0), rectangle_mask(30, 90, 2.0, 30)
    assert np.flatnonzero(upright.any(axis=0)).size > 2 * np.flatnonzero(upright.any(axis=1)).size  # long along y
    where = np.argwhere(half > 0.5) - (len(half) - 1) / 2
    assert (where[:, 0] * where[:, 1]).sum() < 0  # its top leans to -x


@pytest.mark.parametrize(("angle_deg", "shift_mm"), [(0.0, 0.0), (11.0, 4.0), (-17.0, -6.0)])
def test_the_symmetry_axis_of_a_planted_symmetric_drawing(angle_deg, shift_mm):
    half = drawing(np.random.default_rng(1))
    half = half[half[:, 0] > 0]
    whole = np.concatenate([half, half * [-1, 1]]) + np.array([shift_mm, 0])
    angle, shift = symmetry_axis(turned(whole, angle_deg))
    assert angle == pytest.approx(angle_deg, abs=3.0)  # bars without texture leave it that much play
    assert shift == pytest.approx(shift_mm, abs=2.0)  # one pixel


@pytest.mark.parametrize("near", [None, np.array([10.0, 25.0])])
def test_the_best_place_is_eq_1_as_written(near):
    points = drawing(np.random.default_rng(3)) + np.array([10.0, 20.0])
    params, scale_mm = SternumParams(), 5.0
    pad = int(np.ceil(np.hypot(30, 90) / 2 / scale_mm)) + 1
    image, _, origin = pixelise(points, scale_mm, pad)
    image = close_gaps(image, 1).astype(np.float64)
    where = np.indices(image.shape) * scale_mm + origin[:, None, None]
    for fit in sternum._best_place(points, scale_mm, np.arange(-90.0, 90.0, 30.0), near, params, 5.0):
        mask = rectangle_mask(30, 90, scale_mm, fit.angle_deg)
        covered = correlate(image, mask, mode="same", method="direct") / mask.sum()
        if near is not None:
            covered[np.hypot(*(where - near[:, None, None])) > 12.5] = 0.0
        assert fit.overlap == pytest.approx(covered.max(), abs=1e-12)
        best = np.argwhere(covered >= covered.max() - 1e-6)
        assert fit.centre == pytest.approx(best.mean(axis=0) * scale_mm + origin, abs=1e-9)


def mirrored_literally(points):
    """The best of all turns and shifts, each mirrored view laid over the view; its angle and shift."""
    image, _, origin = pixelise(points, 2.0, pad=4)
    x, y = (np.argwhere(close_gaps(image, round(sample_spacing_mm(points)))) * 2.0 + origin).T
    best, answer = -1.0, (0.0, 0.0)
    for step, around in ((2.0, 40.0), (0.5, 2.0)):
        centre = answer[0]
        for angle in np.arange(centre - around, centre + around + step / 2, step):
            c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            across, along = c * x + s * y, c * y - s * x
            near = np.abs(across) < 55.0
            bins = (np.arange(-63.0, 64.0, 2.0), np.arange(-200.0, 201.0, 2.0))
            view = gaussian_filter(np.minimum(np.histogram2d(across[near], along[near], bins)[0], 1.0), 2.0)
            for shift in range(-8, 9):
                score = float((view * np.roll(view[::-1], shift, axis=0)).sum())
                if score > best:
                    best, answer = score, (float(angle), float(shift))
    return answer


@pytest.mark.parametrize("seed", range(4))
def test_the_symmetry_axis_is_that_of_mirrored_views_laid_over_each_other(seed):
    rng = np.random.default_rng(seed)
    points = turned(drawing(rng)[rng.random(5000) < 0.5], rng.uniform(-20, 20)) + rng.uniform(-8, 8, 2)
    assert symmetry_axis(points) == mirrored_literally(points)


def test_the_feature_plane_is_a_proper_motion_onto_the_wall(ct_clouds):
    cloud = ct_clouds["ct1"]
    motion = RigidTransform.random(np.random.default_rng(0))
    plane = feature_plane(cloud)
    assert np.linalg.det(plane.rotation) == pytest.approx(1)
    spread = plane.inverse.apply(cloud.points).std(axis=0)
    assert spread[0] > spread[1] > spread[2]
    assert abs(plane.rotation[1, 2]) > 0.8  # its normal is nearly antero-posterior
    moved = feature_plane(cloud.moved(motion))
    assert moved.matrix == pytest.approx((motion @ plane).matrix, abs=1e-6)


def test_what_spreads_over_no_plane_is_refused():
    rng = np.random.default_rng(2)
    for points in (rng.normal(scale=40, size=(500, 3)), rng.normal(size=(500, 3)) * [60, 2, 1]):
        with pytest.raises(StudyError, match="expected a chest wall spread over a plane, got principal spreads"):
            feature_plane(PointCloud(points))


def test_the_map_of_scores_peaks_where_the_search_found_the_sternum():
    points = np.random.default_rng(0).uniform([-15, -45], [15, 45], (4000, 2))
    fit = next(iter(sternum_candidates(points)))
    scores = sternum_scores(points, fit)
    peak = np.unravel_index(scores.values.argmax(), scores.values.shape) * np.array(scores.pixel_mm) + scores.origin
    assert np.linalg.norm(peak - fit.searches[0].centre) <= 2 * scores.pixel_mm
    assert scores.values.max() == pytest.approx(fit.searches[0].overlap)
    assert scores.best.max() == pytest.approx(scores.values.max())
    assert scores.best[scores.angles_deg == fit.searches[0].angle_deg] == scores.best.max()
