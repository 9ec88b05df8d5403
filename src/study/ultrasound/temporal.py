"""Temporal calibration: how late the images are stamped against the robot's poses (sec. II-B)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar
from scipy.signal import correlate, correlation_lags

from study.errors import StudyError
from study.types import Floats

MIN_LAG_S = -0.1  # lags from here are searched: images are late, clocks may be off
MIN_SAMPLES = 20  # of depths, and of heights


@dataclass(frozen=True)
class LatencyCalibration:
    """How late the image stream is against the robot's (sec. II-B).

    Attributes:
        latency_s: stamps of frames minus stamps of poses for the same moment.
        correlation: of depth and height at that lag, 0-1.
        sd_s: standard error of the latency, from the scatter about the fit.
        period_s: period of the motion.
        residual: root mean square misfit, in the unit of the depths.
        n_frames: frames compared.
    """

    latency_s: float
    correlation: float
    sd_s: float
    period_s: float
    residual: float
    n_frames: int


def calibrate_latency(
    depths: ArrayLike,
    image_times: ArrayLike,
    heights: ArrayLike,
    robot_times: ArrayLike,
    *,
    max_lag_s: float = 0.6,
    min_correlation: float = 0.9,
    min_periodicity: float = 0.8,
) -> LatencyCalibration:
    """Latency of the images from a periodic up-and-down motion over a fixed landmark (sec. II-B).

    The probe looks down: as the tool rises the landmark moves away from it, so depth is ``a + b height`` with
    b > 0 and both a and b fitted. Every lag is judged on the same frames, between the robot's samples too.

    Args:
        depths: (f,) depth of the landmark in each image, pixels or mm; NaN where it was not seen.
        image_times: (f,) s, need not be evenly spaced.
        heights: (p,) height of the tool, mm.
        robot_times: (p,) s, rising.
        max_lag_s: lags of ``MIN_LAG_S`` to this are searched.
        min_correlation: refuse a poorer match.
        min_periodicity: refuse a motion whose repetition correlates less with itself.

    Returns:
        The latency with how well depth follows height and how far it can be trusted.

    Raises:
        StudyError: no periodic motion, a period too short to tell the lags apart, too few frames, or a poor match.
    """
    run = _check_recording(depths, image_times, heights, robot_times)
    period_s = _period_s(run.robot_times, run.heights, min_periodicity)
    if period_s <= max_lag_s - MIN_LAG_S:
        raise StudyError(
            f"expected a period longer than the lags searched ({max_lag_s - MIN_LAG_S:.2f} s), got {period_s:.2f} s:"
            " lags a period apart look alike; move more slowly or lower max_lag_s"
        )
    run = _frames_at_every_lag(run, max_lag_s)
    latency_s, match = _best_lag(run, max_lag_s)
    if match < min_correlation:
        raise StudyError(
            f"expected depth to follow height, got a best correlation of {match:.2f} (need {min_correlation:g}); check"
            " the landmark's depths"
        )
    residual, sd_s = _scatter(run, latency_s)
    return LatencyCalibration(latency_s, match, sd_s, period_s, residual, len(run.depths))


@dataclass(frozen=True)
class _Recording:
    """Depths (f,) of the landmark at ``image_times`` (f,) s, heights (p,) mm of the tool at ``robot_times`` (p,) s."""

    depths: Floats
    image_times: Floats
    heights: Floats
    robot_times: Floats

    def heights_at(self, lag_s: float) -> Floats:
        """Height (f,) mm of the tool when each frame was taken, if frames are ``lag_s`` late."""
        return np.interp(self.image_times - lag_s, self.robot_times, self.heights)

    def correlation(self, lag_s: float) -> float:
        """Of depth and height, 0 where either stands still."""
        moved = self.heights_at(lag_s)
        still = not (np.ptp(self.depths) > 0 and np.ptp(moved) > 0)
        return 0.0 if still else float(np.corrcoef(self.depths, moved)[0, 1])


def _check_recording(
    depths: ArrayLike, image_times: ArrayLike, heights: ArrayLike, robot_times: ArrayLike
) -> _Recording:
    depth, t_image = np.asarray(depths, dtype=np.float64), np.asarray(image_times, dtype=np.float64)
    height, t_robot = np.asarray(heights, dtype=np.float64), np.asarray(robot_times, dtype=np.float64)
    for name, a, b in (("depths and image_times", depth, t_image), ("heights and robot_times", height, t_robot)):
        if a.ndim != 1 or a.shape != b.shape:
            raise StudyError(f"expected {name} of one length, got shapes {a.shape} and {b.shape}")
    if len(t_robot) < MIN_SAMPLES or not np.isfinite(height).all() or not (np.diff(t_robot) > 0).all():
        raise StudyError(
            f"expected at least {MIN_SAMPLES} finite heights at rising times, got {len(t_robot)}; sort and clean them"
        )
    return _Recording(depth, t_image, height, t_robot)


def _frames_at_every_lag(run: _Recording, max_lag_s: float) -> _Recording:
    """The recording with only those frames that saw the landmark and lie inside the robot's at every lag searched."""
    early, late = run.image_times - max_lag_s, run.image_times - MIN_LAG_S
    seen = np.isfinite(run.depths) & (early >= run.robot_times[0]) & (late <= run.robot_times[-1])
    if np.count_nonzero(seen) < MIN_SAMPLES:
        raise StudyError(
            f"expected at least {MIN_SAMPLES} frames inside the robot's recording, got {np.count_nonzero(seen)};"
            " check the clocks"
        )
    return replace(run, depths=run.depths[seen], image_times=run.image_times[seen])


def _best_lag(run: _Recording, max_lag_s: float) -> tuple[float, float]:
    """The lag (s) at which depth follows height best, and their correlation there."""
    lags = np.arange(MIN_LAG_S, max_lag_s + 1e-9, 0.01)
    best = int(np.argmax([run.correlation(lag) for lag in lags]))
    if best in (0, len(lags) - 1):
        raise StudyError(
            f"expected a best match between {MIN_LAG_S:g} and {max_lag_s:g} s, got it at the end ({lags[best]:.2f} s);"
            " check the clocks, the sign of the heights, or raise max_lag_s"
        )
    fit = minimize_scalar(
        lambda lag: -run.correlation(lag),
        bounds=(lags[best - 1], lags[best + 1]),
        method="bounded",
        options={"xatol": 1e-5},
    )
    return float(fit.x), -float(fit.fun)


def _scatter(run: _Recording, latency_s: float) -> tuple[float, float]:
    """Root mean square misfit of the depths, in their unit, and the standard error (s) of the latency it leaves."""
    moved = run.heights_at(latency_s)
    slope, offset = np.polyfit(moved, run.depths, 1)
    residual = float(np.sqrt(np.mean((run.depths - offset - slope * moved) ** 2)))
    tool_speed = np.gradient(run.heights, run.robot_times)
    speed = slope * np.interp(run.image_times - latency_s, run.robot_times, tool_speed)
    return residual, residual / float(np.sqrt(np.sum(speed**2)))


def _period_s(times: Floats, heights: Floats, min_periodicity: float) -> float:
    """Period of the motion, or a refusal: the first strong peak of the heights' autocorrelation."""
    step = float(np.median(np.diff(times)))
    grid = np.arange(times[0], times[-1], step)
    signal = np.interp(grid, times, heights)
    signal = signal - np.polyval(np.polyfit(grid - grid[0], signal, 1), grid - grid[0])
    n = len(signal)
    if signal.std() <= 1e-3 * max(np.ptp(heights), 1e-9) or n < MIN_SAMPLES:
        raise StudyError(
            "expected a tool that moves up and down, got one that stands still or drifts; repeat the motion"
        )
    # Correlation of the signal with itself, each lag normalised by the samples that overlap.
    overlap = correlate(signal, signal)[correlation_lags(n, n) >= 0] / np.arange(n, 0, -1)
    below = np.flatnonzero(overlap[: n // 2] < 0)
    lags = np.arange(below[0], n // 2) if below.size else np.arange(0)
    peaks = lags[1:-1][(overlap[lags[1:-1]] >= overlap[lags[:-2]]) & (overlap[lags[1:-1]] >= overlap[lags[2:]])]
    if not peaks.size:
        raise StudyError(
            "expected a motion of at least two periods, got none that repeats; move up and down for longer"
        )
    # Multiples of the period match as well: the first peak nearly as high as the best is the period itself.
    lag = int(peaks[overlap[peaks] >= 0.9 * overlap[peaks].max()][0])
    periodicity = float(np.corrcoef(signal[:-lag], signal[lag:])[0, 1])
    if not periodicity >= min_periodicity:
        raise StudyError(
            f"expected a periodic motion, got a repetition of only {periodicity:.2f} (need {min_periodicity:g}); repeat"
            " the up-and-down motion evenly"
        )
    return lag * step
