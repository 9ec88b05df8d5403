"""Calibration and masks to cloud, against planted truth."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation, Slerp

from study.errors import StudyError
from study.types import RigidTransform
from study.us import (
    TrackedSweep,
    calibrate_latency,
    calibrate_spatial,
    contour_points,
    sweep_cloud,
    thin_evenly,
    upper_contour,
)

T_PROBE_IMAGE = RigidTransform(Rotation.from_euler("xyz", [88, 3, -5], degrees=True).as_matrix(), [-25.0, 4.0, 120.0])


def flat_sweep(**changes):
    """60 frames pushed along y at 20 mm/s over a flat bone 20 mm deep, poses at 100 Hz, 0.1 s latency."""
    pose_times = np.arange(0.0, 2.5, 0.01)
    poses = np.tile(np.eye(4), (len(pose_times), 1, 1))
    poses[:, 1, 3] = 20.0 * pose_times
    masks = np.zeros((60, 60, 100), dtype=bool)
    masks[:, 40:44, 10:90] = True
    given_ = {
        "frame_times_s": 0.2 + np.arange(60) / 30,
        "poses": poses,
        "pose_times_s": pose_times,
        "pose_valid": np.ones(len(poses), dtype=bool),
        "masks": masks,
        "pixel_spacing_mm": (0.5, 0.5),
        "T_probe_image": RigidTransform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [-25, 0, 0]),
        "latency_s": 0.1,
    }
    return TrackedSweep(**{**given_, **changes})


def test_poses_are_interpolated_as_scipy_does_with_the_latency_taken_out():
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.005, 0.02, 50))
    rotations = Rotation.random(50, random_state=rng)
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations.as_matrix(), rng.normal(size=(50, 3)) * 100
    asked = np.sort(rng.uniform(times[0], times[-1], 30))
    sweep = flat_sweep(
        frame_times_s=asked + 0.268,
        latency_s=0.268,
        poses=poses,
        pose_times_s=times,
        pose_valid=np.ones(50, dtype=bool),
        masks=np.ones((30, 4, 4), dtype=bool),
    )
    found, inside, tracked = sweep.frame_poses()
    assert inside.all()
    assert tracked.all()
    np.testing.assert_allclose(found[:, :3, :3], Slerp(times, rotations)(asked).as_matrix(), atol=1e-9)
    expected = np.column_stack([np.interp(asked, times, poses[:, i, 3]) for i in range(3)])
    np.testing.assert_allclose(found[:, :3, 3], expected, atol=1e-9)


def test_frames_without_a_pose_are_dropped_and_counted():
    sweep = flat_sweep()
    valid = sweep.pose_valid.copy()
    valid[100:120] = False  # 1.00-1.19 s: frames shown from 0.99 to 1.20 s have no valid neighbour
    masks = sweep.masks.copy()
    masks[5] = False
    cut = dataclasses.replace(sweep, pose_valid=valid, masks=masks, latency_s=0.3)
    shown = sweep.frame_times_s - 0.3
    outside = shown < 0
    lost = (shown > 0.99) & (shown < 1.2)
    report = sweep_cloud(cut).report
    assert (report.n_outside, report.n_untracked, report.n_empty) == (outside.sum(), lost.sum(), 1)
    assert report.n_dropped == outside.sum() + lost.sum() > 0
    assert report.n_contour == (60 - report.n_dropped - 1) * 80


def test_a_long_gap_between_poses_is_not_interpolated():
    sweep = flat_sweep()
    gap = (sweep.pose_times_s < 0.995) | (sweep.pose_times_s > 1.515)  # frames show 1.00 to 1.50 s in it
    holed = dataclasses.replace(
        sweep, poses=sweep.poses[gap], pose_times_s=sweep.pose_times_s[gap], pose_valid=sweep.pose_valid[gap]
    )
    assert sweep_cloud(holed).report.n_untracked == 16
    assert sweep_cloud(holed, max_gap_s=1.0).report.n_untracked == 0


def test_a_frame_exactly_on_the_last_pose_counts():
    sweep = flat_sweep(
        frame_times_s=[0.0, 1.0],
        latency_s=0.0,
        poses=np.tile(np.eye(4), (2, 1, 1)),
        pose_times_s=[0.0, 1.0],
        pose_valid=[True, True],
        masks=np.ones((2, 4, 4), dtype=bool),
    )
    assert sweep.frame_poses()[2].all()


def test_cloud_of_a_flat_bone_lies_on_it_and_knows_its_front():
    result = sweep_cloud(flat_sweep(), spacing_mm=1.5)
    points = result.cloud.points
    # Rows 39 and 40 meet at 39.5 pixels of 0.5 mm.
    np.testing.assert_allclose(points[:, 2], 19.75, atol=1e-9)
    np.testing.assert_allclose(result.beam, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(result.front, [0, 0, -1], atol=1e-12)
    assert points[:, 1].min() == pytest.approx(20 * 0.1, abs=0.75)
    assert points[:, 1].max() == pytest.approx(20 * (0.1 + 59 / 30), abs=0.75)
    assert result.cloud.parts is None


def test_upper_contour_is_the_first_pixel_of_each_column():
    rng = np.random.default_rng(1)
    masks = rng.random((7, 20, 15)) < 0.1
    frames, columns, rows = upper_contour(masks)
    expected = [
        (f, c, np.flatnonzero(masks[f, :, c])[0] - 0.5) for f in range(7) for c in range(15) if masks[f, :, c].any()
    ]
    assert len(expected) > 50
    assert list(zip(frames, columns, rows, strict=True)) == expected


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1.0, 4.0))
def test_thinning_is_even(seed, spacing_mm):
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(0, 60, (8000, 2)) ** [1.0, 1.2], rng.normal(0, 0.05, 8000)])
    thinned = thin_evenly(points, spacing_mm)
    assert KDTree(thinned).query(thinned, k=2)[0][:, 1].min() >= spacing_mm
    # An averaged point is at most a cube's diagonal from the points it stands for.
    assert KDTree(thinned).query(points)[0].max() <= spacing_mm * (1 + np.sqrt(3) / 2)


def test_inputs_are_not_written_to_and_outputs_are_read_only():
    masks = np.zeros((60, 60, 100), dtype=bool)
    masks[:, 30, :] = True
    masks.flags.writeable = False
    sweep = flat_sweep(masks=masks)
    sweep_cloud(sweep)
    assert masks.sum() == 6000
    with pytest.raises(ValueError, match="read-only"):
        sweep.masks[0, 0, 0] = True


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"masks": None, "images": np.zeros((60, 5, 5), np.uint8)}, "annotate the frames"),
        ({"T_probe_image": None}, "calibrate_spatial"),
        ({"masks": np.zeros((60, 5, 5), bool)}, "empty ones"),
        ({"latency_s": 5.0}, "outside the"),
        ({"pose_valid": np.zeros(250, bool)}, "valid pose"),
    ],
)
def test_a_sweep_that_gives_no_cloud_says_why(changes, message):
    with pytest.raises(StudyError, match=message):
        sweep_cloud(flat_sweep(**changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frame_times_s": np.zeros(0)}, "at least one"),
        ({"frame_times_s": np.r_[0.5, 0.4, np.arange(58) + 1.0]}, "row 1"),
        ({"pose_times_s": np.zeros(250)}, "rising pose_times_s"),
        ({"frame_times_s": np.r_[np.arange(59), np.nan]}, "finite frame_times_s"),
        ({"pose_valid": np.ones(3, bool)}, "pose_valid"),
        ({"masks": np.zeros((59, 5, 5), bool)}, "masks of shape"),
        ({"masks": None}, "got neither"),
        ({"images": np.zeros((60, 5, 5))}, "as large as"),
        ({"pixel_spacing_mm": (0.5, 50.0)}, "check the units"),
        ({"latency_s": 268.0}, "milliseconds"),
        ({"poses": np.tile(np.diag([1.0, 1.0, -1.0, 1.0]), (250, 1, 1))}, "proper rotations"),
        ({"poses": np.full((250, 4, 4), np.nan)}, "proper rotations"),
    ],
)
def test_a_malformed_sweep_is_refused(changes, message):
    with pytest.raises(StudyError, match=message):
        flat_sweep(**changes)


def test_uncorrected_latency_moves_points_by_speed_times_lag():
    right, _, _, _ = contour_points(flat_sweep(latency_s=0.1))
    wrong, _, _, _ = contour_points(flat_sweep(latency_s=0.0))
    np.testing.assert_allclose(wrong - right, np.broadcast_to([0, 20 * 0.1, 0], right.shape), atol=1e-9)


# --- temporal calibration -----------------------------------------------------------------------------------------


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


# --- spatial calibration ------------------------------------------------------------------------------------------


def views(seed, n=60, tilt_deg=40.0, noise_px=0.5, spacing=(0.2, 0.2), point=(500.0, -200.0, 80.0), offsets=None):
    """Pixels of a point phantom and the poses that saw it; ``offsets`` moves the point along a wire per view."""
    rng = np.random.default_rng(seed)
    uv = np.column_stack([rng.uniform(0, 254, n), rng.uniform(20, 170, n)])
    targets = np.broadcast_to(point, (n, 3)) + (0 if offsets is None else offsets)
    angles = rng.uniform(-tilt_deg, tilt_deg, (n, 3)) * [1, 1, 3]
    rotations = Rotation.from_euler("xyz", angles + np.array([180, 0, 0]), degrees=True)
    image = np.column_stack([uv * spacing, np.zeros(n)])
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = rotations.as_matrix()
    poses[:, :3, 3] = targets - rotations.apply(T_PROBE_IMAGE.apply(image))
    return uv + noise_px * rng.normal(size=uv.shape), poses


def check(found, spacing=(0.2, 0.2)):
    error = T_PROBE_IMAGE.inverse @ found.T_probe_image
    assert np.linalg.norm(found.T_probe_image.translation - T_PROBE_IMAGE.translation) < 0.3
    assert error.angle_deg < 0.3
    np.testing.assert_allclose(found.pixel_spacing_mm, spacing, rtol=0.005)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(50, 120), tilt_deg=st.floats(30, 60), sy=st.floats(0.1, 0.2))
def test_point_phantom_within_a_third_of_a_millimetre_and_degree(seed, n, tilt_deg, sy):
    found = calibrate_spatial(*views(seed, n, tilt_deg, spacing=(0.2, sy)))
    check(found, (0.2, sy))
    np.testing.assert_allclose(found.point, [500, -200, 80], atol=0.3)
    # 0.5 px in each of two axes
    assert found.residual_mm == pytest.approx(0.5 * np.hypot(0.2, sy), rel=0.3)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), tilt_deg=st.floats(30, 60))
def test_wire_phantom_within_a_third_of_a_millimetre_and_degree(seed, tilt_deg):
    rng = np.random.default_rng([seed, 1])
    n = 90
    start = np.array([[500.0, -200, 80], [500, -180, 80], [520, -200, 100]])
    along = np.array([[1.0, 0, 0], [0, 1, 0.2], [0.7, 0.7, 0]])
    which = np.arange(n) % 3
    met = start[which] + rng.uniform(-40, 40, n)[:, None] * along[which]
    pixels, poses = views(seed, n, tilt_deg, point=(0, 0, 0), offsets=met)
    wires = np.stack([start[which] - 50 * along[which], start[which] + 50 * along[which]], axis=1)
    check(calibrate_spatial(pixels, poses, wires=wires))


def test_known_spacing_is_kept():
    found = calibrate_spatial(*views(4, noise_px=0.0), pixel_spacing_mm=(0.2, 0.2))
    assert found.pixel_spacing_mm == (0.2, 0.2)
    np.testing.assert_allclose(found.T_probe_image.matrix, T_PROBE_IMAGE.matrix, atol=1e-6)
    assert found.residual_mm < 1e-6


def test_stated_error_of_the_calibration_is_the_scatter_seen():
    found = [calibrate_spatial(*views(seed, noise_px=1.0)) for seed in range(30)]
    scatter = np.std([f.T_probe_image.translation for f in found], axis=0).max()
    assert np.mean([f.sd_mm for f in found]) == pytest.approx(scatter, rel=0.4)


@pytest.mark.parametrize(("tilt_deg", "noise_px"), [(0.0, 0.0), (0.0, 0.5), (0.05, 0.5), (0.5, 0.5)])
def test_views_too_much_alike_are_refused(tilt_deg, noise_px):
    with pytest.raises(StudyError, match="tilt the probe"):
        calibrate_spatial(*views(0, tilt_deg=tilt_deg, noise_px=noise_px))


def test_malformed_views_are_refused():
    pixels, poses = views(0)
    with pytest.raises(StudyError, match="at least 10"):
        calibrate_spatial(pixels[:5], poses[:5])
    with pytest.raises(StudyError, match="finite pixels"):
        calibrate_spatial(pixels[:, :1], poses)
    with pytest.raises(StudyError, match="finite pixels"):
        calibrate_spatial(np.full_like(pixels, np.nan), poses)
    with pytest.raises(StudyError, match="different points of a wire"):
        calibrate_spatial(pixels, poses, wires=np.zeros((60, 2, 3)))


def test_thinning_does_not_hang_on_the_last_bit() -> None:
    """A mask's columns are an exact fraction of a millimetre apart; another processor's rounding keeps the points."""
    grid = np.stack(np.meshgrid(np.arange(60), np.arange(60), indexing="ij"), axis=-1).reshape(-1, 2) * 0.75
    points = np.column_stack([grid, np.zeros(len(grid))]) + 0.1  # twice the step is the spacing, to the last bit
    noise = np.random.default_rng(0).normal(scale=1e-13, size=points.shape)
    kept, again = thin_evenly(points, 1.5), thin_evenly(points + noise, 1.5)
    assert kept.shape == again.shape
    assert np.abs(kept - again).max() < 1e-9
