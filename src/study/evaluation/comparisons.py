"""Methods against each other on the same pairs, and the paper's protocol against the truth (sec. IV-B)."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from study.evaluation.metrics import METRICS
from study.evaluation.statistics import paired_wilcoxon

PROTOCOL_COLUMNS: Mapping[str, str] = {
    "waypoint_error": "protocol",
    "true_waypoint_error": "true",
    "true_waypoint_error_inplane": "true, in the plane",
}


def paired_tests(runs: Mapping[str, pd.DataFrame], metric: str, reference: str) -> pd.DataFrame:
    """One method against every other on each pair where both have a value, with Wilcoxon's signed-rank test.

    Args:
        runs: `study.results.Run.per_pair` by data set; those without the metric or the method are left out.
        metric: one of ``METRICS``.
        reference: the method compared.

    Returns:
        columns ``method``, ``metric`` (its title), ``against``, ``dataset`` and ``verdict``: mean difference, on how
        many pairs ``reference`` is better, p where a test can tell.
    """
    rows = []
    for name, per_pair in runs.items():
        if metric not in per_pair.index.get_level_values("metric") or reference not in per_pair.columns:
            continue
        table = per_pair.loc[metric]
        for other in [column for column in table.columns if column != reference]:
            both = table[[reference, other]].dropna()
            test = paired_wilcoxon(both[reference], both[other])
            better = int((both[reference] < both[other]).sum())
            verdict = f"{test.mean_difference:+.2f} mm, better on {better} of {test.n}{_significance(test.p_value)}"
            title = METRICS[metric].title
            rows.append({"method": reference, "metric": title, "against": other, "dataset": name, "verdict": verdict})
    return pd.DataFrame(rows, columns=["method", "metric", "against", "dataset", "verdict"])


def _significance(p: float | None) -> str:
    """A p-value as text; none where there was no test."""
    return "" if p is None else ", p < 0.001" if p < 5e-4 else f", p = {p:.3f}"


def protocol_and_truth(runs: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """What the protocol sees of the waypoints' true error, mean over all waypoints, mm.

    The true error is split per waypoint into its parts in the feature plane and in depth, by Pythagoras.

    Args:
        runs: rows of numbers by data set, of data sets whose truth is known.

    Returns:
        index dataset, method; columns ``protocol``, ``true``, ``true, in the plane``, ``true, in depth``, ``hidden``
        (true minus protocol: positive where the protocol flatters a method) and ``n``, the waypoints.
    """
    rows = pd.concat([*runs.values()], ignore_index=True)
    rows = rows[rows["metric"].isin(PROTOCOL_COLUMNS)]
    keys = ["dataset", "method", "source", "target", "index"]
    single = rows.pivot(index=keys, columns="metric", values="value").rename(columns=PROTOCOL_COLUMNS)
    single["true, in depth"] = (single["true"] ** 2 - single["true, in the plane"] ** 2).clip(0) ** 0.5
    groups = single.groupby(["dataset", "method"])
    means = groups.mean()
    means["hidden"] = means["true"] - means["protocol"]
    means["n"] = groups.size()
    return means[["protocol", "true", "true, in the plane", "true, in depth", "hidden", "n"]].rename_axis(columns=None)
