"""How good a registration is: Eq. 5 and its companions (sec. IV-A), waypoint errors (sec. IV-B)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import wilcoxon

from study.errors import StudyError
from study.geometry import nearest
from study.types import Floats, as_points

MIN_PAIRS = 6  # two-sided, 5 pairs cannot give less than p = 2 / 2**5 = 0.0625


# In place of a method: the known deformation itself, carried and measured as a method's answer is. What it scores is
# what a perfect registration would, under this protocol.
TRUTH = "truth"


@dataclass(frozen=True)
class Metric:
    """What a row of ``metrics.csv`` measures.

    Attributes:
        title: for tables and axes.
        unit: unit of the value.
        tolerance: how far two machines may differ, in ``unit``.
        reason: why that much and no more.
    """

    title: str
    unit: str
    tolerance: float
    reason: str


_WORST = "the worst of thousands of points: one changed partner moves it; methods differ by 1 mm and more"
_MEAN = "a mean over thousands of points hides a changed partner; methods differ by 0.3 mm and more"
_PLACE = "a rigid fit of hundreds of points; methods differ by 0.5 mm and more"

METRICS: Mapping[str, Metric] = {
    "hd": Metric("Hausdorff distance", "mm", 0.2, _WORST),
    "hd95": Metric("95th percentile Hausdorff distance", "mm", 0.1, "a percentile ignores single points"),
    "msd": Metric("Mean surface distance", "mm", 0.05, _MEAN),
    "sampling_floor": Metric("Hausdorff distance of two draws of one surface", "mm", 0.2, "as hd"),
    "waypoint_error": Metric("Waypoint error", "mm", 0.1, _PLACE),
    "waypoint_error_inplane": Metric("Waypoint error in the feature plane", "mm", 0.1, _PLACE),
    "true_waypoint_error": Metric("True waypoint error", "mm", 0.1, _PLACE),
    "true_waypoint_error_inplane": Metric("True waypoint error in the feature plane", "mm", 0.1, _PLACE),
    "true_error_mean": Metric("Mean true point error", "mm", 0.05, _MEAN),
    "true_error_p95": Metric("95th percentile true point error", "mm", 0.1, "a percentile ignores single points"),
    "true_error_max": Metric("Largest true point error", "mm", 0.2, _WORST),
}


def directed_distances_mm(a: Floats, b: Floats) -> Floats:
    """Distance (n,) mm of each of ``a``, (n, 3) mm, to its nearest of ``b``, (m, 3) mm.

    Raises:
        StudyError: an array that is empty, not (n, 3) or not finite.
    """
    return nearest(as_points(a, "first cloud"), as_points(b, "second cloud"))[0]


def hausdorff_mm(a: Floats, b: Floats) -> float:
    """Hausdorff distance of all points of two clouds, (n, 3) and (m, 3) mm (Eq. 5)."""
    return float(max(directed_distances_mm(a, b).max(), directed_distances_mm(b, a).max()))  # Eq. 5


def hd95_mm(a: Floats, b: Floats) -> float:
    """The larger of the two directed distances' 95th percentiles, mm."""
    return float(max(np.percentile(directed_distances_mm(a, b), 95), np.percentile(directed_distances_mm(b, a), 95)))


def mean_surface_distance_mm(a: Floats, b: Floats) -> float:
    """Mean of the two directed distances' means, mm: both clouds count the same, however many points they have."""
    return float((directed_distances_mm(a, b).mean() + directed_distances_mm(b, a).mean()) / 2)


def sampling_floor_mm(points: Floats, n_points: int, rng: np.random.Generator, n_draws: int = 10) -> float:
    """Hausdorff distance of two draws of the same surface, mm: no method can be told from a perfect one below it.

    Args:
        points: (n, 3) mm, a dense cloud of the surface.
        n_points: points a draw, at most n / 2 as the two draws share none.
        rng: source of the draws.
        n_draws: pairs of draws to average.

    Raises:
        StudyError: fewer than ``2 * n_points`` points.
    """
    points = as_points(points, "surface")
    if not 1 <= n_points <= len(points) // 2:
        raise StudyError(
            f"expected two draws of {n_points} points without a shared one, got {len(points)} points; "
            f"draw at most {len(points) // 2}, or sample the surface more densely"
        )
    floors = []
    for _ in range(n_draws):
        rows = rng.permutation(len(points))[: 2 * n_points]
        floors.append(hausdorff_mm(points[rows[:n_points]], points[rows[n_points:]]))
    return float(np.mean(floors))


def point_errors_mm(points: Floats, reference: Floats, plane_normal: ArrayLike | None = None) -> Floats:
    """Distance (k,) mm of corresponding rows of (k, 3) mm; with ``plane_normal`` (3,) its part in that plane.

    Both clouds' antero-posterior error is half a cartilage where CT shows a tube and ultrasound its front, so the
    part in the feature plane is what a method can be judged by.

    Raises:
        StudyError: rows that do not pair, values that are not finite, a normal without direction.
    """
    points, reference = as_points(points, "points"), as_points(reference, "reference points")
    if points.shape != reference.shape:
        raise StudyError(f"expected one reference per point, got {points.shape} and {reference.shape}")
    offsets = points - reference
    if plane_normal is not None:
        normal = np.asarray(plane_normal, dtype=np.float64)
        length = float(np.linalg.norm(normal))
        if normal.shape != (3,) or not np.isfinite(length) or length == 0:
            raise StudyError(f"expected a plane normal of shape (3,) and some length, got {normal!r}")
        offsets = offsets - np.outer(offsets @ (normal / length), normal / length)
    return np.linalg.norm(offsets, axis=1)


def waypoint_errors_mm(transferred: Floats, reference: Floats, plane_normal: ArrayLike | None = None) -> Floats:
    """Error (k,) mm of transferred waypoints against those defined on the target (sec. IV-B); see `point_errors_mm`."""
    return point_errors_mm(transferred, reference, plane_normal)


def population_sd(values: ArrayLike) -> float:
    """Standard deviation with ``ddof=0``: the paper's Table I divides by n, pandas by n - 1."""
    return float(np.std(np.asarray(values, dtype=np.float64)))


@dataclass(frozen=True)
class PairedTest:
    """Two methods on the same subjects.

    Attributes:
        n: pairs compared.
        mean_difference: first minus second, mean over the pairs.
        p_value: Wilcoxon signed-rank, two-sided, exact where there are no ties; None with fewer than 6 pairs.
        note: what the p-value is, or why there is none.
    """

    n: int
    mean_difference: float
    p_value: float | None
    note: str


def paired_wilcoxon(first: ArrayLike, second: ArrayLike) -> PairedTest:
    """Compare two methods on the same subjects; entry i of both is subject i.

    A subject is one observation: its 20 waypoints share one registration, so pass their mean.

    Raises:
        StudyError: sequences that do not pair, or values that are not finite.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 1 or not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise StudyError(
            f"expected two lists of finite values, one pair a subject, got {a.shape} and {b.shape}; leave failures out"
        )
    difference = a - b
    n, mean = len(difference), float(difference.mean()) if len(difference) else float("nan")
    if n < MIN_PAIRS:
        return PairedTest(n, mean, None, f"n = {n} < {MIN_PAIRS}: no test can reach p < 0.05")
    if not difference.any():
        return PairedTest(n, mean, 1.0, f"n = {n}, all pairs equal")
    return PairedTest(n, mean, float(wilcoxon(a, b).pvalue), f"Wilcoxon signed-rank, two-sided, n = {n}")
