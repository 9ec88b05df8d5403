"""Quiet breathing: of the published spread, no sine, and about the mean of the long run."""

import numpy as np
import pytest

from study.ultrasound.breathing import (
    BREATHS_PER_MIN,
    DEPTH_CV,
    DURATION_CV,
    INSPIRATION,
    MAX_PAUSE,
    SHAPES,
    quiet_breathing,
)

STEP_S = 0.02
LONG_S = np.arange(0, 3600, STEP_S)  # some thousand breaths


@pytest.fixture(scope="module", params=range(4))
def hour(request):
    """An hour of one person, 4 mm deep."""
    return quiet_breathing(LONG_S, 4.0, np.random.default_rng(request.param))


def peaks_of(s):
    return 1 + np.flatnonzero((s[1:-1] > s[:-2]) & (s[1:-1] >= s[2:]))


def test_depth_and_pace_are_those_asked_for_and_published(hour):
    peaks = peaks_of(hour)
    depth = hour[peaks] - hour.min()
    assert depth.mean() == pytest.approx(4.0, rel=0.05)
    assert depth.std() / depth.mean() == pytest.approx(DEPTH_CV, abs=0.04)
    assert BREATHS_PER_MIN[0] * 0.95 < len(peaks) / 60 < BREATHS_PER_MIN[1] * 1.05
    slope = np.diff(hour)
    lasted_s = np.diff(np.flatnonzero((slope[1:] > 0) & (slope[:-1] <= 0))) * STEP_S  # from one rise to the next
    assert lasted_s.std() / lasted_s.mean() == pytest.approx(DURATION_CV, abs=0.03)
    assert len(lasted_s) == pytest.approx(len(peaks), rel=0.01)


def test_the_truth_is_the_mean_of_the_long_run(hour):
    assert abs(hour.mean()) < 0.08


def test_breaths_rise_faster_than_they_fall_and_rest_between(hour):
    slope = np.diff(hour)
    rising, resting = (slope > 0).mean(), (slope == 0).mean()
    assert rising == pytest.approx(INSPIRATION, abs=0.02)
    assert resting == pytest.approx((1 - INSPIRATION) * MAX_PAUSE / 2, abs=0.02)
    assert hour.max() > 1.3 * -hour.min()  # longer near the end of expiration than near that of inspiration


def test_no_sine_fits(hour):
    s, t = hour[:15000:5], LONG_S[:15000:5]  # five minutes
    left = []
    for hertz in np.arange(0.125, 0.5, 0.002):
        waves = np.column_stack([np.sin(2 * np.pi * hertz * t), np.cos(2 * np.pi * hertz * t), np.ones(len(t))])
        left.append(((s - waves @ np.linalg.lstsq(waves, s)[0]) ** 2).mean())
    assert min(left) > 0.5 * s.var()


def test_at_any_time_the_mean_over_people_is_the_truth():
    """Also at the start: a sweep meets a person at any phase."""
    times = np.array([0.0, 0.9, 7.0])
    drawn = np.array([quiet_breathing(times, 4.0, np.random.default_rng([7, k])) for k in range(3000)])
    error = drawn.std(axis=0) / np.sqrt(len(drawn))
    assert (np.abs(drawn.mean(axis=0)) < 4 * error).all()
    assert (error < 0.04).all()


def test_people_differ_in_pace_and_shape():
    low = [-quiet_breathing(LONG_S[:6000], 4.0, np.random.default_rng(seed)).min() for seed in range(12)]
    assert len({round(float(value), 6) for value in low}) == len(SHAPES)  # the mean's height above the rest


def test_a_moment_is_seen_as_it_is_in_a_long_run():
    long = quiet_breathing(LONG_S[:5000], 4.0, np.random.default_rng(3))
    for n in (1, 2, 30, 3000):
        np.testing.assert_array_equal(quiet_breathing(LONG_S[:n], 4.0, np.random.default_rng(3)), long[:n])


def test_the_size_scales_it_and_0_is_none_at_all():
    four, one, none = (quiet_breathing(LONG_S[:5000], size, np.random.default_rng(3)) for size in (4.0, 1.0, 0.0))
    np.testing.assert_allclose(four, 4 * one, atol=1e-12)
    assert not none.any()
