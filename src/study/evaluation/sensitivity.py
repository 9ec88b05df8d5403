"""What each choice of `DEVIATIONS.md` is worth over several people and several draws, tearing included.

`study.evaluation.ablation` lists the choices of the graph; here are those around it, too, and every option is judged
by the truth, by the protocol and by what a registration says about itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import pandas as pd

from study.alignment.chest import Alignment, align
from study.alignment.sternum import SternumParams
from study.errors import StudyError
from study.evaluation.ablation import Option, options
from study.evaluation.disturbances import Disturbance, DisturbedPair, disturbed_pair
from study.evaluation.judgement import Judgement
from study.evaluation.metrics import METRICS
from study.evaluation.pair import Pair
from study.evaluation.waypoints import intercostal_waypoints
from study.methods.cpd import Cpd
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.methods.visible_surface import VisibleSurface
from study.pipeline import register_aligned
from study.registration import Method, Registration
from study.seeds import named_rng

# Truth, protocol, and the three measures that tell a torn, folded or swapped cloud.
MEASURES = (
    "true_waypoint_error",
    "true_waypoint_error_inplane",
    "waypoint_error",
    "hd",
    "stretched_share",
    "folded_share",
    "wrong_part_share",
)
N_RESAMPLES = 2000

Row = dict[str, Any]


@dataclass(frozen=True)
class Setting(Option):
    """An `Option`, and the choices outside the graph.

    Attributes:
        cut: of the cartilages, for the protocol's waypoints.
        sternum: templates of the coarse alignment.
    """

    cut: Literal["kmeans", "slices"] = "kmeans"
    sternum: SternumParams = field(default_factory=SternumParams)


def settings(method: SkeletonGraphMethod | None = None, radius_mm: float = 20.0) -> list[Setting]:
    """Every choice, the published option of each first.

    Args:
        method: the graph as published; other schedules for a quick look.
        radius_mm: sphere of the path transfer.
    """
    graph = method or SkeletonGraphMethod()
    of_graph = [Setting(o.choice, o.option, o.role, o.method, o.radius_mm) for o in options(graph, radius_mm)]
    cpd = Setting("points of CPD (tuned)", "1,000", "paper", VisibleSurface(Cpd.tuned()), radius_mm)
    cut = Setting("parts of a cartilage (waypoints)", "k-means", "paper", graph, radius_mm)
    box = Setting("rectangle of the sternum (coarse)", "30 × 90 mm, 0.6 covered", "paper", graph, radius_mm)
    fewer, more = (VisibleSurface(replace(Cpd.tuned(), max_points=n)) for n in (500, 1500))
    return [
        *of_graph,
        cpd,
        replace(cpd, option="500", role="alternative", method=fewer),
        replace(cpd, option="1,500", role="alternative", method=more),
        cut,
        replace(cut, option="equal slices", role="alternative", cut="slices"),
        box,
        replace(box, option="0.8 covered", role="alternative", sternum=SternumParams(min_overlap=0.8)),
        replace(box, option="25 × 90 mm", role="alternative", sternum=SternumParams(width_mm=25.0)),
    ]


def sensitivity_rows(
    people: int, listed: Sequence[Setting], seeds: Sequence[int], disturbance: Disturbance | None = None
) -> list[Row]:
    """Every option on one pair of people, with several seeds of the method.

    Options that differ behind the maps only are run with the same draws, and so on the same maps. The yardstick, the
    published option with other draws, takes as many seeds again.

    Args:
        people: cohort seed of the pair, see `study.evaluation.disturbances`.
        listed: what to try.
        seeds: of the method's draws, paired over options.
        disturbance: of the clouds; a careful acquisition when None.

    Returns:
        a row each of choice, option, seed and measure: ``choice``, ``option``, ``role``, ``people``, ``seed``,
        ``metric``, ``value`` (None where it failed), ``reason`` (of a failure).
    """
    given = disturbed_pair(disturbance or Disturbance(), people)
    aligned: dict[SternumParams, Alignment | StudyError] = {}
    known: dict[tuple[Method, SternumParams, int], Registration] = {}
    rows = []
    for one in listed:
        if one.sternum not in aligned:
            aligned[one.sternum] = _aligned(given, one.sternum)
        for seed in seeds:
            what = {"choice": one.choice, "option": one.option, "role": one.role, "people": people, "seed": seed}
            drawn = seed + len(seeds) if one.role == "yardstick" else seed
            try:
                values = _measured(one, given, aligned[one.sternum], drawn, known)
                rows += [{**what, "metric": name, "value": value, "reason": ""} for name, value in values.items()]
            except StudyError as error:
                told = " ".join(str(error).split())
                rows += [{**what, "metric": name, "value": None, "reason": told} for name in MEASURES]
    return rows


def _aligned(given: DisturbedPair, sternum: SternumParams) -> Alignment | StudyError:
    """The coarse alignment, or what it refused."""
    try:
        return align(replace(given.ct, parts=None), replace(given.us, parts=None), sternum)
    except StudyError as error:
        return error


def _measured(
    one: Setting,
    given: DisturbedPair,
    alignment: Alignment | StudyError,
    seed: int,
    known: dict[tuple[Method, SternumParams, int], Registration],
) -> dict[str, float]:
    if isinstance(alignment, StudyError):
        raise alignment
    key = (one.method, one.sternum, seed if _draws(one.method) else 0)
    if key not in known:
        known[key] = register_aligned(alignment, one.method, named_rng(key[2], f"sensitivity/{given.us.name}"))
    protocol = intercostal_waypoints(given.us, one.cut).points
    # Of the truth only the waypoints' is asked for.
    pair = Pair(given.ct.name, given.us.name, alignment, given.waypoints, protocol, true_waypoints=given.goal)
    judgement = Judgement(pair, known[key], one.radius_mm)
    return {name: float(np.asarray(METRICS[name].measure(judgement)).mean()) for name in MEASURES}


def _draws(method: Method) -> bool:
    """Whether a method's answer depends on its draws: the graph's maps do."""
    return isinstance(method.method if isinstance(method, VisibleSurface) else method, SkeletonGraphMethod)


def sensitivity_summary(rows: pd.DataFrame) -> pd.DataFrame:
    """What each option changes, with 95 % bootstrap intervals over people; seeds of one pair are averaged first.

    Args:
        rows: of `sensitivity_rows`, several people.

    Returns:
        by ``choice``, ``option``, ``role`` and ``metric``: ``people`` that count, ``failed`` ones, ``mean``,
        ``published`` (mean of the published option on the same people), ``change`` with ``low`` and ``high``, and
        ``seed_sd``, the SD over seeds of one pair, averaged over pairs; in the metric's unit.
    """
    keys = ["choice", "option", "role", "metric"]
    published = {
        key: some.set_index(["people", "seed"])["value"].astype(float)
        for key, some in rows[rows["role"] == "paper"].groupby(["choice", "metric"])
    }
    found = []
    for key, some in rows.groupby(keys, sort=False):
        choice, option, _, metric = map(str, key)
        own = some.set_index(["people", "seed"])["value"].astype(float)
        base = published[choice, metric].reindex(own.index)
        both = pd.DataFrame({"own": own, "base": base}).dropna().groupby("people").mean()
        change = (both["own"] - both["base"]).to_numpy()
        low, high = _mean_interval(change, f"{choice}/{option}/{metric}")
        found.append(
            {
                **dict(zip(keys, key, strict=True)),
                "people": len(both),
                "failed": some["people"].nunique() - len(both),
                "mean": both["own"].mean(),
                "published": both["base"].mean(),
                **{"change": change.mean() if len(change) else np.nan, "low": low, "high": high},
                "seed_sd": own.groupby("people").std(ddof=1).mean(),
            }
        )
    return pd.DataFrame(found)


def _mean_interval(values: np.ndarray, name: str) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the mean of (n,) values; NaN of none."""
    if not len(values):
        return np.nan, np.nan
    picks = named_rng(0, f"sensitivity/bootstrap/{name}").integers(len(values), size=(N_RESAMPLES, len(values)))
    low, high = np.percentile(values[picks].mean(axis=1), [2.5, 97.5])
    return float(low), float(high)
