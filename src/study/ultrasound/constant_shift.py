"""The part of a virtual sweep's errors that shifts the whole cloud, which nothing in the cloud can tell."""

from __future__ import annotations

import numpy as np

from study.errors import StudyError
from study.types import Floats
from study.ultrasound.cloud import upper_contour
from study.ultrasound.probe import Probe
from study.ultrasound.sweep_errors import SweepErrors
from study.ultrasound.tracked import TrackedSweep
from study.ultrasound.virtual_sweep import fat_delay_mm

_CHUNK = 256  # frames held in memory at once


def constant_shift_mm(sweep: TrackedSweep, errors: SweepErrors, probe: Probe | None = None) -> Floats:
    """Mean displacement (3,) mm, base frame, that calibration and speed of sound give a virtual sweep's contours.

    Each contour pixel is placed twice: by the calibration that the experimenter believes in, at the depth that the
    image shows; and by the true calibration, at the true depth. The mean of the differences over all contour points
    is the shift. It is exact for the same pixels and poses; what varies about it with the probe's turns is not in it,
    nor are errors without a mean of their own (latency, which changes sign with the direction of a line, tracking,
    contour; breathing, whose mean is 0 over many breaths though not over the few of one sweep).

    Truth for judging by, never for making a cloud.

    Args:
        sweep: as `study.ultrasound.simulate_sweep` made it.
        errors: under which.
        probe: with which; the default one when None.

    Raises:
        StudyError: a sweep without masks or calibration, or without a contour point.
    """
    probe = probe or Probe()
    if sweep.masks is None or sweep.pixel_spacing_mm is None or sweep.T_probe_image is None:
        raise StudyError(
            f"{sweep.name}: expected a virtual sweep with masks and a calibration, got none; pass what simulate_sweep "
            "returns"
        )
    sx, sy = sweep.pixel_spacing_mm
    poses, _, tracked = sweep.frame_poses()
    used = np.flatnonzero(tracked)
    total, n = np.zeros(3), 0
    for start in range(0, len(used), _CHUNK):
        block = used[start : start + _CHUNK]
        frames, columns, rows = upper_contour(sweep.masks[block])
        depth = rows * sy
        shown = np.column_stack([columns * sx, depth, np.zeros(len(depth))])
        true = shown - np.array([0.0, 1.0, 0.0]) * fat_delay_mm(errors, depth)[:, None]
        off = sweep.T_probe_image.apply(shown) - probe.T_probe_image.apply(true)
        total += np.einsum("nij,nj->i", poses[block][frames, :3, :3], off)
        n += len(off)
    if not n:
        raise StudyError(f"{sweep.name}: expected a contour in some tracked frame, got none; check the sweep")
    return total / n
