"""The recordings that both calibrations of sec. II-B need, made up with a truth that is known."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from study.types import Floats
from study.ultrasound.probe import Probe


def simulate_latency_run(
    latency_s: float,
    rng: np.random.Generator,
    *,
    amplitude_mm: float = 10.0,
    period_s: float = 2.0,
    duration_s: float = 20.0,
    noise_px: float = 1.0,
    probe: Probe | None = None,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Depths and heights as `calibrate_latency` needs them: the probe over a landmark, up and down (sec. II-B).

    Args:
        latency_s: how late the images are stamped.
        rng: draws the phase of the motion, the stamps and the noise.
        amplitude_mm: of the motion, from its middle.
        period_s: of the motion.
        duration_s: of the recording.
        noise_px: standard deviation of the depths.
        probe: its rates and pixels; the default one when None.

    Returns:
        depths (f,) pixels and stamps (f,) s of the images, unevenly spaced; heights (p,) mm and stamps (p,) s of
        the robot.
    """
    probe = probe or Probe()
    phase = rng.uniform(0, 2 * np.pi)

    def height(t: Floats) -> Floats:
        return amplitude_mm * np.sin(2 * np.pi * t / period_s + phase)

    robot_times = np.arange(0.0, duration_s, 1 / probe.poses_per_s)
    taken = np.arange(0.0, duration_s, 1 / probe.frames_per_s)
    taken = np.sort(taken + rng.uniform(-0.01, 0.01, len(taken)))
    depths = (20.0 + height(taken)) / probe.pixel_mm + noise_px * rng.normal(size=len(taken))
    return depths, taken + latency_s, height(robot_times), robot_times


def simulate_calibration_views(
    rng: np.random.Generator,
    *,
    n_views: int = 60,
    tilt_deg: float = 40.0,
    noise_px: float = 0.5,
    probe: Probe | None = None,
) -> tuple[Floats, Floats]:
    """Pixels and poses as `calibrate_spatial` needs them: one point all over the image, the probe tilted and turned.

    Args:
        rng: draws the views and the noise.
        n_views: number of views.
        tilt_deg: largest tilt about either axis of the face; the probe turns three times as far.
        noise_px: standard deviation of the pixels per axis.
        probe: its image and ``T_probe_image``; the default one when None.

    Returns:
        pixels (n, 2), column and row of the point in each view; poses (n, 4, 4) ``T_base_probe``, mm.
    """
    probe = probe or Probe()
    rows, columns = probe.shape
    pixels = rng.uniform([0.0, 0.1 * rows], [columns - 1.0, rows - 1.0], (n_views, 2))
    angles = rng.uniform(-tilt_deg, tilt_deg, (n_views, 3)) * [1.0, 1.0, 3.0] + [180.0, 0.0, 0.0]
    rotation = Rotation.from_euler("xyz", angles, degrees=True)
    seen = probe.T_probe_image.apply(np.column_stack([pixels * probe.pixel_mm, np.zeros(n_views)]))
    poses = np.tile(np.eye(4), (n_views, 1, 1))
    poses[:, :3, :3] = rotation.as_matrix()
    poses[:, :3, 3] = np.array([500.0, -200.0, 80.0]) - rotation.apply(seen)
    return pixels + noise_px * rng.normal(size=pixels.shape), poses
