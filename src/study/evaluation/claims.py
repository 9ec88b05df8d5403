"""The paper's claims, one at a time, each with what comes out of a run (sec. IV), and what the paper does not ask."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import pandas as pd

from study.evaluation.statistics import population_sd

GRAPH = "skeleton_graph"
BASELINES = ("icp", "nonrigid_icp", "cpd")
TUNED = tuple(f"{name}_tuned" for name in BASELINES)
NOT_ASKED = "not asked: "
UNKNOWN = "–"


@dataclass(frozen=True)
class Claim:
    """A claim, what the paper says of its own data, and how to read it off a run.

    Attributes:
        text: the claim; "the skeleton graph has the ..." before it.
        paper: the paper's outcome.
        metric: one of ``METRICS``.
        read: the outcome, from a table of that metric: a row a pair, a column a method.
        of: which of a pair's values the table holds.
    """

    text: str
    paper: str
    metric: str
    read: Callable[[pd.DataFrame], str]
    of: Literal["mean", "max"] = "mean"

    @property
    def asked(self) -> bool:
        """Whether the paper makes it."""
        return not self.text.startswith(NOT_ASKED)

    def outcome(self, values: pd.DataFrame) -> str:
        """``"k of n"`` pairs, ``"yes"`` or ``"no, <method>"``; `UNKNOWN` where a run cannot tell.

        Args:
            values: rows of numbers with columns metric, source, target, method and value.
        """
        rows = values[values["metric"] == self.metric]
        if rows.empty:
            return UNKNOWN
        of_pairs = rows.groupby(["source", "target", "method"])["value"].agg(self.of)
        return self.read(of_pairs.unstack("method"))


def _together(table: pd.DataFrame, method: str, rivals: Sequence[str]) -> pd.DataFrame | None:
    """A method and its rivals on the pairs where all have a value; None without the method, a rival or such a pair."""
    present = [name for name in rivals if name in table.columns and name != method]
    if method not in table.columns or not present:
        return None
    both = table[[method, *present]].dropna()
    return None if both.empty else both


def share(table: pd.DataFrame, method: str, rivals: Sequence[str], *, least: bool = True) -> str:
    """On how many pairs a method is below (or above) every rival, ``"k of n"``; a tie is neither.

    Args:
        table: a row a pair, a column a method.
        method: the one judged.
        rivals: the others; those without a column are left out.
        least: below; above when False.
    """
    both = _together(table, method, rivals)
    if both is None:
        return UNKNOWN
    one, others = both[method], both.drop(columns=method)
    ahead = one < others.min(axis=1) if least else one > others.max(axis=1)
    return f"{int(ahead.sum())} of {len(both)}"


def smallest(table: pd.DataFrame, statistic: Callable[[pd.Series], float]) -> str:
    """Whether a statistic of the graph over all pairs is below the baselines', ``"yes"`` or ``"no, <the smallest>"``.

    Args:
        table: a row a pair, a column a method.
        statistic: of one method's values.
    """
    both = _together(table, GRAPH, BASELINES)
    if both is None:
        return UNKNOWN
    of = {name: statistic(both[name]) for name in both.columns}
    best = min((name for name in of if name != GRAPH), key=lambda name: of[name])
    return "yes" if of[GRAPH] < of[best] else f"no, {best}"


def _below(rivals: Sequence[str]) -> Callable[[pd.DataFrame], str]:
    """On how many pairs the graph is below every rival."""
    return partial(share, method=GRAPH, rivals=rivals)


CLAIMS: tuple[Claim, ...] = (
    Claim("smallest Hausdorff distance on every CT", "5 of 5", "hd", _below(BASELINES)),
    Claim("steadiest: smallest SD of the Hausdorff distance", "yes", "hd", partial(smallest, statistic=population_sd)),
    Claim("smallest mean waypoint error", "yes", "waypoint_error", partial(smallest, statistic=pd.Series.mean)),
    Claim("smallest mean waypoint error on every CT", "5 of 5", "waypoint_error", _below(BASELINES)),
    Claim("smallest maximum waypoint error on every CT", "5 of 5", "waypoint_error", _below(BASELINES), "max"),
    Claim(
        "ICP worst on most CTs, by waypoint error",
        "4 of 5",
        "waypoint_error",
        partial(share, method="icp", rivals=(GRAPH, *BASELINES), least=False),
    ),
    Claim(NOT_ASKED + "Hausdorff distance below tuned baselines, too", UNKNOWN, "hd", _below(TUNED)),
    Claim(NOT_ASKED + "waypoint error below tuned baselines, too", UNKNOWN, "waypoint_error", _below(TUNED)),
    Claim(NOT_ASKED + "best by the truth", UNKNOWN, "true_waypoint_error", _below(BASELINES)),
    Claim(NOT_ASKED + "best by the truth, tuned baselines too", UNKNOWN, "true_waypoint_error", _below(TUNED)),
)


def claims_table(runs: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Every claim against every run.

    Args:
        runs: rows of numbers by data set, as `study.results.Run.values` gives them.

    Returns:
        index the claims; columns ``paper``, one a data set, and ``here``: on every pair of every data set (``yes``), on
        most (``mostly``) or not.
    """
    outcomes = {name: [claim.outcome(values) for claim in CLAIMS] for name, values in runs.items()}
    table = pd.DataFrame({"paper": [claim.paper for claim in CLAIMS], **outcomes}, index=[c.text for c in CLAIMS])
    table["here"] = [verdict(row) for row in table[list(runs)].to_numpy().tolist()]
    return table.rename_axis("claim: the skeleton graph has the …")


def verdict(outcomes: Sequence[str]) -> str:
    """``yes`` where a claim holds on every pair of every data set, ``mostly``, or ``no``; `UNKNOWN` without any.

    ``mostly`` is on more than half of the pairs, each data set counting the same.

    Args:
        outcomes: of one claim, one a data set.
    """
    shares = []
    for text in outcomes:
        if text == UNKNOWN:
            continue
        ahead, _, of = text.partition(" of ")
        shares.append(int(ahead) / int(of) if of.isdigit() else float(text == "yes"))
    if not shares:
        return UNKNOWN
    return "yes" if min(shares) == 1 else "mostly" if sum(shares) / len(shares) > 0.5 else "no"


def differences(runs: Mapping[str, pd.DataFrame], metric: str, reference: str = GRAPH) -> pd.DataFrame:
    """``reference`` minus every other method on each pair where both have a value.

    Args:
        runs: `study.results.Run.per_pair` by data set.
        metric: one of ``METRICS``.
        reference: the method compared.

    Returns:
        columns ``dataset``, ``method`` and ``difference`` (the metric's unit).
    """
    parts = []
    for name, per_pair in runs.items():
        table = per_pair.loc[metric]
        for other in [column for column in table.columns if column != reference]:
            both = table[[reference, other]].dropna()
            difference = both[reference] - both[other]
            parts.append(pd.DataFrame({"dataset": name, "method": other, "difference": difference.to_numpy()}))
    return pd.concat(parts, ignore_index=True)
