"""Controls of the measures: why a perfect registration does not score zero, and who orders the methods as truth does.

Both need pairs whose deformation is known; what they find is then said of measures that need no truth (sec. IV).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from study.errors import StudyError
from study.evaluation.distances import CloudDistances, waypoint_errors_mm
from study.evaluation.judgement import Judgement
from study.evaluation.metrics import METRICS
from study.evaluation.pair import TRUTH, Pair, perfect
from study.evaluation.waypoints import intercostal_waypoints
from study.geometry.points import nearest
from study.registration import Registration
from study.types import Floats, Part, PointCloud

# The paper's measures and their parts. Each has a like-for-like one of the visible part: "visible_" before its name.
SURFACE_MEASURES = ("hd", "hd95", "msd")
PATH_MEASURES = ("waypoint_error", "waypoint_error_inplane", "waypoint_error_depth")
VISIBLE = "visible_"

AS_IT_IS, NO_SWEEP_ERRORS = "as it is", "sweep errors off"
VISIBLE_HALF, BOTH = "visible half", "both"
TWO_SWEEPS, PATH_ALONE = "floor: two sweeps", "floor: path transfer"
STEPS: Mapping[str, str] = MappingProxyType(
    {
        AS_IT_IS: "the known deformation, judged as a method is: whole tubes against fronts, swept with errors",
        NO_SWEEP_ERRORS: "the same sweep without errors: the fronts where they are, no strip missed",
        VISIBLE_HALF: "the CT's cloud and waypoints from what a probe could see of it: like with like, in any data set",
        BOTH: "like with like, swept without errors: what remains are sampling, rims and the sphere's rigid fit",
        TWO_SWEEPS: "two sweeps of the patient without errors, one against the other: sampling and the protocol's cut",
        PATH_ALONE: "waypoints carried by rigid fits in spheres against their true places",
    }
)

# What counts as right when measures are compared: with all errors, on the skin, and without what no method can see.
TRUE_ERRORS = ("true_waypoint_error", "true_waypoint_error_inplane", "registered_waypoint_error")
_PAIR = ["dataset", "source", "target", "seed"]
MIN_METHODS = 3  # two methods agree or they do not: that is no rank correlation


def truth_floor(pair: Pair, undisturbed: Pair, again: PointCloud, *, radius_mm: float = 20.0) -> pd.DataFrame:
    """What each difference between the clouds adds to the score of the known deformation itself.

    The part in the plane need not fall with every step: where the CT's waypoints are known exactly (the phantom), to
    cut them from its visible half by the protocol adds the noise of that cut, which `TWO_SWEEPS` shows alone.

    Args:
        pair: with a known deformation and sweep errors.
        undisturbed: the same people, swept with `SweepErrors.none`.
        again: the patient swept another time with `SweepErrors.none`, with true parts, in the frame of
            ``undisturbed``: what the protocol and the distances find between two clouds of one surface.
        radius_mm: sphere of the path transfer (sec. III-D).

    Returns:
        a row for each of `STEPS` and each of the paper's measures: ``pair``, ``step``, ``metric``, ``value`` (mm; mean
        over waypoints) and ``change`` (mm, against `AS_IT_IS`). A floor has rows for the measures that it bounds.

    Raises:
        StudyError: pairs of other people, a deformation that is not known.
    """
    if pair.name != undisturbed.name:
        raise StudyError(f"expected {pair.name} without sweep errors, got {undisturbed.name}; pass the same people")
    judged, clean = (Judgement(clouds, perfect(clouds), radius_mm) for clouds in (pair, undisturbed))
    measures = SURFACE_MEASURES + PATH_MEASURES
    values = {
        AS_IT_IS: {name: _mean(judged, name) for name in measures},
        NO_SWEEP_ERRORS: {name: _mean(clean, name) for name in measures},
        VISIBLE_HALF: {name: _mean(judged, VISIBLE + name) for name in measures},
        BOTH: {name: _mean(clean, VISIBLE + name) for name in measures},
        TWO_SWEEPS: _between_sweeps(clean, again),
        PATH_ALONE: {name: _mean(clean, f"true_{name}") for name in PATH_MEASURES},
    }
    return pd.DataFrame(
        [
            {
                "pair": pair.name,
                "step": step,
                "metric": metric,
                "value": value,
                "change": value - values[AS_IT_IS][metric],
            }
            for step, found in values.items()
            for metric, value in found.items()
        ]
    )


def _mean(judgement: Judgement, metric: str) -> float:
    return float(np.asarray(METRICS[metric].measure(judgement)).mean())


def _between_sweeps(clean: Judgement, again: PointCloud) -> dict[str, float]:
    """Every measure between the US cloud and that of another sweep of the same patient, mm."""
    surface = CloudDistances.between(again.points, clean.pair.alignment.target.cloud.points)
    path, goal = intercostal_waypoints(again).points, clean.pair.waypoints_us
    errors = (
        waypoint_errors_mm(path, goal),
        waypoint_errors_mm(path, goal, clean.normal),
        waypoint_errors_mm(path, goal, clean.normal, depth=True),
    )
    values = [surface.hausdorff_mm, surface.hd95_mm, surface.mean_mm, *(float(error.mean()) for error in errors)]
    return dict(zip(SURFACE_MEASURES + PATH_MEASURES, values, strict=True))


@dataclass(frozen=True)
class DecidingPoint:
    """The one point that a Hausdorff distance is the distance of (Eq. 5).

    Attributes:
        cloud: whose it is: ``ct``, warped, or ``us``.
        row: in that cloud.
        place: (3,) mm, US frame.
        partner: (3,) mm, the nearest point of the other cloud.
        part: of the anatomy.
        visible: whether a probe could see it; True of every US point.
        distance_mm: the Hausdorff distance.
    """

    cloud: Literal["ct", "us"]
    row: int
    place: Floats
    partner: Floats
    part: Part
    visible: bool
    distance_mm: float

    def __str__(self) -> str:
        seen = "visible" if self.visible else "unseen"
        return f"{self.distance_mm:.1f} mm at {seen} point {self.row} of the {self.cloud.upper()}, {self.part.name}"


def deciding_point(pair: Pair, registration: Registration) -> DecidingPoint:
    """Which point decides the Hausdorff distance of a registration, and whether ultrasound could have shown it."""
    source, target = pair.alignment.source.cloud, pair.alignment.target.cloud
    clouds: dict[Literal["ct", "us"], Floats] = {"ct": registration.warped, "us": target.points}
    ct, us = nearest(clouds["ct"], clouds["us"]), nearest(clouds["us"], clouds["ct"])
    cloud: Literal["ct", "us"] = "ct" if ct[0].max() >= us[0].max() else "us"
    distances, partners = ct if cloud == "ct" else us
    row = int(distances.argmax())
    parts = target.parts if cloud == "us" else source.parts if pair.parts_ct is None else pair.parts_ct
    assert parts is not None  # a chest is labelled
    return DecidingPoint(
        cloud=cloud,
        row=row,
        place=clouds[cloud][row],
        partner=clouds["us" if cloud == "ct" else "ct"][partners[row]],
        part=Part(int(parts[row])),
        visible=cloud == "us" or bool(pair.visible[row]),
        distance_mm=float(distances[row]),
    )


def truth_free_measures() -> tuple[str, ...]:
    """The paper's measures and their parts, then the like-for-like ones: what can be had between two real people."""
    paper = SURFACE_MEASURES + PATH_MEASURES[:2]
    return (*paper, *(VISIBLE + name for name in paper))


def rank_agreement(
    metrics: pd.DataFrame, measures: Sequence[str] | None = None, truths: Sequence[str] = TRUE_ERRORS
) -> pd.DataFrame:
    """Whether a measure that needs no truth orders the methods as the true error does, pair by pair.

    Args:
        metrics: rows of ``metrics.csv``, as `study.results.read_metrics` gives them; pairs without truth are left out,
            and so is the row of the truth itself, which is no method.
        measures: names in ``METRICS``; `truth_free_measures` when None.
        truths: names in ``METRICS`` that count as right.

    Returns:
        a row a pair, measure and truth: ``dataset``, ``source``, ``target``, ``seed``, ``measure``, ``truth``, ``rho``
        (Spearman's over the methods; +1 the same order, -1 the reverse, NaN where all values are equal) and ``n``, the
        methods with both values.

    Raises:
        StudyError: no pair with truth, or one with fewer than 3 methods that have a value of a measure.
    """
    measures = truth_free_measures() if measures is None else measures
    chosen = metrics[metrics["metric"].isin([*measures, *truths]) & (metrics["method"] != TRUTH)]
    means = chosen.groupby([*_PAIR, "method", "metric"])["value"].mean().unstack("metric")
    lacking = [name for name in (*measures, *truths) if name not in means.columns]
    if lacking:
        raise StudyError(f"expected rows of pairs with a known truth, got none of {', '.join(lacking)}; run it again")
    rows: list[dict[str, Any]] = []
    for names, table in means.groupby(level=_PAIR):
        if table[list(truths)].isna().all(axis=None):
            continue  # two real people
        for truth in truths:
            for measure in measures:
                both = table[[measure, truth]].dropna()
                if len(both) < MIN_METHODS:
                    pair = f"{names[1]}/{names[2]}"
                    raise StudyError(
                        f"{pair}: expected {MIN_METHODS} methods with {measure} and {truth}, got {len(both)}"
                    )
                rho = _spearman(both[measure].to_numpy(), both[truth].to_numpy())
                row = dict(zip(_PAIR, names, strict=True))
                rows.append({**row, "measure": measure, "truth": truth, "rho": rho, "n": len(both)})
    return pd.DataFrame(rows)


def _spearman(a: Floats, b: Floats) -> float:
    """Rank correlation; NaN where one side has no order."""
    return float(spearmanr(a, b).statistic) if np.ptp(a) > 0 and np.ptp(b) > 0 else float("nan")


def agreement_summary(agreement: pd.DataFrame) -> pd.DataFrame:
    """`rank_agreement` over the pairs of each data set.

    Returns:
        index ``dataset``, ``measure``, ``truth`` in their order; columns ``mean``, ``low`` and ``high`` (the range over
        the pairs) and ``n``, the pairs.
    """
    groups = agreement.groupby(["dataset", "measure", "truth"], sort=False)["rho"]
    return pd.DataFrame({"mean": groups.mean(), "low": groups.min(), "high": groups.max(), "n": groups.count()})
