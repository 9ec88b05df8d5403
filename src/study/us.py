"""Tracked ultrasound: temporal and spatial calibration, masks to cloud (sec. II-A to II-C.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import correlate, correlation_lags
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.types import Bools, Floats, Ints, PointCloud, RigidTransform, TrackedSweep

__all__ = [
    "LatencyCalibration",
    "SpatialCalibration",
    "SweepCloud",
    "SweepReport",
    "TrackedSweep",
    "calibrate_latency",
    "calibrate_spatial",
    "contour_points",
    "sweep_cloud",
    "thin_evenly",
    "upper_contour",
]


@dataclass(frozen=True)
class SweepReport:
    """What became of the frames of a sweep.

    Attributes:
        n_frames: frames given.
        n_outside: dropped, taken outside the tracked interval.
        n_untracked: dropped, no valid pose before or after, or too long a gap between them.
        n_empty: used, but with nothing in their mask.
        n_contour: contour points of the frames used.
        n_points: points left after thinning.
    """

    n_frames: int
    n_outside: int
    n_untracked: int
    n_empty: int
    n_contour: int
    n_points: int

    @property
    def n_dropped(self) -> int:
        """Frames without a usable pose."""
        return self.n_outside + self.n_untracked


@dataclass(frozen=True)
class SweepCloud:
    """The cloud of a sweep, and what the sweep knows beyond its points.

    Attributes:
        cloud: points (n, 3) mm in the base frame, no parts.
        beam: (3,) unit vector, the mean direction in which the beams looked, base frame.
        report: frames used and dropped.
    """

    cloud: PointCloud
    beam: Floats
    report: SweepReport

    @property
    def front(self) -> Floats:
        """(3,) unit vector from the anatomy towards the skin, base frame."""
        return -self.beam


def upper_contour(masks: Bools) -> tuple[Ints, Ints, Floats]:
    """The edge of each mask that faces the transducer.

    Args:
        masks: (f, h, w) bool, row 0 at the transducer.

    Returns:
        frame (n,), column (n,) and row (n,) of the edge. It lies between the first pixel inside and the one above,
        so rows are half numbers: the first pixel's own centre would put every surface half a pixel too deep.
    """
    frames, columns = np.nonzero(masks.any(axis=1))
    # Bytes of a C-ordered (f, w, h) copy are searched an order of magnitude faster than strided columns.
    first = np.ascontiguousarray(masks.transpose(0, 2, 1)).argmax(axis=2)
    return frames.astype(np.int64), columns.astype(np.int64), first[frames, columns] - 0.5


def contour_points(
    sweep: TrackedSweep, *, max_gap_s: float = 0.25, chunk: int = 256
) -> tuple[Floats, Ints, Floats, SweepReport]:
    """All contour points of a sweep in the base frame, before thinning.

    Args:
        sweep: masks, poses and calibration.
        max_gap_s: longest time between two poses that may be interpolated.
        chunk: frames held in memory at once.

    Returns:
        points (n, 3) mm, base frame; frame index (n,) of each; beam (3,), unit mean direction over the points;
        the report, with ``n_points`` still 0.

    Raises:
        StudyError: no masks, no spatial calibration, no usable frame, or nothing in any mask.
    """
    if sweep.masks is None:
        raise StudyError(f"{sweep.name}: expected a mask per frame, got B-mode only; annotate the frames first")
    if sweep.pixel_spacing_mm is None or sweep.T_probe_image is None:
        raise StudyError(
            f"{sweep.name}: expected pixel_spacing_mm and T_probe_image, got none; give your calibration, or estimate"
            " one with calibrate_spatial"
        )
    poses, inside, tracked = sweep.frame_poses(max_gap_s)
    used = np.flatnonzero(tracked)
    n_outside = int((~inside).sum())
    n_untracked = int((inside & ~tracked).sum())
    if not used.size:
        raise StudyError(
            f"{sweep.name}: expected frames with a valid pose, got none of {sweep.n_frames}: {n_outside} outside the"
            f" tracked interval, {n_untracked} with no valid pose around them; check that both clocks agree and the"
            " latency"
        )
    parts = []
    for start in range(0, len(used), chunk):
        block = used[start : start + chunk]
        frames, columns, rows = upper_contour(sweep.masks[block])
        parts.append((block[frames], columns, rows))
    frames, columns, rows = (np.concatenate([part[i] for part in parts]) for i in range(3))
    if not len(frames):
        raise StudyError(f"{sweep.name}: expected bone in some mask, got {len(used)} empty ones; check the annotation")
    sx, sy = sweep.pixel_spacing_mm
    pixels = np.column_stack([columns * sx, rows * sy, np.zeros(len(rows))])
    T_base_image = poses @ sweep.T_probe_image.matrix
    points = np.einsum("nij,nj->ni", T_base_image[frames, :3, :3], pixels) + T_base_image[frames, :3, 3]
    beam = T_base_image[frames, :3, 1].mean(axis=0)
    report = SweepReport(
        n_frames=sweep.n_frames,
        n_outside=n_outside,
        n_untracked=n_untracked,
        n_empty=len(used) - len(np.unique(frames)),
        n_contour=len(points),
        n_points=0,
    )
    return points, frames, beam / np.linalg.norm(beam), report


def thin_evenly(points: Floats, spacing_mm: float) -> Floats:
    """Thin (n, 3) mm points to an even density: no two closer than ``spacing_mm``, no hole wider than about twice.

    Points are first averaged in cubes of half the spacing, which takes the noise down where frames overlap, then
    kept greedily (Poisson-disc thinning).
    """
    if not spacing_mm > 0:
        raise StudyError(f"expected a spacing above 0 mm, got {spacing_mm!r}")
    # Columns of one frame are an exact fraction of a millimetre apart, so many points would lie on the side of a cube,
    # and many distances be the spacing, to the last bit, which differs between machines. A third of a cube and 1 nm
    # put each of them clearly on one side.
    cells = np.floor((points - points.min(axis=0)) / (spacing_mm / 2) + 1 / 3).astype(np.int64)
    _, member, count = np.unique(
        np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_inverse=True, return_counts=True
    )
    means = np.column_stack([np.bincount(member, points[:, axis]) for axis in range(3)]) / count[:, None]
    pairs = KDTree(means).query_pairs(spacing_mm + 1e-6, output_type="ndarray")
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    ends = np.searchsorted(pairs[:, 0], np.arange(len(means) + 1))
    kept = np.ones(len(means), dtype=bool)
    for i in range(len(means)):
        if kept[i]:
            kept[pairs[ends[i] : ends[i + 1], 1]] = False
    return means[kept]


def sweep_cloud(sweep: TrackedSweep, *, spacing_mm: float = 1.5, max_gap_s: float = 0.25) -> SweepCloud:
    """The cloud of a sweep (sec. II-C.2): upper contours, mapped to the base frame, thinned.

    Args:
        sweep: masks, poses, calibration and latency.
        spacing_mm: distance between neighbouring points of the cloud.
        max_gap_s: longest time between two poses that may be interpolated.

    Raises:
        StudyError: no masks, no calibration, no usable frame, nothing in the masks, or too few points for a chest.
    """
    points, _, beam, report = contour_points(sweep, max_gap_s=max_gap_s)
    thinned = thin_evenly(points, spacing_mm)
    counted = replace(report, n_points=len(thinned))
    return SweepCloud(PointCloud(thinned, sweep.name), beam, counted)


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


def _period_s(times: Floats, heights: Floats, min_periodicity: float) -> float:
    """Period of the motion, or a refusal: the first strong peak of the heights' autocorrelation."""
    step = float(np.median(np.diff(times)))
    grid = np.arange(times[0], times[-1], step)
    signal = np.interp(grid, times, heights)
    signal = signal - np.polyval(np.polyfit(grid - grid[0], signal, 1), grid - grid[0])
    n = len(signal)
    if signal.std() <= 1e-3 * max(np.ptp(heights), 1e-9) or n < 20:
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
        max_lag_s: lags of -0.1 s to this are searched.
        min_correlation: refuse a poorer match.
        min_periodicity: refuse a motion whose repetition correlates less with itself.

    Raises:
        StudyError: no periodic motion, a period too short to tell the lags apart, too few frames, or a poor match.
    """
    depth, t_image = np.asarray(depths, dtype=np.float64), np.asarray(image_times, dtype=np.float64)
    height, t_robot = np.asarray(heights, dtype=np.float64), np.asarray(robot_times, dtype=np.float64)
    for name, a, b in (("depths and image_times", depth, t_image), ("heights and robot_times", height, t_robot)):
        if a.ndim != 1 or a.shape != b.shape:
            raise StudyError(f"expected {name} of one length, got shapes {a.shape} and {b.shape}")
    if len(t_robot) < 20 or not np.isfinite(height).all() or not (np.diff(t_robot) > 0).all():
        raise StudyError(
            f"expected at least 20 finite heights at rising times, got {len(t_robot)}; sort and clean them"
        )
    period_s = _period_s(t_robot, height, min_periodicity)
    min_lag_s = -0.1
    if period_s <= max_lag_s - min_lag_s:
        raise StudyError(
            f"expected a period longer than the lags searched ({max_lag_s - min_lag_s:.2f} s), got {period_s:.2f} s:"
            " lags a period apart look alike; move more slowly or lower max_lag_s"
        )
    seen = np.isfinite(depth) & (t_image - max_lag_s >= t_robot[0]) & (t_image - min_lag_s <= t_robot[-1])
    depth, t_image = depth[seen], t_image[seen]
    if len(depth) < 20:
        raise StudyError(
            f"expected at least 20 frames inside the robot's recording, got {len(depth)}; check the clocks"
        )

    def correlation(lag_s: float) -> float:
        moved = np.interp(t_image - lag_s, t_robot, height)
        return float(np.corrcoef(depth, moved)[0, 1]) if np.ptp(depth) > 0 and np.ptp(moved) > 0 else 0.0

    lags = np.arange(min_lag_s, max_lag_s + 1e-9, 0.01)
    best = int(np.argmax([correlation(lag) for lag in lags]))
    if best in (0, len(lags) - 1):
        raise StudyError(
            f"expected a best match between {min_lag_s:g} and {max_lag_s:g} s, got it at the end ({lags[best]:.2f} s);"
            " check the clocks, the sign of the heights, or raise max_lag_s"
        )
    fit = minimize_scalar(
        lambda lag: -correlation(lag),
        bounds=(lags[best - 1], lags[best + 1]),
        method="bounded",
        options={"xatol": 1e-5},
    )
    latency_s, match = float(fit.x), -float(fit.fun)
    if match < min_correlation:
        raise StudyError(
            f"expected depth to follow height, got a best correlation of {match:.2f} (need {min_correlation:g}); check"
            " the landmark's depths"
        )
    moved = np.interp(t_image - latency_s, t_robot, height)
    slope, offset = np.polyfit(moved, depth, 1)
    residual = float(np.sqrt(np.mean((depth - offset - slope * moved) ** 2)))
    speed = slope * np.interp(t_image - latency_s, t_robot, np.gradient(height, t_robot))
    sd_s = residual / float(np.sqrt(np.sum(speed**2)))
    return LatencyCalibration(latency_s, match, sd_s, period_s, residual, len(depth))


@dataclass(frozen=True)
class SpatialCalibration:
    """Where the image lies on the probe.

    Attributes:
        T_probe_image: image frame (mm) to probe frame.
        pixel_spacing_mm: (sx, sy) mm.
        residual_mm: root mean square distance of the observations from the phantom.
        sd_mm: standard error of the translation of ``T_probe_image``, largest axis.
        sd_deg: standard error of its rotation, largest axis.
        point: (3,) mm, the point phantom in the base frame; NaN for wires.
    """

    T_probe_image: RigidTransform
    pixel_spacing_mm: tuple[float, float]
    residual_mm: float
    sd_mm: float
    sd_deg: float
    point: Floats


def calibrate_spatial(
    pixels: ArrayLike,
    poses: ArrayLike,
    *,
    wires: ArrayLike | None = None,
    pixel_spacing_mm: tuple[float, float] | None = None,
    max_sd_mm: float = 1.0,
    max_sd_deg: float = 1.0,
) -> SpatialCalibration:
    """Spatial calibration by least squares from views of a point or of wires.

    A point phantom never moves: every view must map its pixel to the same, unknown, base point. A wire phantom
    has known wires: every view must map its pixel onto its wire. A closed-form linear solution starts a
    non-linear one in which the image axes are orthogonal.

    Args:
        pixels: (n, 2) column and row of the phantom in each view.
        poses: (n, 4, 4) ``T_base_probe`` of each view, mm.
        wires: (n, 2, 3) mm, two points, in the base frame, of the wire seen in each view; None for one fixed point.
        pixel_spacing_mm: (sx, sy) when known from the machine; None to estimate it too.
        max_sd_mm: refuse a calibration whose translation is known no better.
        max_sd_deg: refuse a calibration whose rotation is known no better.

    Raises:
        StudyError: shapes, too few views, or views too much alike to fix every parameter.
    """
    uv, T = np.asarray(pixels, dtype=np.float64), np.asarray(poses, dtype=np.float64)
    n = len(uv)
    if uv.shape != (n, 2) or T.shape != (n, 4, 4) or not (np.isfinite(uv).all() and np.isfinite(T).all()):
        raise StudyError(f"expected finite pixels (n, 2) and poses (n, 4, 4), got {uv.shape} and {T.shape}")
    if n < 10:
        raise StudyError(f"expected at least 10 views of the phantom, got {n}; record more, each tilted differently")
    R, t = T[:, :3, :3], T[:, :3, 3]
    if wires is None:
        across, on_wire = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
    else:
        ends = np.asarray(wires, dtype=np.float64)
        if ends.shape != (n, 2, 3) or not (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 1e-6).all():
            raise StudyError(f"expected two different points of a wire per view ({n}, 2, 3), got {ends.shape}")
        along = ends[:, 1] - ends[:, 0]
        along = along / np.linalg.norm(along, axis=1)[:, None]
        across, on_wire = np.eye(3) - along[:, :, None] * along[:, None, :], ends[:, 0]

    # Linear start: R (u cx + v cy + t_image) + t - p = 0 in the unknowns cx, cy, t_image and, for a point, p.
    blocks = [R * uv[:, :1, None], R * uv[:, 1:, None], R]
    if wires is None:
        blocks.append(np.broadcast_to(-np.eye(3), (n, 3, 3)))
    rows = (across @ np.concatenate(blocks, axis=2)).reshape(3 * n, -1)
    right = np.einsum("nij,nj->ni", across, on_wire - t).reshape(-1)
    scale = np.linalg.norm(rows, axis=0)
    solution, _, rank, singular = np.linalg.lstsq(rows / scale, right, rcond=None)
    too_alike = StudyError(
        f"expected views that differ enough to fix the calibration, got {n} too much alike; tilt the probe about two"
        " axes, turn it, and show the phantom all over the image"
    )
    if rank < rows.shape[1] or singular[-1] < 1e-4 * singular[0]:
        raise too_alike
    solution = solution / scale
    x, y = solution[0:3], solution[3:6]
    start_rotation = Rotation.align_vectors(
        [x / np.linalg.norm(x), y / np.linalg.norm(y)], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    )[0]
    start_spacing = np.array(pixel_spacing_mm or (np.linalg.norm(x), np.linalg.norm(y)), dtype=np.float64)
    free_spacing = pixel_spacing_mm is None

    def unpack(v: Floats) -> tuple[Rotation, Floats, Floats, Floats]:
        spacing = start_spacing * np.exp(v[6:8]) if free_spacing else start_spacing
        return start_rotation * Rotation.from_rotvec(v[:3]), v[3:6], spacing, v[-3:]

    def misfit(v: Floats) -> Floats:
        rotation, translation, spacing, point = unpack(v)
        image = np.column_stack([uv * spacing, np.zeros(n)])
        base = np.einsum("nij,nj->ni", R, rotation.apply(image) + translation) + t
        return np.einsum("nij,nj->ni", across, base - (point if wires is None else on_wire)).reshape(-1)

    start = np.concatenate([np.zeros(3), solution[6:9], np.zeros(2 * free_spacing), solution[9:12]])
    fit = least_squares(misfit, start, x_scale="jac")
    n_equations = (3 if wires is None else 2) * n
    normal = fit.jac.T @ fit.jac
    if np.linalg.matrix_rank(normal, hermitian=True) < len(normal):
        raise too_alike
    variance = 2 * fit.cost / max(n_equations - len(start), 1)
    sd = np.sqrt(np.diag(np.linalg.inv(normal)) * variance)
    sd_deg, sd_mm = float(np.degrees(sd[:3]).max()), float(sd[3:6].max())
    if not (sd_mm <= max_sd_mm and sd_deg <= max_sd_deg):
        raise StudyError(
            f"expected a calibration known to {max_sd_mm:g} mm and {max_sd_deg:g} deg, got standard errors of"
            f" {sd_mm:.2f} mm and {sd_deg:.2f} deg; add views, tilt the probe more, check the pixels"
        )
    rotation, translation, spacing, point = unpack(fit.x)
    return SpatialCalibration(
        T_probe_image=RigidTransform(rotation.as_matrix(), translation),
        pixel_spacing_mm=(float(spacing[0]), float(spacing[1])),
        residual_mm=float(np.sqrt(2 * fit.cost / n)),
        sd_mm=sd_mm,
        sd_deg=sd_deg,
        point=point if wires is None else np.full(3, np.nan),
    )
