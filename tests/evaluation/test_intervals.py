"""Intervals over people: planted means are covered, pairs count as their people do, and a tie is a tie."""

import numpy as np
import pandas as pd
import pytest

from study.errors import StudyError
from study.evaluation.intervals import (
    ENDS,
    FEW,
    Interval,
    difference_intervals,
    draw_weights,
    mean_intervals,
    over_people,
    paired_intervals,
)

PEOPLE = [f"p{k:02d}" for k in range(12)]
EVERY = [(a, b) for a in PEOPLE for b in PEOPLE if a != b]


def series(pairs, values):
    return pd.Series(np.asarray(values, float), index=pd.MultiIndex.from_tuples(pairs, names=ENDS))


def measured(rng, pairs, mean=3.0, of_person=1.0, of_pair=0.5):
    """Values that differ by CT, by patient and by pair."""
    as_ct, as_patient = (dict(zip(PEOPLE, rng.normal(0, of_person, len(PEOPLE)), strict=True)) for _ in range(2))
    return series(pairs, [mean + as_ct[a] + as_patient[b] + rng.normal(0, of_pair) for a, b in pairs])


def naive(values, rng, n_draws=400):
    """What an interval over pairs would be, as if they were independent."""
    drawn = rng.integers(0, len(values), (n_draws, len(values)))
    return np.percentile(values.to_numpy()[drawn].mean(axis=1), [2.5, 97.5])


def test_a_planted_mean_is_covered_as_often_as_said_and_by_pairs_alone_it_is_not():
    rng = np.random.default_rng(0)
    covered, by_pairs = 0, 0
    for k in range(200):
        values = measured(rng, EVERY)
        found = over_people(values, seed=k, n_draws=400)
        low, high = naive(values, rng)
        covered += found.low <= 3.0 <= found.high
        by_pairs += low <= 3.0 <= high
    assert 0.89 < covered / 200 < 0.99
    assert by_pairs / 200 < 0.65


def test_a_design_of_a_few_atlases_a_patient_is_covered_too():
    rng = np.random.default_rng(1)
    design = [(PEOPLE[(k + step) % 12], PEOPLE[k]) for k in range(12) for step in (1, 5, 8)]
    found = [over_people(measured(rng, design), seed=k, n_draws=400) for k in range(150)]
    assert np.mean([one.low <= 3.0 <= one.high for one in found]) > 0.9


def test_a_pair_counts_as_often_as_both_of_its_people_and_oneself_once():
    pairs = pd.MultiIndex.from_tuples([("a", "b"), ("b", "a"), ("a", "c"), ("c", "c")], names=ENDS)
    weights, n_people = draw_weights(pairs, np.random.default_rng(0), 500)
    assert n_people == 3
    assert np.array_equal(weights[:, 0], weights[:, 1])
    c = weights[:, 3]
    known = (c > 0) & (weights[:, 2] > 0)
    assert known.sum() > 50
    a = weights[known, 2] / c[known]
    b = weights[known, 0] / a
    assert set(a + b + c[known]) == {3.0}  # as many are drawn as there are
    assert weights.any(axis=1).all()


def test_a_role_of_one_is_not_resampled_and_roles_are_drawn_apart():
    cts = [f"ct{k}" for k in range(5)]
    values = series([(ct, "patient") for ct in cts], [1.0, 2.0, 3.0, 4.0, 5.0])
    found = over_people(values)
    assert (found.value, found.n_pairs, found.n_people, found.is_rough) == (3.0, 5, 5, True)
    assert 1.0 <= found.low < 2.2
    assert 3.8 < found.high <= 5.0
    weights, _ = draw_weights(values.index, np.random.default_rng(0), 300)
    assert set(weights.sum(axis=1)) == {5.0}
    both = pd.MultiIndex.from_product([cts, ["x", "y", "z"]], names=ENDS)
    weights, fewest = draw_weights(both, np.random.default_rng(0), 300)
    assert fewest == 3
    assert set(weights.sum(axis=1)) == {15.0}


def test_a_single_pair_has_a_value_and_no_interval():
    found = over_people(series([("a", "b")], [2.0]))
    assert (found.value, found.n_people, found.is_known) == (2.0, 0, False)
    assert str(found) == "2.00"
    assert found.is_tie(0.01)


def test_sweeps_and_deformations_of_a_person_are_averaged_first():
    single = measured(np.random.default_rng(2), EVERY)
    swept = [(a, f"{b}#{k}" if k else b) for a, b in EVERY for k in range(3)]
    thrice = series(swept, np.repeat(single.to_numpy(), 3) + np.tile([-1.0, 0.0, 1.0], len(EVERY)))
    one, many = over_people(single), over_people(thrice)
    assert (many.n_pairs, many.n_people) == (one.n_pairs, one.n_people) == (len(EVERY), 12)
    assert [many.value, many.low, many.high] == pytest.approx([one.value, one.low, one.high])
    planted = series([(p, f"{p}+planted{k}") for p in ("a", "b", "c") for k in (1, 2)], [1, 3, 4, 6, 7, 9])
    found = over_people(planted)
    assert (found.value, found.n_pairs, found.n_people) == (5.0, 3, 3)


def test_the_same_seed_gives_the_same_interval_and_many_draws_hardly_move_it():
    values = measured(np.random.default_rng(3), EVERY)
    assert over_people(values) == over_people(values)
    other = over_people(values, seed=1)
    assert other != over_people(values)
    assert abs(other.low - over_people(values).low) < 0.1


def test_what_people_have_in_common_cancels_in_a_difference():
    rng = np.random.default_rng(4)
    base = measured(rng, EVERY, of_person=5.0)
    table = pd.DataFrame({"graph": base, "icp": base + 0.5 + rng.normal(0, 0.1, len(base))})
    means, gap = mean_intervals(table), difference_intervals(table, "graph", 0.01)
    assert gap.loc["icp", "value"] == pytest.approx(-0.5, abs=0.05)
    assert gap.loc["icp", "high"] < -0.4
    assert not gap.loc["icp", "is_tie"]
    assert means.loc["graph", "high"] - means.loc["graph", "low"] > 2
    assert means["n_people"].tolist() == [12, 12]
    assert not means["is_rough"].any()
    assert means.loc["graph", "n_pairs"] == len(EVERY) >= FEW


def test_a_method_that_failed_on_a_pair_is_compared_where_both_have_a_value():
    table = pd.DataFrame({"graph": measured(np.random.default_rng(5), EVERY)})
    table["icp"] = table["graph"] + 1
    table["cpd"] = np.nan
    table.iloc[0, 1] = np.nan
    gap = difference_intervals(table, "graph")
    assert gap.index.tolist() == ["icp"]
    assert gap.loc["icp", "n_pairs"] == len(EVERY) - 1
    assert mean_intervals(table).index.tolist() == ["graph", "icp"]


@pytest.mark.parametrize(
    ("low", "value", "high", "tie"),
    [(-1.0, 0.2, 1.0, True), (0.1, 0.2, 0.3, False), (-0.3, -0.2, -0.1, False), (0.001, 0.005, 0.009, True),
     (0.0, 0.2, 0.3, True), (np.nan, 5.0, np.nan, True)],
)  # fmt: skip
def test_a_tie_is_an_interval_that_holds_0_or_a_lead_nobody_can_measure(low, value, high, tie):
    assert Interval(value, low, high, 9, 9).is_tie(0.01) is tie


def test_a_pure_tie_is_told_as_one():
    runs = {"open": pd.concat({"hd": pd.DataFrame({"graph": measured(np.random.default_rng(6), EVERY)})})}
    runs["open"].index.names = ["metric", *ENDS]
    runs["open"]["same"] = runs["open"]["graph"]
    runs["open"]["worse"] = runs["open"]["graph"] + 2
    told = paired_intervals(runs, "hd", "graph").set_index("against")["verdict"]
    assert told["same"] == "0.00 [0.00, 0.00] mm, better on 0 of 132, a tie"
    assert told["worse"] == "-2.00 [-2.00, -2.00] mm, better on 132 of 132"
    assert paired_intervals(runs, "msd", "graph").empty
    assert paired_intervals(runs, "hd", "absent").empty


@pytest.mark.parametrize("values", [[], [np.nan], [np.inf]])
def test_values_that_are_not_there_are_refused(values):
    with pytest.raises(StudyError, match="leave out the cases that failed"):
        over_people(series([("a", "b")] * len(values), values) if values else series(EVERY, range(132)).iloc[:0])
