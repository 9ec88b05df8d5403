"""How good a registration is (sec. IV): every metric of ``metrics.csv``, what it measures, in which unit, how exactly.

A metric is one entry of `METRICS`: what it is called, its unit, by how much two machines may differ in a value and in a
mean, and the function that measures it on a `Judgement`. Nothing else in the library lists metrics.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from study.evaluation.judgement import Judgement
from study.evaluation.pair import Pair
from study.registration import Registration
from study.types import Floats


class Unit(StrEnum):
    """Unit of a metric."""

    MILLIMETRES = "mm"
    DEGREES = "deg"
    FRACTION = "1"
    SECONDS = "s"


@dataclass(frozen=True)
class Metric:
    """What a row of ``metrics.csv`` measures.

    Attributes:
        title: for tables and axes.
        unit: unit of the value.
        tolerance: how far two machines may differ, in ``unit``.
        mean_tolerance: how far the mean of a method over a run may; what moves single values does not move all of them.
        reason: why that much and no more.
        measure: a value, or one a waypoint, of a judged registration.
        needs_truth: whether the pair's deformation must be known.
        needs_shift: whether the constant shift of its sweep must be known, too.
    """

    title: str
    unit: Unit
    tolerance: float
    mean_tolerance: float
    reason: str
    measure: Callable[[Judgement], ArrayLike]
    needs_truth: bool = False
    needs_shift: bool = False

    def measurable(self, pair: Pair) -> bool:
        """Whether enough is known of a pair."""
        return (pair.has_truth or not self.needs_truth) and (pair.shift_mm is not None or not self.needs_shift)


# Means: the closest two methods that a claim tells apart are 0.012 mm apart (Hausdorff distance on the phantom). From
# one machine to one of another maker 22 of 13,244 values moved by more than a nanometre, the farthest by 0.013 mm.
_WORST = "the worst of thousands of points: one changed partner moves it; methods differ by 1 mm and more"
_MEAN = "a mean over thousands of points hides a changed partner; methods differ by 0.3 mm and more"
_PLACE = "a rigid fit of hundreds of points; methods differ by 0.5 mm and more"
_SHARE = "a percentile ignores single points"
_COUNT = "a share of thousands of points; a limit stands where right and wrong differ by more"
_MM, _1 = Unit.MILLIMETRES, Unit.FRACTION


def _waypoint_metrics(
    name: str, title: str, errors_mm: Callable[[Judgement], Callable[..., Floats]], **needs: bool
) -> dict[str, Metric]:
    """A waypoint error in space, its part in the feature plane, which a path on the skin feels, and in depth."""
    return {
        name: Metric(title, _MM, 0.1, 0.01, _PLACE, lambda j: errors_mm(j)(), **needs),
        f"{name}_inplane": Metric(
            f"{title} in the feature plane", _MM, 0.1, 0.01, _PLACE, lambda j: errors_mm(j)(in_plane=True), **needs
        ),
        f"{name}_depth": Metric(
            f"{title} in depth", _MM, 0.1, 0.01, _PLACE, lambda j: errors_mm(j)(in_depth=True), **needs
        ),
    }


METRICS: Mapping[str, Metric] = MappingProxyType(
    {
        "hd": Metric("Hausdorff distance", _MM, 0.2, 0.01, _WORST, lambda j: j.surface.hausdorff_mm),
        "hd95": Metric("95th percentile Hausdorff distance", _MM, 0.1, 0.01, _SHARE, lambda j: j.surface.hd95_mm),
        "msd": Metric("Mean surface distance", _MM, 0.05, 0.005, _MEAN, lambda j: j.surface.mean_mm),
        # The same, like with like: what a probe can see of the warped CT cloud (`Judgement.visible_surface`).
        "visible_hd": Metric(
            "Hausdorff distance of the visible part", _MM, 0.2, 0.01, _WORST, lambda j: j.visible_surface.hausdorff_mm
        ),
        "visible_hd95": Metric(
            "95th percentile Hausdorff distance of the visible part",
            _MM,
            0.1,
            0.01,
            _SHARE,
            lambda j: j.visible_surface.hd95_mm,
        ),
        "visible_msd": Metric(
            "Mean surface distance of the visible part", _MM, 0.05, 0.005, _MEAN, lambda j: j.visible_surface.mean_mm
        ),
        **_waypoint_metrics("waypoint_error", "Waypoint error", lambda j: j.protocol_errors_mm),
        **_waypoint_metrics(
            "visible_waypoint_error", "Waypoint error of the visible part", lambda j: j.visible_protocol_errors_mm
        ),
        **_waypoint_metrics(
            "true_waypoint_error", "True waypoint error", lambda j: j.true_waypoint_errors_mm, needs_truth=True
        ),
        **_waypoint_metrics(
            "registered_waypoint_error",
            "True waypoint error as registered",
            lambda j: j.registered_waypoint_errors_mm,
            needs_truth=True,
            needs_shift=True,
        ),
        "true_error_mean": Metric(
            "Mean true point error", _MM, 0.05, 0.005, _MEAN, lambda j: j.true_point_errors_mm.mean(), needs_truth=True
        ),
        "true_error_p95": Metric(
            "95th percentile true point error",
            _MM,
            0.1,
            0.01,
            _SHARE,
            lambda j: np.percentile(j.true_point_errors_mm, 95),
            needs_truth=True,
        ),
        "true_error_max": Metric(
            "Largest true point error", _MM, 0.2, 0.01, _WORST, lambda j: j.true_point_errors_mm.max(), needs_truth=True
        ),
        # What a registration says about itself (`study.quality`), where there is no truth to ask.
        "residual_share": Metric(
            "US farther than 5 mm from CT", _1, 0.01, 0.001, _COUNT, lambda j: j.quality.residual_share
        ),
        "wrong_part_share": Metric(
            "On another cartilage than its own", _1, 0.01, 0.001, _COUNT, lambda j: j.quality.wrong_part_share
        ),
        "further_motion": Metric(
            "Motion after the coarse alignment", _MM, 0.05, 0.005, _MEAN, lambda j: j.quality.further_motion_mm
        ),
        "stretched_share": Metric(
            "Neighbours torn or crushed", _1, 0.01, 0.001, _COUNT, lambda j: j.quality.stretched_share
        ),
        "folded_share": Metric("Folded over", _1, 0.01, 0.001, _COUNT, lambda j: j.quality.folded_share),
    }
)


def judge(pair: Pair, registration: Registration, radius_mm: float = 20.0) -> dict[str, Floats]:
    """Every metric of one registration (sec. IV); those that need the truth or the sweep's shift only where known.

    Args:
        pair: what was registered.
        registration: in the US frame, as `study.pipeline.register_aligned` gives it.
        radius_mm: sphere of the path transfer (sec. III-D).

    Returns:
        values (1,) or one a waypoint (k,), by the names of `METRICS`, in their units.

    Raises:
        StudyError: a waypoint that cannot be carried, values that are not finite.
    """
    judgement = Judgement(pair, registration, radius_mm)
    return {
        name: np.atleast_1d(np.asarray(metric.measure(judgement), dtype=np.float64))
        for name, metric in METRICS.items()
        if metric.measurable(pair)
    }
