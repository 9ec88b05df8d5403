"""How true every method stays when the clouds get worse: errors, refusals and warnings, level by level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from study.alignment.chest import Alignment, find_chest
from study.alignment.sizes import size_warnings
from study.errors import StudyError
from study.evaluation.distances import waypoint_errors_mm
from study.evaluation.disturbances import KINDS, Disturbance, DisturbedPair, disturbed_pair
from study.pipeline import find_method, register_aligned, run_method
from study.seeds import named_rng
from study.types import PointCloud

# Each method at its best, and the published graph. The others as shipped are left out: ICP and non-rigid ICP as
# shipped answer like the tuned ones, shifted; CPD as shipped, whose kernel is narrower than its points' spacing, stays
# where the coarse alignment put it, which is a row of its own.
ROBUST_METHODS = (
    *("coarse", "icp_tuned", "nonrigid_icp_tuned", "cpd_tuned", "skeleton_graph", "skeleton_graph_tuned"),
    *("skeleton_graph_repaired", "bcpd_tuned", "gaussian_process"),
)
ERROR, IN_PLANE = "true_waypoint_error", "true_waypoint_error_inplane"
OK, WARNED, BY_HAND, FAILED = "ok", "warned", "by hand", "failed"
N_RESAMPLES = 2000
RADIUS_MM = 20.0

Row = dict[str, Any]


def robustness_rows(disturbance: Disturbance, draw: int, methods: Sequence[str]) -> list[Row]:
    """Register one disturbed pair with every method.

    Where the coarse alignment or its check of sizes refuses, the methods start by hand: from the alignment of the
    undisturbed cloud, with the parts of its nearest points. The refusal is in the row's status; what the disturbance
    costs a method still shows.

    Args:
        disturbance: what is wrong.
        draw: cohort seed of the two people, and of all that is drawn.
        methods: names in ``METHODS``.

    Returns:
        for each method a row of the mean true waypoint error and one of it in the feature plane: ``draw``, ``method``,
        ``metric``, ``value`` (mm; None where it failed), ``status``: ``ok``, ``warned`` (the registration says so
        itself), ``by hand`` or ``failed``, and ``reason``, why it was refused or failed.
    """
    try:
        pair = disturbed_pair(disturbance, draw)
        alignment, refused = _aligned(pair, disturbance, draw)
    except StudyError as error:
        return [row for method in methods for row in failed_rows(draw, method, error)]
    rows = []
    for name in methods:
        try:
            rows += _registered(pair, alignment, refused, draw, name)
        except StudyError as error:
            rows += failed_rows(draw, name, error)
    return rows


def _aligned(pair: DisturbedPair, disturbance: Disturbance, draw: int) -> tuple[Alignment, str]:
    """Both chests, and why they were found by hand; empty where they were not."""
    try:
        alignment = Alignment(find_chest(_bare(pair.ct)), find_chest(_bare(pair.us)))
        size_warnings(alignment)
        return alignment, ""
    except StudyError as error:
        refused = str(error)
    careful = disturbed_pair(Disturbance(noise_mm=0.0, deformation=disturbance.deformation), draw)
    source, target = (find_chest(_bare(cloud)) for cloud in (careful.ct, careful.us))
    return Alignment(replace(source, cloud=pair.ct), replace(target, cloud=pair.us)), refused


def _bare(cloud: PointCloud) -> PointCloud:
    return replace(cloud, parts=None)


def _registered(pair: DisturbedPair, alignment: Alignment, refused: str, draw: int, name: str) -> list[Row]:
    rng, method, T0 = named_rng(draw, f"robustness/{name}"), find_method(name), alignment.T_us_ct
    if refused:  # its sizes would be refused again
        result = run_method(method, pair.ct.moved(T0), alignment.target.cloud, rng, name)
        result = replace(result, source=pair.ct.points)
    else:
        result = register_aligned(alignment, method, rng, name)
    moved = result.transfer(pair.waypoints, RADIUS_MM)
    normal = alignment.target.T_cloud_chest.rotation[:, 2]
    status = BY_HAND if refused else WARNED if result.warnings else OK
    what = {"draw": draw, "method": name, "status": status, "reason": _line(refused)}
    return [
        {**what, "metric": metric, "value": float(errors.mean())}
        for metric, errors in (
            (ERROR, waypoint_errors_mm(moved, pair.goal)),
            (IN_PLANE, waypoint_errors_mm(moved, pair.goal, normal)),
        )
    ]


def failed_rows(draw: int, method: str, error: StudyError) -> list[Row]:
    """The rows of a method that gave no answer."""
    what = {"draw": draw, "method": method, "value": None, "status": FAILED, "reason": _line(str(error))}
    return [{**what, "metric": metric} for metric in (ERROR, IN_PLANE)]


def _line(text: str) -> str:
    return " ".join(text.split())


def robustness_summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of all draws, summed up: what a figure shows.

    Args:
        rows: `robustness_rows` with ``kind`` and ``level``.

    Returns:
        by ``kind``, ``level``, ``method`` and ``metric``: ``title`` and ``unit`` of the kind, ``draws``, ``median``,
        ``p5`` and ``p95`` over draws, ``low`` and ``high`` (95 % bootstrap interval of the median), and how many draws
        ``warned``, were started ``by_hand`` or ``failed``; mm, NaN where all draws failed. A draw started by hand
        counts in the median, a failed one cannot.
    """
    keys = ["kind", "level", "method", "metric"]
    found = []
    for key, some in rows.groupby(keys, sort=False):
        values = some["value"].dropna().to_numpy(dtype=np.float64)
        status = some["status"].astype(str)
        low, high = _median_interval(values, "/".join(map(str, key)))
        p5, median, p95 = np.percentile(values, [5, 50, 95]) if len(values) else [np.nan] * 3
        found.append(
            {
                **dict(zip(keys, key, strict=True)),
                **{"title": KINDS[str(key[0])].title, "unit": KINDS[str(key[0])].unit},
                "draws": len(some),
                **{"median": median, "p5": p5, "p95": p95, "low": low, "high": high},
                "warned": int((status == WARNED).sum()),
                "by_hand": int((status == BY_HAND).sum()),
                "failed": int((status == FAILED).sum()),
            }
        )
    return pd.DataFrame(found)


def _median_interval(values: np.ndarray, name: str) -> tuple[float, float]:
    """95 % percentile bootstrap interval of the median of (n,) values; NaN of none."""
    if not len(values):
        return np.nan, np.nan
    picks = named_rng(0, f"robustness/bootstrap/{name}").integers(len(values), size=(N_RESAMPLES, len(values)))
    low, high = np.percentile(np.median(values[picks], axis=1), [2.5, 97.5])
    return float(low), float(high)
