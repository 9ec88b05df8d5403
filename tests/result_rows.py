"""Rows of small runs, drawn, for the tests of results."""

import numpy as np

from study.results.metrics_csv import Case, failed_row, metric_rows

METHODS = ("skeleton_graph", "icp")
SOURCES = ("ct1", "ct2", "ct10")


def some_rows(seed=0, dataset="phantom", without=()):
    rng = np.random.default_rng(seed)
    rows = []
    for method in METHODS:
        for source in SOURCES:
            errors = rng.uniform(1, 5, 20)
            case = Case(dataset, source, "patient", method, 0)
            if (source, method) in without:
                rows.append(failed_row(case, "no sternum found in 'ct2':\nbest overlap 0.31, need 0.60"))
            else:
                values = {"hd": rng.uniform(8, 12), "waypoint_error": errors, "waypoint_error_inplane": errors / 2}
                rows += metric_rows(case, values, converged=method != "icp")
    return rows
