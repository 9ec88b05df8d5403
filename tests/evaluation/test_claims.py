"""Claims read off planted numbers whose outcomes are known."""

import numpy as np
import pandas as pd
import pytest

from study.evaluation.claims import (
    BASELINES,
    CLAIMS,
    GRAPH,
    TUNED,
    UNKNOWN,
    claims_table,
    differences,
    share,
    smallest,
    verdict,
)
from study.evaluation.metrics import METRICS
from study.evaluation.pair import TRUTH
from study.evaluation.statistics import population_sd

HD, STEADY, MEAN, PATH, WORST, ICP, TUNED_HD, TUNED_PATH, TRUE, TRUE_TUNED = (claim.text for claim in CLAIMS)
METHODS = ("coarse", *BASELINES, GRAPH, *TUNED, TRUTH)
SOURCES = ("ct1", "ct2", "ct3")


def rows(metric, by_method):
    """Rows of a metric; for each method a value, or a list of a waypoint's values, for each CT."""
    return pd.DataFrame(
        [
            {"metric": metric, "source": source, "target": "patient", "method": method, "value": value}
            for method, values in by_method.items()
            for source, some in zip(SOURCES, values, strict=True)
            for value in np.atleast_1d(some)
        ]
    )


def replication():
    """A run in which everything holds: the graph first, ICP last, whoever is asked."""
    order = {name: 10.0 + k for k, name in enumerate((GRAPH, *TUNED, "cpd", "nonrigid_icp", "icp", "coarse"))}
    spread = np.array([-1.0, 0.0, 1.0])
    hd = {name: value + spread * (value - 9) / 6 for name, value in order.items()}
    path = {name: [[value - 1, value + 1]] * 3 for name, value in order.items()}
    parts = [rows("hd", hd), rows("waypoint_error", path), rows("true_waypoint_error", path)]
    return pd.concat(parts, ignore_index=True)


def changed(values, metric, method, by_source):
    """The same with other values of one method."""
    old = (values["metric"] == metric) & (values["method"] == method)
    return pd.concat([values[~old], rows(metric, {method: by_source})], ignore_index=True)


def outcomes(values):
    return {claim.text: claim.outcome(values) for claim in CLAIMS}


ALL = {claim.text: "3 of 3" for claim in CLAIMS} | {STEADY: "yes", MEAN: "yes"}


def test_claims_ask_for_known_metrics_and_six_of_them_are_the_papers():
    assert {claim.metric for claim in CLAIMS} <= set(METRICS)
    assert [claim.asked for claim in CLAIMS] == [True] * 6 + [False] * 4
    assert [claim.paper for claim in CLAIMS if claim.asked] == ["5 of 5", "yes", "yes", "5 of 5", "5 of 5", "4 of 5"]
    assert {claim.paper for claim in CLAIMS if not claim.asked} == {UNKNOWN}
    assert len({claim.text for claim in CLAIMS}) == len(CLAIMS)


def test_a_run_in_which_everything_holds():
    assert outcomes(replication()) == ALL
    assert claims_table({"all": replication()})["here"].unique().tolist() == ["yes"]


@pytest.mark.parametrize(
    ("metric", "method", "values", "expected"),
    [
        # A baseline is nearer on one CT, or as near: neither is a win.
        ("hd", "cpd", [5, 14, 15], {HD: "2 of 3"}),
        ("hd", "cpd", [10 - 1 / 6, 14, 16], {HD: "2 of 3"}),
        ("hd", "cpd_tuned", [1, 2, 30], {TUNED_HD: "1 of 3"}),
        # As far on every CT: an SD of 0 is steadier.
        ("hd", "cpd", [20, 20, 20], {STEADY: "no, cpd"}),
        ("hd", GRAPH, [9.8, 9.9, 20], {HD: "2 of 3", TUNED_HD: "2 of 3", STEADY: "no, cpd"}),
        # Better on most CTs, worse on average.
        ("waypoint_error", GRAPH, [9, 9, 40], {MEAN: "no, cpd", PATH: "2 of 3", WORST: "2 of 3", ICP: "2 of 3",
                                               TUNED_PATH: "2 of 3"}),
        # One waypoint far off spoils the maximum, not the mean.
        ("waypoint_error", GRAPH, [[4, 15], [4, 15], [9, 11]], {WORST: "1 of 3"}),
        ("waypoint_error", "cpd", [[9, 11]] * 3, {MEAN: "no, cpd", PATH: "0 of 3", WORST: "0 of 3"}),  # a tie
        ("waypoint_error", "nonrigid_icp", [20, 15, 16], {ICP: "1 of 3"}),  # a tie of the worst is none
        ("true_waypoint_error", "icp", [1, 1, 1], {TRUE: "0 of 3"}),
        ("true_waypoint_error", "icp_tuned", [1, 1, 20], {TRUE_TUNED: "1 of 3"}),
    ],
)  # fmt: skip
def test_one_method_out_of_line_changes_the_claims_about_it_and_no_other(metric, method, values, expected):
    assert outcomes(changed(replication(), metric, method, values)) == ALL | expected


def test_methods_that_no_claim_names_change_nothing():
    values = replication()
    for metric in ("hd", "waypoint_error", "true_waypoint_error"):
        for method in ("coarse", "skeleton_graph_tuned", TRUTH):
            values = changed(values, metric, method, [0, 0, 0])
    assert outcomes(values) == ALL


def test_without_the_truth_only_its_claims_are_unknown():
    values = replication()
    found = outcomes(values[values["metric"] != "true_waypoint_error"])
    assert found == ALL | {TRUE: UNKNOWN, TRUE_TUNED: UNKNOWN}


def test_without_tuned_baselines_or_the_graph_a_run_cannot_tell():
    values = replication()
    untuned = outcomes(values[~values["method"].isin(TUNED)])
    assert untuned == ALL | dict.fromkeys((TUNED_HD, TUNED_PATH, TRUE_TUNED), UNKNOWN)
    without = outcomes(values[values["method"] != GRAPH])
    assert without == dict.fromkeys(ALL, UNKNOWN) | {ICP: "3 of 3"}
    alone = outcomes(values[values["method"] == GRAPH])
    assert set(alone.values()) == {UNKNOWN}


def test_a_pair_on_which_a_method_failed_is_compared_for_nobody():
    values = replication()
    failed = values[~((values["source"] == "ct2") & (values["method"] == "cpd"))]
    expected = dict.fromkeys((HD, PATH, WORST, ICP, TRUE), "2 of 2")
    assert outcomes(failed) == ALL | expected
    # Its easiest pair lost, the graph's mean over all pairs would be above CPD's over two.
    hard = changed(values, "waypoint_error", GRAPH, [8, 30, 8])
    hard = changed(hard, "waypoint_error", "cpd", [9, 40, 9])
    hard = hard[~((hard["source"] == "ct2") & (hard["method"] == "cpd"))]
    assert outcomes(hard)[MEAN] == "yes"
    never = values[~((values["method"] == "cpd") ^ (values["source"] == "ct2"))]  # CPD on ct2, the others elsewhere
    assert outcomes(never)[HD] == UNKNOWN


def test_share_and_smallest_read_one_table():
    table = pd.DataFrame({GRAPH: [1.0, 2.0, 3.0, 4.0], "icp": [2.0, 2.0, 2.0, np.nan], "cpd": [9.0, 9.0, 9.0, 9.0]})
    assert share(table, GRAPH, ["icp", "cpd", "absent"]) == "1 of 3"
    assert share(table, GRAPH, ["cpd"]) == "4 of 4"
    assert share(table, "cpd", [GRAPH, "icp", "cpd"], least=False) == "3 of 3"
    assert share(table, GRAPH, [GRAPH]) == share(table, "absent", [GRAPH]) == UNKNOWN
    assert smallest(table, pd.Series.mean) == "no, icp"  # 2 and 2 over the three common pairs
    assert smallest(table, population_sd) == "no, icp"
    assert smallest(table[[GRAPH, "cpd"]], pd.Series.max) == "yes"


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (["5 of 5", "12 of 12", "yes"], "yes"),
        (["5 of 5", UNKNOWN], "yes"),
        (["5 of 5", "11 of 12"], "mostly"),
        (["3 of 5"], "mostly"),
        (["yes", "no, icp"], "no"),  # half is not most
        (["2 of 4"], "no"),
        (["yes", "yes", "no, icp"], "mostly"),
        (["12 of 12", "0 of 5"], "no"),  # each data set counts the same, however many pairs it has
        (["0 of 5", "no, cpd"], "no"),
        ([UNKNOWN, UNKNOWN], UNKNOWN),
        ([], UNKNOWN),
    ],
)
def test_a_verdict_is_over_all_data_sets(found, expected):
    assert verdict(found) == expected


def test_the_table_has_a_row_a_claim_and_a_column_a_run():
    values = replication()
    unknown = values[values["metric"] != "true_waypoint_error"]
    table = claims_table({"one": changed(values, "hd", "cpd", [5, 14, 15]), "two": unknown})
    assert list(table.columns) == ["paper", "one", "two", "here"]
    assert list(table.index) == [claim.text for claim in CLAIMS]
    assert "the skeleton graph has" in table.index.name
    assert table.loc[HD].tolist() == ["5 of 5", "2 of 3", "3 of 3", "mostly"]
    assert table.loc[MEAN].tolist() == ["yes", "yes", "yes", "yes"]
    assert table.loc[TRUE].tolist() == [UNKNOWN, "3 of 3", UNKNOWN, "yes"]


def test_differences_are_of_pairs_where_both_have_a_value():
    index = pd.MultiIndex.from_product([["hd", "msd"], SOURCES, ["patient"]], names=["metric", "source", "target"])
    per_pair = pd.DataFrame({"icp": [4.0, np.nan, 6.0, 0, 0, 0], GRAPH: [1.0, 2.0, 5.0, 0, 0, 0]}, index=index)
    found = differences({"a": per_pair, "b": per_pair * 2}, "hd")
    assert found.to_dict("list") == {
        "dataset": ["a", "a", "b", "b"],
        "method": ["icp"] * 4,
        "difference": [-3.0, -1.0, -6.0, -2.0],
    }
    assert differences({"a": per_pair}, "hd", "icp")["difference"].tolist() == [3.0, 1.0]
