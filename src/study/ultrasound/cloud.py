"""From a tracked sweep to the cartilage point cloud (sec. II-C.2): masks → upper contours → base frame → thinned."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from study.errors import StudyError
from study.types import Bools, Floats, Ints, PointCloud, RigidTransform
from study.ultrasound.tracked import TrackedSweep

USED, EMPTY = "used", "nothing in its mask"
OUTSIDE, UNTRACKED = "outside the tracked time", "no valid pose before or after, or too long a gap"


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
        cloud: points (n, 3) mm in the base frame, and when each was seen, (n,) s on the poses' clock; no parts. A point
            where two lines overlap is the mean of both, and so is its time.
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
    masks, (sx, sy), T_probe_image = _check_ready(sweep)
    poses, used, n_outside, n_untracked = _usable_frames(sweep, max_gap_s)
    frames, columns, rows = _contours(masks, used, chunk)
    if not len(frames):
        raise StudyError(f"{sweep.name}: expected bone in some mask, got {len(used)} empty ones; check the annotation")
    pixels = np.column_stack([columns * sx, rows * sy, np.zeros(len(rows))])
    T_base_image = poses @ T_probe_image.matrix
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


def _check_ready(sweep: TrackedSweep) -> tuple[Bools, tuple[float, float], RigidTransform]:
    """Masks, pixel spacing and ``T_probe_image`` of an annotated, calibrated sweep."""
    if sweep.masks is None:
        raise StudyError(f"{sweep.name}: expected a mask per frame, got B-mode only; annotate the frames first")
    if sweep.pixel_spacing_mm is None or sweep.T_probe_image is None:
        raise StudyError(
            f"{sweep.name}: expected pixel_spacing_mm and T_probe_image, got none; give your calibration, or estimate"
            " one with calibrate_spatial"
        )
    return sweep.masks, sweep.pixel_spacing_mm, sweep.T_probe_image


def _usable_frames(sweep: TrackedSweep, max_gap_s: float) -> tuple[Floats, Ints, int, int]:
    """Poses (f, 4, 4) of all frames, indices (k,) of those that have one, and how many lie outside or are untracked."""
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
    return poses, used, n_outside, n_untracked


def _contours(masks: Bools, used: Ints, chunk: int) -> tuple[Ints, Ints, Floats]:
    """`upper_contour` of the used frames, ``chunk`` of them at once; frames are numbered as in the sweep."""
    parts = []
    for start in range(0, len(used), chunk):
        block = used[start : start + chunk]
        frames, columns, rows = upper_contour(masks[block])
        parts.append((block[frames], columns, rows))
    frames, columns, rows = (np.concatenate([part[i] for part in parts]) for i in range(3))
    return frames, columns, rows


def frame_fates(sweep: TrackedSweep, *, max_gap_s: float = 0.25) -> list[str]:
    """What becomes of each frame in `sweep_cloud`: ``"used"``, or why it gives no point.

    Raises:
        StudyError: no masks.
    """
    if sweep.masks is None:
        raise StudyError(f"{sweep.name}: expected a mask per frame, got B-mode only; annotate the frames first")
    _, inside, tracked = sweep.frame_poses(max_gap_s)
    filled = [bool(mask.any()) for mask in sweep.masks]
    return [
        OUTSIDE if not within else UNTRACKED if not seen else EMPTY if not full else USED
        for within, seen, full in zip(inside, tracked, filled, strict=True)
    ]


def thin_evenly(points: Floats, spacing_mm: float) -> Floats:
    """Thin (n, 3) mm points to an even density: no two closer than ``spacing_mm``, no hole wider than about twice.

    Points are first averaged in cubes of half the spacing, which takes the noise down where frames overlap, then
    kept greedily (Poisson-disc thinning).

    Args:
        points: (n, 3 + c): mm, and columns that follow their points, such as times.
        spacing_mm: least distance between two points kept.

    Returns:
        (k, 3 + c): averages, not members of ``points``.

    Raises:
        StudyError: a spacing of 0 or less.
    """
    if not spacing_mm > 0:
        raise StudyError(f"expected a spacing above 0 mm, got {spacing_mm!r}")
    # Columns of one frame are an exact fraction of a millimetre apart, so many points would lie on the side of a cube,
    # and many distances be the spacing, to the last bit, which differs between machines. A third of a cube and 1 nm
    # put each of them clearly on one side.
    places = points[:, :3]
    cells = np.floor((places - places.min(axis=0)) / (spacing_mm / 2) + 1 / 3).astype(np.int64)
    _, member, count = np.unique(
        np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_inverse=True, return_counts=True
    )
    means = np.column_stack([np.bincount(member, column) for column in points.T]) / count[:, None]
    pairs = KDTree(means[:, :3]).query_pairs(spacing_mm + 1e-6, output_type="ndarray")
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

    Returns:
        The cloud in the base frame, the direction of the beams and a report of the frames used and dropped.

    Raises:
        StudyError: no masks, no calibration, no usable frame, nothing in the masks, or too few points for a chest.

    A probe pushed along y at 20 mm/s over a flat bone 20 mm deep:

    >>> from study.types import RigidTransform
    >>> times = np.arange(40) / 20  # s; one pose for each frame
    >>> poses = np.tile(np.eye(4), (40, 1, 1))
    >>> poses[:, 1, 3] = 20 * times
    >>> masks = np.zeros((40, 60, 100), dtype=bool)
    >>> masks[:, 40:44] = True  # rows of 0.5 mm; the upper edge lies between rows 39 and 40
    >>> T_probe_image = RigidTransform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [-25, 0, 0])
    >>> sweep = TrackedSweep(times, poses, times, np.ones(40), masks, None, (0.5, 0.5), T_probe_image)
    >>> made = sweep_cloud(sweep, spacing_mm=2.0)
    >>> made.report.n_contour, float(made.cloud.points[:, 2].mean().round(2)), made.beam.round(2).tolist()
    (4000, 19.75, [0.0, 0.0, 1.0])
    """
    points, frames, beam, report = contour_points(sweep, max_gap_s=max_gap_s)
    taken_s = sweep.frame_times_s - sweep.latency_s
    thinned = thin_evenly(np.column_stack([points, taken_s[frames]]), spacing_mm)
    counted = replace(report, n_points=len(thinned))
    return SweepCloud(PointCloud(thinned[:, :3], sweep.name, times=thinned[:, 3]), beam, counted)
