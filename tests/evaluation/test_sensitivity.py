"""Every choice of the graph and around it, paired over people and seeds, with what cannot be judged counted."""

import numpy as np
import pandas as pd
import pytest

from study.evaluation.ablation import options
from study.evaluation.disturbances import Disturbance
from study.evaluation.sensitivity import MEASURES, sensitivity_rows, sensitivity_summary, settings
from study.methods import METHODS
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.skeleton.som import SomParams

SHORT = SomParams(epochs=20, samples=50)
QUICK = SkeletonGraphMethod(SHORT, SHORT)
SMALL = Disturbance(ct_points=2500, us_points=2500)
CHOICES = ("random draws", "N of the blend (paper silent)", "parts of a cartilage (waypoints)")
CHOICES = (*CHOICES, "rectangle of the sternum (coarse)")


def test_choices_are_those_of_the_graph_and_those_around_it():
    listed = settings()
    graph = options(METHODS["skeleton_graph"])
    assert [(one.choice, one.option, one.method) for one in listed[: len(graph)]] == [
        (one.choice, one.option, one.method) for one in graph
    ]
    more = listed[len(graph) :]
    assert [one.option for one in more if one.role == "paper"] == ["1,000", "k-means", "30 × 90 mm, 0.6 covered"]
    assert more[0].method == METHODS["cpd_tuned"]
    assert len({(one.method, one.cut, one.sternum) for one in more}) == len(more) - 1  # two published graphs
    for choice in dict.fromkeys(one.choice for one in listed):
        assert [one.role == "paper" for one in listed if one.choice == choice][:2] == [True, False]


@pytest.fixture(scope="module")
def rows():
    listed = [one for one in settings(QUICK) if one.choice in CHOICES]
    return pd.DataFrame(sensitivity_rows(523, listed, (0, 1), SMALL))


def value(rows, option, metric, seed=0):
    return rows[(rows["option"] == option) & (rows["metric"] == metric) & (rows["seed"] == seed)]["value"].item()


def test_options_behind_the_maps_share_them_and_other_seeds_do_not(rows):
    assert set(rows["metric"]) == set(MEASURES)
    for metric in ("true_waypoint_error", "hd", "stretched_share"):
        published = [value(rows, option, metric) for option in ("one seed", "3 nodes", "k-means")]
        assert len(set(published)) == 1
        assert value(rows, "equal slices", metric) == published[0]  # only the protocol's waypoints change
        drawn = [value(rows, option, metric, seed) for option in ("one seed", "other seeds") for seed in (0, 1)]
        assert len(set(drawn)) == 4
    assert value(rows, "equal slices", "waypoint_error") != value(rows, "k-means", "waypoint_error")
    assert value(rows, "1 node", "stretched_share") != value(rows, "3 nodes", "stretched_share")


def test_a_coarse_alignment_that_refuses_is_rows_with_its_reason(rows):
    strict = rows[rows["option"] == "0.8 covered"]
    if strict["value"].isna().any():
        assert strict["value"].isna().all()
        assert strict["reason"].str.contains("expected|sternum").all()
    assert rows.loc[rows["value"].isna(), "option"].isin(["0.8 covered", "25 × 90 mm"]).all()


def planted(role, option, values):
    return [
        {"choice": "c", "option": option, "role": role, "metric": "hd", "people": p, "seed": s, "value": v}
        for (p, s), v in zip([(p, s) for p in (1, 2) for s in (0, 1)], values, strict=True)
    ]


def test_a_summary_pairs_people_and_seeds_and_averages_the_seeds_first():
    table = pd.DataFrame(
        [
            *planted("paper", "a", [1.0, 3.0, 10.0, 12.0]),
            *planted("alternative", "b", [2.0, 4.0, 13.0, 15.0]),
            *planted("alternative", "half", [2.0, 4.0, None, None]),
            *planted("alternative", "none", [None] * 4),
        ]
    )
    found = sensitivity_summary(table).set_index("option")
    b = found.loc["b"]
    assert (b["mean"], b["published"], b["change"], b["people"], b["failed"]) == (8.5, 6.5, 2.0, 2, 0)
    assert (b["low"], b["high"]) == (1.0, 3.0)
    assert b["seed_sd"] == pytest.approx(np.sqrt(2))
    assert (found.loc["half", "change"], found.loc["half", "published"]) == (1.0, 2.0)
    assert (found.loc["half", "people"], found.loc["half", "failed"]) == (1, 1)
    assert (found.loc["none", "people"], found.loc["none", "failed"]) == (0, 2)
    assert np.isnan(found.loc["none", "change"])
    assert (found.loc["a", "change"], found.loc["a", "low"]) == (0, 0)
