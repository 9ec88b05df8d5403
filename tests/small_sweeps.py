"""A chest small enough to sweep in a second, and a sweep over a flat bone whose cloud is known by arithmetic."""

import numpy as np
from skimage.measure import marching_cubes

from study.types import Mesh, Part, RigidTransform
from study.ultrasound.tracked import TrackedSweep

FRONT = (0.0, 1.0, 0.0)


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


def arch_mm(x, z):
    return -((x / 90) ** 2) * 35 - (z / 80) ** 2 * 6


def small_chest() -> Mesh:
    """A plate and eight tubes of 10 mm, arched like a small chest, marching cubes at 1.5 mm."""
    step = 1.5
    x, y, z = np.meshgrid(np.arange(-66, 67, step), np.arange(-33, 12, step), np.arange(-60, 61, step), indexing="ij")
    arch = arch_mm(x, z)
    fields = {Part.STERNUM: np.maximum.reduce([np.abs(x) - 16, np.abs(y - arch) - 5, np.abs(z) - 52])}
    for side, sign in (("right", 1), ("left", -1)):
        for level in (2, 3, 4, 5):
            height = 45 - 27 * (level - 2) - 0.15 * np.abs(x)
            tube = np.hypot(y - arch, z - height) - 5
            fields[Part.cartilage(side, level)] = np.maximum.reduce([tube, 12 - sign * x, sign * x - 60])
    stack = np.stack(list(fields.values()))
    vertices, faces, _, _ = marching_cubes(stack.min(axis=0), 0.0, spacing=(step,) * 3)
    cells = np.clip(np.rint(vertices / step).astype(int), 0, np.array(x.shape) - 1)
    parts = np.array([int(part) for part in fields])[stack[(slice(None), *cells.T)].argmin(axis=0)]
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    volume = np.einsum("ni,ni->", corners.mean(axis=1), normals)
    return Mesh(
        vertices + np.array([-66.0, -33.0, -60.0]), faces if volume > 0 else faces[:, ::-1], parts, name="chest"
    )


def depths_mm(sweep: TrackedSweep):
    """Depth of the contour per frame and column, NaN without."""
    first = sweep.masks.argmax(axis=1) * sweep.pixel_spacing_mm[1]
    return np.where(sweep.masks.any(axis=1), first, np.nan)
