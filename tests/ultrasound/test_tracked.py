"""A tracked sweep: poses between poses, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from small_sweeps import flat_sweep

from study.errors import StudyError


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
