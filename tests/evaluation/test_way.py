"""The way from the paper's method to the best one: what each step changes, and what it is judged by."""

from dataclasses import asdict
from itertools import pairwise

import numpy as np
import pytest

from study.errors import StudyError
from study.evaluation.judgement import Judgement
from study.evaluation.way import LEFT_OUT, ON_THE_WAY, BySphere, Step, walk, way_to_best
from study.methods import BEST_METHOD, METHODS
from study.methods.gaussian_process import FieldRegistration
from study.methods.visible_surface import VisibleSurface
from study.pipeline import register_aligned
from study.registration import Registration, transfer
from study.seeds import named_rng

BEST = METHODS[BEST_METHOD]
COARSE = Step(ON_THE_WAY, "coarse", METHODS["coarse"])


def flat(values: object, at: str = "") -> dict[str, object]:
    """Every leaf of nested parameters by its path; the sphere's wrapper is one more."""
    if isinstance(values, dict):
        leaves: dict[str, object] = {}
        for name, value in values.items():
            leaves |= flat(value, f"{at}/{name}")
        return leaves
    return {at: values}


def ideas(method: VisibleSurface) -> dict[str, object]:
    """Parameters of the field method behind its wrappers; a part that is left out is one leaf."""
    inner = method.method if isinstance(method, VisibleSurface) else method
    sphere = isinstance(inner, BySphere)
    given = asdict(inner.method if sphere else inner)
    for part in ("ends", "breathing"):
        given[part] = str(given[part])
    return flat(given) | {"sphere": sphere, "visible": isinstance(method, VisibleSurface)}


def test_the_way_starts_with_the_paper_ends_with_the_best_and_changes_one_thing_a_step():
    way = [step.method for step in way_to_best() if step.role == ON_THE_WAY]
    assert way[0] == METHODS["skeleton_graph"]
    assert way[-1] == BEST
    field = [ideas(method) for method in way[3:]]
    for before, after in pairwise(field):
        assert sum(before[name] != after[name] for name in before) == 1


def test_each_idea_is_left_out_alone():
    best = ideas(BEST)
    left_out = {step.change: ideas(step.method) for step in way_to_best() if step.role == LEFT_OUT}
    assert len(left_out) == 7
    for change, without in left_out.items():
        assert sum(best[name] != without[name] for name in best) == (change != "nothing")


def test_a_forgotten_field_leaves_the_points_and_the_paper_s_sphere(pair):
    known, forgotten = (
        register_aligned(pair.alignment, method, np.random.default_rng(0))
        for method in (BEST, VisibleSurface(BySphere(BEST.method)))
    )
    assert isinstance(known, FieldRegistration)
    assert type(forgotten) is Registration
    seen = pair.visible
    assert forgotten.warped[seen] == pytest.approx(known.warped[seen], abs=1e-9)
    assert np.array_equal(
        forgotten.transfer(pair.waypoints_ct), transfer(forgotten.source, forgotten.warped, pair.waypoints_ct)
    )


def test_walk_judges_by_the_truth(pair):
    table = walk([pair], [COARSE, Step(LEFT_OUT, "nothing", BEST)], 0)
    assert table["change"].to_list() == ["coarse", "nothing"]
    judged = Judgement(pair, register_aligned(pair.alignment, METHODS["coarse"], named_rng(0, pair.name)))
    assert table["true"][0] == pytest.approx(judged.true_waypoint_errors_mm().mean())
    assert table["registered"][0] == table["true"][0]  # the pair's shift is 0
    assert table["in_plane"][0] < table["true"][0]
    assert table["true"][1] < 0.5 * table["true"][0]


def test_nothing_to_walk_is_refused(pair):
    with pytest.raises(StudyError, match="got 0 and 1"):
        walk([], [COARSE], 0)
    with pytest.raises(StudyError, match="got 1 and 0"):
        walk([pair], [], 0)
