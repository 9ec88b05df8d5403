"""The paper's protocol against the truth (sec. IV-B)."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

PROTOCOL_COLUMNS: Mapping[str, str] = {
    "waypoint_error": "protocol",
    "true_waypoint_error": "true",
    "true_waypoint_error_inplane": "true, in the plane",
}


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
