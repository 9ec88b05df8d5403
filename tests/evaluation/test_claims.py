"""Claims read off planted numbers whose outcomes are known."""

from functools import partial

import numpy as np
import pandas as pd
import pytest

from study.evaluation.claim_questions import (
    BASELINES,
    GRAPH,
    MINUTES,
    NOT,
    PARTLY,
    REPRODUCED,
    TIE,
    TOO_FEW,
    TUNED,
    UNTESTABLE,
    below,
    first,
    steadiest,
)
from study.evaluation.claims import CLAIMS, PAPER, UNKNOWN, Claim, claims_table, differences, overall, with_minutes
from study.evaluation.metrics import METRICS
from study.evaluation.pair import TRUTH
from study.results import paper_hd_table, paper_waypoints

METHODS = ("coarse", *BASELINES, GRAPH, *TUNED, TRUTH)
SOURCES = ("ct1", "ct2", "ct3")


def named(start):
    """The one claim whose text starts so."""
    (found,) = [claim for claim in CLAIMS if claim.text.startswith(start)]
    return found


HD = named("smallest Hausdorff")
STEADY = named("steadiest Hausdorff")
STEADY_PATH = named("steadiest waypoint")
PATH = named("smallest mean waypoint")
WORST = named("smallest maximum waypoint")
ICP = named("ICP worst")
TRUE = named("not asked: smallest error by the truth (")
TRUE_TUNED = named("not asked: smallest error by the truth, tuned")
TUNED_HD = named("not asked: Hausdorff distance below all tuned")
TUNED_PATH = named("not asked: waypoint error below all tuned")
COUNTED = (HD, PATH, WORST, ICP, TRUE, TRUE_TUNED, TUNED_HD, TUNED_PATH)


def rows(metric, by_method, sources=SOURCES, target="patient"):
    """Rows of a metric; for each method a value, or a list of a waypoint's values, for each CT."""
    return pd.DataFrame(
        [
            {"metric": metric, "source": source, "target": target, "method": method, "index": k, "value": value}
            for method, values in by_method.items()
            for source, some in zip(sources, values, strict=True)
            for k, value in enumerate(np.atleast_1d(some))
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


def outcomes(values, claims=COUNTED):
    return {claim.text: claim.outcome(values) for claim in claims}


ALL = {claim.text: "3 of 3" for claim in COUNTED}


def test_claims_ask_for_distinct_things_and_print_what_the_paper_prints():
    assert len({claim.text for claim in CLAIMS}) == len(CLAIMS)
    assert {claim.paper for claim in CLAIMS if not claim.asked} == {UNKNOWN}
    assert UNKNOWN not in {claim.paper for claim in CLAIMS if claim.asked}
    asked = [claim.ask.keywords["metric"] for claim in CLAIMS if isinstance(claim.ask, partial)]
    assert set(asked) <= {*METRICS, MINUTES}
    tables = {"hd": paper_hd_table(), "waypoint_error": paper_waypoints()}
    for metric, numbers in PAPER.items():
        assert dict(numbers) == tables[metric]["mean"].to_dict()
    hd, path = tables["hd"]["sd"], tables["waypoint_error"]["sd"]
    assert float(STEADY.paper) == pytest.approx(hd[GRAPH] - hd[list(BASELINES)].min())
    assert float(STEADY_PATH.paper) == pytest.approx(path[GRAPH] - path[list(BASELINES)].min())
    wins = (tables["hd"].filter(like="CT ").astype(float).idxmin() == GRAPH).sum()
    assert HD.paper == f"{wins} of 5"
    gap = named("Hausdorff distance smaller than that of CPD")
    assert float(gap.paper) == pytest.approx(PAPER["hd"][GRAPH] - PAPER["hd"]["cpd"])


def test_a_run_in_which_everything_holds():
    values = replication()
    assert outcomes(values) == ALL
    assert {claim.finding(values).verdict for claim in COUNTED} == {REPRODUCED}
    table = claims_table({"all": values})
    judged = table.loc[[c.text for c in COUNTED], "here"]
    assert judged.unique().tolist() == [REPRODUCED]
    numbers = table[table.index.str.contains(r"\(mean, mm\)")]
    assert len(numbers) == 8
    assert set(numbers["here"]) == {UNTESTABLE}
    assert numbers["all"].iloc[3].startswith("10.00 [")
    assert set(table.loc[[c.text for c in CLAIMS if c.ask is None], "here"]) == {UNTESTABLE}


@pytest.mark.parametrize(
    ("metric", "method", "values", "expected"),
    [
        # A baseline is nearer on one CT, or as near: neither is a win, and the second is called a tie.
        ("hd", "cpd", [5, 14, 15], {HD: "2 of 3"}),
        ("hd", "cpd", [10 - 1 / 6, 14, 16], {HD: "2 of 3, 1 tied"}),
        # Ahead by less than two machines may differ in a mean is a tie, too; by twice that is not.
        ("hd", "cpd", [10 - 1 / 6 + 0.009, 14, 16], {HD: "2 of 3, 1 tied"}),
        ("hd", "cpd", [10 - 1 / 6 + 0.02, 14, 16], {}),
        ("hd", "cpd_tuned", [1, 2, 30], {TUNED_HD: "1 of 3"}),
        ("waypoint_error", GRAPH, [9, 9, 40], {PATH: "2 of 3", WORST: "2 of 3", ICP: "2 of 3", TUNED_PATH: "2 of 3"}),
        # One waypoint far off spoils the maximum, not the mean.
        ("waypoint_error", GRAPH, [[4, 15], [4, 15], [9, 11]], {WORST: "1 of 3, 2 tied"}),
        ("waypoint_error", "cpd", [[9, 11]] * 3, {PATH: "0 of 3, 3 tied", WORST: "0 of 3, 3 tied"}),
        ("waypoint_error", "nonrigid_icp", [20, 15, 16], {ICP: "1 of 3, 1 tied"}),
        ("true_waypoint_error", "icp", [1, 1, 1], {TRUE: "0 of 3"}),
        ("true_waypoint_error", "icp_tuned", [1, 1, 20], {TRUE_TUNED: "1 of 3"}),
    ],
)
def test_one_method_out_of_line_changes_the_counts_about_it_and_no_other(metric, method, values, expected):
    found = outcomes(changed(replication(), metric, method, values))
    assert found == ALL | {claim.text: outcome for claim, outcome in expected.items()}


def test_methods_that_no_count_names_change_nothing():
    values = replication()
    for metric in ("hd", "waypoint_error", "true_waypoint_error"):
        for method in ("coarse", "skeleton_graph_tuned", TRUTH):
            values = changed(values, metric, method, [0, 0, 0])
    assert outcomes(values) == ALL


def test_what_a_run_does_not_hold_it_cannot_tell():
    values = replication()
    no_truth = outcomes(values[values["metric"] != "true_waypoint_error"])
    assert no_truth == ALL | dict.fromkeys((TRUE.text, TRUE_TUNED.text), UNKNOWN)
    untuned = outcomes(values[~values["method"].isin(TUNED)])
    assert untuned == ALL | dict.fromkeys((TUNED_HD.text, TUNED_PATH.text, TRUE_TUNED.text), UNKNOWN)
    without = outcomes(values[values["method"] != GRAPH])
    assert without == dict.fromkeys(ALL, UNKNOWN) | {ICP.text: "3 of 3"}
    alone = values[values["method"] == GRAPH]
    assert set(outcomes(alone).values()) == {UNKNOWN}
    assert named("Hausdorff distance smaller than that of CPD").finding(alone) is None
    assert STEADY.finding(alone) is None


def test_a_pair_on_which_a_method_failed_is_compared_for_nobody():
    values = replication()
    failed = values[~((values["source"] == "ct2") & (values["method"] == "cpd"))]
    assert outcomes(failed) == ALL | {claim.text: "2 of 2" for claim in (HD, PATH, WORST, ICP, TRUE)}
    # Its easiest pair lost, the graph's mean over all pairs would be above CPD's over two.
    hard = changed(values, "waypoint_error", GRAPH, [8, 30, 8])
    hard = changed(hard, "waypoint_error", "cpd", [9, 40, 9])
    hard = hard[~((hard["source"] == "ct2") & (hard["method"] == "cpd"))]
    assert named("waypoint error smaller than that of CPD").finding(hard).interval.value == -1
    never = values[~((values["method"] == "cpd") ^ (values["source"] == "ct2"))]  # CPD on ct2, the others elsewhere
    assert outcomes(never)[HD.text] == UNKNOWN


# --- verdicts --------------------------------------------------------------------------------------------------------

MANY = tuple(f"ct{k}" for k in range(10))


def difference(values):
    """A claim's finding of the graph at these values against CPD at 10."""
    table = rows("hd", {GRAPH: [10 + v for v in values], "cpd": [10.0] * len(values)}, MANY[: len(values)])
    return Claim("", "", partial(below, metric="hd", method=GRAPH, rival="cpd")).finding(table)


def test_a_difference_is_told_by_its_interval_and_a_tie_is_called_a_tie():
    noise = np.linspace(-0.5, 0.5, 10)
    assert difference(noise - 2).verdict == REPRODUCED
    assert difference(noise + 2).verdict == NOT
    assert difference(noise - 0.05).verdict == TIE  # smaller, but the interval holds 0
    assert difference(np.full(10, 0.0)).verdict == TIE
    # The same lead on everybody is certain; below the metric's resolution it is nothing.
    assert difference(np.full(10, -0.005)).verdict == TIE
    assert difference(np.full(10, -0.02)).verdict == REPRODUCED
    assert difference([-2.0]).verdict == TOO_FEW
    found = difference(noise - 2)
    assert found.shown == str(found.interval)
    assert found.interval.n_pairs == 10


@pytest.mark.parametrize(
    ("ahead", "all_of", "most_of"),
    [(10, REPRODUCED, REPRODUCED), (6, PARTLY, REPRODUCED), (5, NOT, NOT), (0, NOT, NOT)],
)
def test_a_count_is_reproduced_partly_or_not(ahead, all_of, most_of):
    table = rows("hd", {GRAPH: [1.0] * ahead + [3.0] * (10 - ahead), "cpd": [2.0] * 10}, MANY)
    for most, expected in ((False, all_of), (True, most_of)):
        found = Claim("", "", partial(first, metric="hd", most=most)).finding(table)
        assert (found.verdict, found.shown) == (expected, f"{ahead} of 10")
        assert found.interval.value == ahead / 10


def test_steadiness_is_the_spread_over_all_values_against_the_steadiest_baseline():
    rng = np.random.default_rng(0)
    calm, wild = rng.normal(10, 0.3, 10), rng.normal(10, 5, 10)
    table = rows("hd", {GRAPH: calm, "cpd": wild, "icp": wild * 2}, MANY)
    found = Claim("", "", partial(steadiest, metric="hd")).finding(table)
    assert found.interval.value == pytest.approx(np.std(calm) - np.std(wild))
    assert found.verdict == REPRODUCED
    assert Claim("", "", partial(steadiest, metric="hd")).outcome(table) == "yes"
    turned = rows("hd", {GRAPH: wild, "cpd": calm, "icp": wild * 2}, MANY)
    assert Claim("", "", partial(steadiest, metric="hd")).finding(turned).verdict == NOT
    # Of waypoints the SD is over all of them, as the paper's 1.11 is over 100.
    spread = rows("waypoint_error", {GRAPH: [[1, 3]] * 10, "cpd": [[0, 10]] * 10}, MANY)
    assert STEADY_PATH.finding(spread).interval.value == pytest.approx(1 - 5)


def test_all_methods_easiest_ct_is_asked_of_each_patient_with_several():
    claim = named("all four methods do best")
    first_best = {name: [1, 2, 3] for name in (GRAPH, *BASELINES)}
    agreed = rows("waypoint_error", first_best)
    split = rows("waypoint_error", first_best | {"cpd": [3, 2, 1]}, target="p2")
    alone = rows("waypoint_error", {name: [1] for name in first_best}, ("ct1",), "p3")
    assert claim.outcome(agreed) == "1 of 1"
    assert claim.finding(agreed).verdict == REPRODUCED
    assert claim.outcome(pd.concat([agreed, split, alone])) == "1 of 2"
    assert claim.finding(pd.concat([agreed, split])).verdict == NOT
    assert claim.finding(alone) is None


def test_waypoints_are_asked_for_in_their_gap_by_the_truth_where_it_is_known():
    claim = named("waypoints arrive")
    near, far = [[1.0] * 20] * 10, [[1.0] * 10 + [9.5] * 10] * 10
    protocol = rows("waypoint_error_inplane", {GRAPH: near}, MANY)
    assert claim.finding(protocol).verdict == REPRODUCED
    truth = rows("true_waypoint_error_inplane", {GRAPH: far}, MANY)
    found = claim.finding(pd.concat([protocol, truth]))
    assert (found.interval.value, found.verdict) == (0.5, NOT)
    most = rows("true_waypoint_error_inplane", {GRAPH: [[1.0] * 18 + [9.5] * 2] * 10}, MANY)
    assert claim.finding(most).verdict == PARTLY


@pytest.mark.parametrize(("share", "expected"), [(0.002, REPRODUCED), (0.03, PARTLY), (0.2, NOT)])
@pytest.mark.parametrize("start", ["continuity of the anatomy", "branches do not interfere"])
def test_what_should_be_next_to_nothing(start, share, expected):
    metric = "stretched_share" if start.startswith("continuity") else "wrong_part_share"
    assert named(start).finding(rows(metric, {GRAPH: [share] * 10}, MANY)).verdict == expected


def test_times_come_from_the_timings_of_the_registrations():
    timings = pd.DataFrame(
        [
            {"source": s, "target": "patient", "method": m, "stage": stage, "seconds": seconds + k}
            for k, s in enumerate(MANY)
            for m, stage, seconds in (("cpd", "register", 1200), ("nonrigid_icp", "register", 60), ("", "sweep", 1e6))
        ]
    )
    rows_ = with_minutes(replication(), timings)
    slow = named("CPD takes about 20").finding(rows_)
    assert slow.interval.value == pytest.approx(20.075)
    assert slow.verdict == REPRODUCED
    assert named("non-rigid ICP much faster").finding(rows_).verdict == REPRODUCED
    quick = with_minutes(replication(), timings.assign(seconds=4.0))
    assert named("CPD takes about 20").finding(quick).verdict == NOT
    assert named("non-rigid ICP much faster").finding(quick).verdict == TIE
    assert named("CPD takes about 20").finding(replication()) is None


# --- tables ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ([REPRODUCED, REPRODUCED], REPRODUCED),
        ([REPRODUCED, PARTLY], PARTLY),
        ([REPRODUCED, NOT], PARTLY),
        ([REPRODUCED, TIE], PARTLY),
        ([TIE, TIE], TIE),
        ([TIE, NOT], NOT),
        ([UNTESTABLE, UNTESTABLE], UNTESTABLE),
        ([], UNKNOWN),
    ],
)
def test_a_verdict_over_all_data_sets(found, expected):
    assert overall(found) == expected


def test_the_table_has_a_row_a_claim_and_a_column_a_run():
    values = replication()
    unknown = values[values["metric"] != "true_waypoint_error"]
    table = claims_table({"one": changed(values, "hd", "cpd", [5, 14, 15]), "two": unknown})
    assert list(table.columns) == ["paper", "one", "two", "here"]
    assert list(table.index) == [claim.text for claim in CLAIMS]
    assert table.loc[HD.text].tolist() == ["5 of 5", f"2 of 3: {PARTLY}", f"3 of 3: {REPRODUCED}", PARTLY]
    assert table.loc[TRUE.text].tolist() == [UNKNOWN, f"3 of 3: {REPRODUCED}", UNKNOWN, REPRODUCED]


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
