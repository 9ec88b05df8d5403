"""A tracked sweep of random frames and poses, and whether two are the same to the last bit."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from study.types import RigidTransform
from study.ultrasound.tracked import TrackedSweep


def make_sweep(**changes):
    rng = np.random.default_rng(7)
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.02, (40, 3)), axis=0)).as_matrix()
    poses[:, :3, 3] = np.cumsum(rng.normal(size=(40, 3)), axis=0) + np.array([300, -20, 500])
    given = {
        "frame_times_s": 1000.268 + np.cumsum(rng.uniform(0.01, 0.05, 9)),
        "poses": poses,
        "pose_times_s": 1000 + 0.0123456789 * np.arange(40),
        "pose_valid": np.arange(40) != 30,
        "masks": rng.random((9, 11, 13)) < 0.3,
        "pixel_spacing_mm": (0.2, 0.1234567890123456),
        "T_probe_image": RigidTransform.random(rng),
        "latency_s": 0.268,
        "name": "us:test 1",
    }
    return TrackedSweep(**{**given, **changes})


def assert_identical(a: TrackedSweep, b: TrackedSweep) -> None:
    for field in dataclasses.fields(TrackedSweep):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            assert y is not None, field.name
            assert x.dtype == y.dtype, field.name
            np.testing.assert_array_equal(x, y, err_msg=field.name)
        elif isinstance(x, RigidTransform):
            np.testing.assert_array_equal(x.matrix, y.matrix)
        else:
            assert x == y, field.name
