"""Every choice in its order, every option against the published one, and what is more than luck."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pandas as pd
import pytest

from study.errors import StudyError
from study.evaluation import ablation
from study.evaluation.ablation import (
    AS_AUTHORS,
    PROTOCOL,
    RIGID,
    TRUE_IN_PLANE,
    Option,
    ablate,
    beyond_luck,
    changes,
    options,
)
from study.evaluation.judgement import Judgement
from study.methods import METHODS
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.methods.visible_surface import VisibleSurface
from study.pipeline import register_aligned
from study.seeds import named_rng
from study.skeleton.som import SomParams

LISTED = {
    "random draws": ["one seed", "other seeds"],
    "learning rate (Eq. 2)": ["constant", "compounding", "linear to 0"],
    "epochs × samples (paper silent)": ["1000 × 500", "5000 × 500, US 3000 × 130", "200 × 500"],
    "start of the neighbourhood (paper silent)": ["5 hops", "2 hops", "3 hops"],
    "fall of the neighbourhood (paper silent)": ["linear", "compounding radius"],
    "one-way edges in the first epochs": ["3 epochs", "of the CT map only", "none"],
    "nodes that may win a point": ["any", "of the point's own part"],
    "nodes of a local transform (Eq. 3)": ["3 nodes", "within 3 hops", "16 nodes", RIGID],
    "weights of the blend (Eq. 4)": ["distance", "inverse distance"],
    "N of the blend (paper silent)": ["3 nodes", "1 node", "8 nodes"],
    "sphere of path transfer (§III-D)": ["20 mm", "30 mm", "40 mm"],
    "surface of the CT that is registered": ["all of it", "what a probe can see"],
    "all of it together": ["as published", AS_AUTHORS, "skeleton_graph_tuned"],
}
PUBLISHED = SkeletonGraphMethod()
QUICK = SkeletonGraphMethod(SomParams(epochs=20, samples=50), SomParams(epochs=20, samples=50))
CHEAP = [
    Option("random draws", "one seed", "paper", QUICK, 20.0),
    Option("random draws", "other seeds", "yardstick", QUICK, 20.0),
    Option("blend", "3 nodes", "paper", QUICK, 20.0),
    Option("blend", "1 node", "alternative", replace(QUICK, blend_k=1), 20.0),
    Option("sphere", "20 mm", "paper", QUICK, 20.0),
    Option("sphere", "40 mm", "alternative", QUICK, 40.0),
]


def chosen(option, listed=None):
    return next(one for one in listed or options(PUBLISHED) if one.option == option)


def test_choices_are_listed_in_the_papers_order_each_with_its_published_option_first():
    by_choice = {choice: list(some) for choice, some in groupby(options(PUBLISHED), lambda option: option.choice)}
    assert list(by_choice) == list(LISTED)
    for choice, some in by_choice.items():
        assert [option.option for option in some] == LISTED[choice]
        assert [option.role == "paper" for option in some] == [True] + [False] * (len(some) - 1)
        assert (some[0].method, some[0].radius_mm) == (PUBLISHED, 20.0)


def test_every_option_but_the_yardstick_changes_something():
    listed = options(PUBLISHED)
    others = [option for option in listed if option.role != "paper"]
    assert [option.option for option in others if option.role == "yardstick"] == ["other seeds"]
    for option in others:
        same = (option.method, option.radius_mm) == (PUBLISHED, 20.0)
        assert same == (option.role == "yardstick"), option
    tried = [(option.method, option.radius_mm) for option in others if option.role != "yardstick"]
    assert len(set(tried)) == len(tried)


def test_options_of_the_authors_code_are_theirs():
    assert [option.option for option in options(PUBLISHED) if option.role == "authors"] == [
        "compounding",
        "5000 × 500, US 3000 × 130",
        "compounding radius",
        "of the CT map only",
        "within 3 hops",
        AS_AUTHORS,
    ]
    longer = chosen("5000 × 500, US 3000 × 130").method
    assert longer.ct_som == replace(PUBLISHED.ct_som, epochs=5000, samples=500)
    assert longer.us_som == replace(PUBLISHED.us_som, epochs=3000, samples=130)
    everything = chosen(AS_AUTHORS).method
    dying = {"rate_schedule": "compounding", "radius_schedule": "compounding"}
    assert everything.ct_som == replace(longer.ct_som, **dying)
    assert everything.us_som == replace(longer.us_som, **dying, pretrain_epochs=0)
    assert (everything.n_reg, everything.neighbours) == (3, "hops")
    assert replace(everything, ct_som=PUBLISHED.ct_som, us_som=PUBLISHED.us_som, neighbours="nodes") == PUBLISHED
    one_by_one = [option.method for option in options(PUBLISHED) if option.role == "authors"][:-1]
    for field in ("rate_schedule", "radius_schedule", "epochs", "samples", "pretrain_epochs"):
        for som in ("ct_som", "us_som"):  # what they change together, they change one at a time
            alone = {getattr(getattr(method, som), field) for method in one_by_one}
            assert getattr(getattr(everything, som), field) in alone, (som, field)


def test_options_follow_the_method_and_the_sphere_they_are_asked_for():
    listed = options(QUICK, 25.0)
    assert {option.radius_mm for option in listed} == {25.0, 30.0, 40.0}
    assert chosen("25 mm", listed).role == "paper"
    assert chosen("20 × 50", listed).method is QUICK
    assert chosen("4 × 50", listed).method.us_som == replace(QUICK.us_som, epochs=4)
    assert chosen("what a probe can see", listed).method == VisibleSurface(QUICK)
    assert chosen("skeleton_graph_tuned", listed).method == METHODS["skeleton_graph_tuned"]
    assert chosen("30 mm", listed).method is QUICK


def test_all_nodes_in_every_fit_is_a_rigid_motion(pair):
    method = chosen(RIGID, options(QUICK)).method
    result = register_aligned(pair.alignment, method, np.random.default_rng(0))
    source, warped = (points - points.mean(axis=0) for points in (result.source, result.warped))
    assert np.linalg.norm(source, axis=1) == pytest.approx(np.linalg.norm(warped, axis=1), abs=1e-6)


@pytest.fixture(scope="module")
def table(pair):
    return ablate([pair], CHEAP, seed=3)


def test_every_option_is_judged_on_every_pair_under_its_own_draws(table, pair):
    assert list(table.columns) == ["choice", "option", "role", "case", "judge", "value"]
    assert set(table["case"]) == {"ct1 to patient"}
    counts = table.groupby(["choice", "option", "judge"]).size()
    assert len(counts) == 2 * len(CHEAP)
    assert all(count == (3 if option == "other seeds" else 1) for (_, option, _), count in counts.items())

    def direct(method, draw, radius_mm):
        result = register_aligned(pair.alignment, method, named_rng(3, f"ct1/patient/{draw}"))
        judged = Judgement(pair, result, radius_mm)
        return [judged.protocol_errors_mm().mean(), judged.true_waypoint_errors_mm(in_plane=True).mean()]

    def found(option):
        return table.loc[table["option"] == option, "value"].tolist()

    assert found("one seed") == found("20 mm") == found("3 nodes") == direct(QUICK, "first", 20.0)
    assert found("1 node") == direct(replace(QUICK, blend_k=1), "first", 20.0)
    assert found("40 mm") == direct(QUICK, "first", 40.0)
    more = [value for draw in ("second", "third", "fourth") for value in direct(QUICK, draw, 20.0)]
    assert found("other seeds") == more
    assert len({*more, *found("one seed")}) == 8


def test_options_that_differ_in_the_sphere_share_their_registration(table, pair, monkeypatch):
    calls = []

    def counted(alignment, method, rng):
        calls.append(method)
        return register_aligned(alignment, method, rng)

    monkeypatch.setattr(ablation, "register_aligned", counted)
    again = ablate([pair], CHEAP, seed=3)
    assert calls == [QUICK] * 4 + [replace(QUICK, blend_k=1)]  # the first draw, three more, and the other blend
    pd.testing.assert_frame_equal(again, table, check_exact=True)


def test_two_real_people_are_judged_by_the_protocol_alone(real_pair, table):
    alone = ablate([real_pair], CHEAP[:1], seed=3)
    assert alone["judge"].tolist() == [PROTOCOL]
    assert alone["value"][0] == table["value"][0]
    assert set(table["judge"]) == {PROTOCOL, TRUE_IN_PLANE}


def test_nothing_to_compare_is_refused(pair):
    with pytest.raises(StudyError, match="got 0 and 6"):
        ablate([], CHEAP, seed=0)
    with pytest.raises(StudyError, match="got 1 and 0"):
        ablate([pair], [], seed=0)


def planted(rows):
    return pd.DataFrame(rows, columns=["choice", "option", "role", "case", "judge", "value"])


DRAWS = planted(
    [
        ("draws", "one seed", "paper", "a", PROTOCOL, 5.0),
        ("draws", "one seed", "paper", "b", PROTOCOL, 7.0),
        *(("draws", "other seeds", "yardstick", "a", PROTOCOL, 5.0 + change) for change in (-0.2, 0.1)),
        *(("draws", "other seeds", "yardstick", "b", PROTOCOL, 7.0 + change) for change in (0.0, 0.5)),
        ("rate", "constant", "paper", "a", PROTOCOL, 5.0),
        ("rate", "constant", "paper", "b", PROTOCOL, 7.0),
        ("rate", "linear", "alternative", "a", PROTOCOL, 5.3),
        ("rate", "linear", "alternative", "b", PROTOCOL, 7.0),
        ("rate", "authors", "authors", "a", PROTOCOL, 4.0),
        ("rate", "authors", "authors", "b", PROTOCOL, 7.4),
        ("rate", "steep", "alternative", "a", PROTOCOL, 6.0),
        ("rate", "steep", "alternative", "b", PROTOCOL, 8.0),
    ]
)


def test_a_change_is_against_the_published_option_of_that_choice_pair_and_judge():
    by_truth = DRAWS.assign(judge=TRUE_IN_PLANE, value=DRAWS["value"] * 2)
    changed = changes(pd.concat([DRAWS, by_truth], ignore_index=True))
    assert len(changed) == 2 * len(DRAWS)
    assert (changed.loc[changed["role"] == "paper", "change"] == 0).all()
    expected = [0, 0, -0.2, 0.1, 0, 0.5, 0, 0, 0.3, 0, -1, 0.4, 1, 1]
    assert changed["change"].to_numpy() == pytest.approx([*expected, *np.multiply(expected, 2)])
    assert changed.loc[changed["option"] == "linear", "published"].tolist() == [5, 7, 10, 14]


def test_only_a_mean_change_that_leaves_the_range_of_other_draws_is_more_than_luck():
    (low, high), beyond = beyond_luck(changes(DRAWS))
    draws = np.array([-0.2, 0.1, 0, 0.5])
    assert (low, high) == pytest.approx((draws.mean() - draws.std(), draws.mean() + draws.std()))
    assert beyond.to_dict() == pytest.approx({("rate", "authors"): -0.3, ("rate", "steep"): 1.0})  # linear: +0.15


def test_luck_is_judged_by_one_judge_and_a_yardstick():
    with pytest.raises(StudyError, match="protocol, truth"):
        beyond_luck(changes(pd.concat([DRAWS, DRAWS.assign(judge=TRUE_IN_PLANE)])))
    with pytest.raises(StudyError, match="got 0 rows of a yardstick"):
        beyond_luck(changes(DRAWS[DRAWS["choice"] == "rate"]))
