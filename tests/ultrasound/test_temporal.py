"""Temporal calibration, against a latency put in."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from study.errors import StudyError
from study.ultrasound.temporal import calibrate_latency


def motion(shape: str, phase: np.ndarray) -> np.ndarray:
    """One period of an up-and-down motion, from -1 to 1."""
    if shape == "sine":
        return np.sin(phase)
    if shape == "triangle":
        return 2 / np.pi * np.arcsin(np.sin(phase))
    return np.clip(1.5 * np.sin(phase), -1, 1)  # with a pause at either end


def recording(seed, latency_s, shape="sine", amplitude_mm=10.0, period_s=1.5, noise_px=1.0, duration_s=12.0):
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi)

    def height(t):
        return 400.0 + amplitude_mm * motion(shape, 2 * np.pi * t / period_s + phase)

    robot_times = np.arange(0, duration_s, 0.01)
    taken = np.sort(rng.uniform(0, duration_s, round(30 * duration_s)))  # as uneven as frames can be
    depths = (height(taken) - 370.0) / 0.2 + noise_px * rng.normal(size=len(taken))
    return depths, taken + latency_s, height(robot_times), robot_times


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    latency_s=st.floats(0.0, 0.5),
    shape=st.sampled_from(["sine", "triangle", "pause"]),
    amplitude_mm=st.floats(5.0, 20.0),
    period_s=st.floats(0.8, 3.0),
)
def test_latency_is_recovered_within_5_ms(seed, latency_s, shape, amplitude_mm, period_s):
    found = calibrate_latency(*recording(seed, latency_s, shape, amplitude_mm, period_s))
    assert abs(found.latency_s - latency_s) < 0.005
    assert found.correlation > 0.97
    assert found.period_s == pytest.approx(period_s, rel=0.02)


def test_stated_error_of_the_latency_is_the_scatter_seen():
    found = [calibrate_latency(*recording(seed, 0.268, noise_px=3.0)) for seed in range(40)]
    scatter = np.std([f.latency_s for f in found])
    assert np.mean([f.sd_s for f in found]) == pytest.approx(scatter, rel=0.4)
    assert found[0].residual == pytest.approx(3.0, rel=0.15)


def test_frames_in_which_the_landmark_was_lost_are_left_out():
    depths, image_times, heights, robot_times = recording(3, 0.2)
    depths[::3] = np.nan
    found = calibrate_latency(depths, image_times, heights, robot_times)
    assert abs(found.latency_s - 0.2) < 0.005
    assert found.n_frames < 250


def ramp(t):
    return 5 * t


def step(t):
    return np.where(t > 6, 10.0, 0.0)


def chirp(t):
    return 10 * np.sin(2 * np.pi * (0.2 * t + 0.06 * t**2))


def wander(t):
    return np.cumsum(np.random.default_rng(5).normal(size=len(t)))


@pytest.mark.parametrize("height", [np.zeros_like, ramp, step, chirp, wander])
def test_a_motion_that_is_not_periodic_is_refused(height):
    t = np.arange(0, 12, 0.01)
    heights = height(t)
    with pytest.raises(StudyError, match=r"period|stands still"):
        calibrate_latency(np.interp(t[::3], t, heights), t[::3], heights, t)


def test_a_poor_match_is_refused():
    depths, image_times, heights, robot_times = recording(0, 0.2)
    noise = np.random.default_rng(1).normal(size=len(depths)) * 60
    with pytest.raises(StudyError, match="depth to follow height"):
        calibrate_latency(depths + noise, image_times, heights, robot_times)


def test_ambiguous_or_unusable_recordings_are_refused():
    depths, image_times, heights, robot_times = recording(0, 0.2, period_s=0.5)
    with pytest.raises(StudyError, match="longer than the lags"):
        calibrate_latency(depths, image_times, heights, robot_times)
    depths, image_times, heights, robot_times = recording(0, 0.9, period_s=2.0)
    with pytest.raises(StudyError, match="at the end"):
        calibrate_latency(depths, image_times, heights, robot_times)
    with pytest.raises(StudyError, match="inside the robot's"):
        calibrate_latency(depths, image_times + 1000, heights, robot_times)
    with pytest.raises(StudyError, match="one length"):
        calibrate_latency(depths[:-1], image_times, heights, robot_times)
    with pytest.raises(StudyError, match="rising times"):
        calibrate_latency(depths, image_times, heights, robot_times[::-1])
