"""The kinds of question that a claim can put to a run: what is computed of its pairs, and when the claim is borne out.

A difference whose interval over people holds 0, or that is below the metric's own resolution (``mean_tolerance`` in
``METRICS``), is a tie and bears nothing out. So is such a lead on a single pair where pairs are counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from study.evaluation.intervals import Interval, Statistic, weighted_mean
from study.evaluation.metrics import METRICS
from study.naming import person_of
from study.types import Floats

GRAPH = "skeleton_graph"
BASELINES = ("icp", "nonrigid_icp", "cpd")
TUNED = tuple(f"{name}_tuned" for name in BASELINES)
MINUTES = "minutes"  # beside ``METRICS``: how long a registration took

REPRODUCED, PARTLY, NOT = "reproduced", "partly", "not"
TIE = f"{NOT}: a tie"
TOO_FEW = f"{NOT}: too few people"
UNTESTABLE = "can't be tested without the volunteer"

# Half of the narrowest gap: cartilages 2-5 lie 31-38 mm apart and are 11-12 mm wide.
HALF_GAP_MM = 9.0
NEARLY_ALL = 0.95  # of the waypoints
WHOLE, NEARLY_WHOLE = 0.01, 0.05  # shares of torn neighbours or strayed points: next to none, few


@dataclass(frozen=True)
class Question:
    """What a claim asks of a run.

    Attributes:
        table: index source, target; what the statistic takes as columns.
        judge: the verdict, from the statistic and its interval.
        statistic: of the table.
        count: ``"k of n"`` where pairs are counted, else empty.
    """

    table: pd.DataFrame
    judge: Callable[[Interval], str]
    statistic: Statistic = weighted_mean
    count: str = ""

    @property
    def point(self) -> float:
        """The statistic of the table as it is."""
        return float(self.statistic(self.table.to_numpy(dtype=np.float64), np.ones((1, len(self.table))))[0])


def _pairs(rows: pd.DataFrame, metric: str, methods: Sequence[str], of: str = "mean") -> pd.DataFrame | None:
    """A row a pair on which all of these methods that are there have a value, a column a method."""
    mine = rows[(rows["metric"] == metric) & rows["method"].isin(methods)]
    if mine.empty:
        return None
    table = mine.groupby(["source", "target", "method"])["value"].agg(of).unstack("method")
    table = table[[name for name in methods if name in table]].dropna()
    return None if table.empty else table


def _resolution(metric: str) -> float:
    return METRICS[metric].mean_tolerance if metric in METRICS else 0.0


def _judge_below(resolution: float) -> Callable[[Interval], str]:
    def judge(difference: Interval) -> str:
        if not difference.is_known:
            return TOO_FEW
        if difference.is_tie(resolution):
            return TIE
        return REPRODUCED if difference.value < 0 else NOT

    return judge


def number(rows: pd.DataFrame, metric: str, method: str) -> Question | None:
    """A mean as printed: its own people have no like, so it stands beside ours and is not judged."""
    table = _pairs(rows, metric, [method])
    return None if table is None else Question(table, lambda _: UNTESTABLE)


def below(rows: pd.DataFrame, metric: str, method: str, rival: str) -> Question | None:
    """Whether a method's mean is below another's, on the pairs of both."""
    table = _pairs(rows, metric, [method, rival])
    if table is None or table.shape[1] < 2:
        return None
    return Question((table[method] - table[rival]).to_frame(), _judge_below(_resolution(metric)))


def first(
    rows: pd.DataFrame,
    metric: str,
    method: str = GRAPH,
    rivals: Sequence[str] = BASELINES,
    of: str = "mean",
    *,
    least: bool = True,
    most: bool = False,
) -> Question | None:
    """On which share of the pairs a method is below (or above) every rival that was run; a tie is neither.

    Args:
        rows: of numbers.
        metric: of them.
        method: the one judged.
        rivals: the others.
        of: which of a pair's values counts, ``mean`` or ``max``.
        least: below; above when False.
        most: the claim is of most pairs; of all when False, and then most of them bear it out partly.
    """
    others = [name for name in rivals if name != method]
    table = _pairs(rows, metric, [method, *others], of)
    if table is None or method not in table or table.shape[1] < 2:
        return None
    rest = table.drop(columns=method)
    lead = rest.min(axis=1) - table[method] if least else table[method] - rest.max(axis=1)
    tied = lead.abs() <= _resolution(metric)
    ahead = (lead > 0) & ~tied
    ties = f", {tied.sum()} tied" if tied.any() else ""
    return _counted(ahead.astype(float).to_frame(), f"{ahead.sum()} of {len(table)}{ties}", most=most)


def _counted(table: pd.DataFrame, count: str, *, most: bool = False) -> Question:
    share = float(table.to_numpy().mean())
    verdict = REPRODUCED if share == 1 or (most and share > 0.5) else PARTLY if share > 0.5 else NOT
    return Question(table, lambda _: verdict, count=count)


def steadiest(rows: pd.DataFrame, metric: str) -> Question | None:
    """Whether the graph's SD over all values is below every baseline's, on common pairs."""
    methods = (GRAPH, *BASELINES)
    means = _pairs(rows, metric, methods)
    squares = _pairs(rows.assign(value=rows["value"] ** 2), metric, methods)
    if means is None or squares is None or GRAPH not in means or means.shape[1] < 2:
        return None

    def lead(values: Floats, weights: Floats) -> Floats:
        moments = weights @ values / weights.sum(axis=1, keepdims=True)
        mean, square = np.split(moments, 2, axis=1)
        sd = np.sqrt(np.clip(square - mean**2, 0, None))
        return np.asarray(sd[:, 0] - sd[:, 1:].min(axis=1))

    table = pd.concat([means, squares.add_suffix(" squared")], axis=1)
    return Question(table, _judge_below(_resolution(metric)), lead)


def same_easiest(rows: pd.DataFrame, metric: str) -> Question | None:
    """For which share of the patients with several CTs all methods do best on the same one."""
    table = _pairs(rows, metric, (GRAPH, *BASELINES))
    if table is None or table.shape[1] < 2:
        return None
    by_patient = table.groupby(level="target").filter(lambda one: len(one) > 1)
    if by_patient.empty:
        return None
    best = by_patient.groupby(level="target").idxmin().map(lambda pair: pair[0])
    same = best.nunique(axis=1) == 1
    # One of the people stands for each end: a patient is one observation, whichever CTs it was registered to.
    index = pd.MultiIndex.from_arrays([[person_of(name) for name in same.index]] * 2, names=["source", "target"])
    return _counted(pd.DataFrame({"same": same.to_numpy(dtype=float)}, index=index), f"{same.sum()} of {len(same)}")


def about(rows: pd.DataFrame, metric: str, method: str, printed: float) -> Question | None:
    """Whether a mean is about as printed: between half and twice that."""
    table = _pairs(rows, metric, [method])
    return (
        None if table is None else Question(table, lambda i: REPRODUCED if printed / 2 < i.value < 2 * printed else NOT)
    )


def in_their_gap(rows: pd.DataFrame) -> Question | None:
    """Which share of the graph's waypoints lies nearer than `HALF_GAP_MM` to its place, in the plane; by the truth."""
    metrics = ("true_waypoint_error_inplane", "waypoint_error_inplane")  # the protocol's place between two real people
    known = [metric for metric in metrics if metric in set(rows["metric"])]
    table = _pairs(rows.assign(value=rows["value"] < HALF_GAP_MM), known[0], [GRAPH]) if known else None
    if table is None:
        return None

    def judge(share: Interval) -> str:
        lowest = share.low if share.is_known else share.value
        return REPRODUCED if lowest >= NEARLY_ALL else PARTLY if share.value > 0.5 else NOT

    return Question(table.astype(float), judge)


def kept_whole(rows: pd.DataFrame, metric: str) -> Question | None:
    """Whether next to none of a share that should be 0 is left by the graph."""
    table = _pairs(rows, metric, [GRAPH])
    if table is None:
        return None

    def judge(share: Interval) -> str:
        highest = share.high if share.is_known else share.value
        return REPRODUCED if highest <= WHOLE else PARTLY if highest <= NEARLY_WHOLE else NOT

    return Question(table, judge)
