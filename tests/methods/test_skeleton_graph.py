"""The proposed method: its parts in their order, and what it needs of its clouds."""

from dataclasses import replace

import numpy as np
import pytest
from oracles import check_tuned
from oracles_som import blend_literal, local_transforms_literal

from study.alignment.chest import align
from study.alignment.frame import chest_frame
from study.errors import StudyError
from study.methods.skeleton_graph import SkeletonGraphMethod, SkeletonRegistration
from study.methods.visible_surface import VisibleSurface
from study.pipeline import run_method
from study.skeleton.som import SomParams, fit_som
from study.skeleton.template import template_graph
from study.types import Part, PointCloud

QUICK = SkeletonGraphMethod(SomParams(epochs=60), SomParams(epochs=60))


@pytest.fixture(scope="module")
def pair(ct_clouds, us_cloud):
    alignment = align(PointCloud(ct_clouds["ct2"].points, "ct"), PointCloud(us_cloud.points, "us"))
    return alignment.source.cloud.moved(alignment.T_us_ct), alignment.target.cloud


def test_the_published_values_are_the_defaults():
    method = SkeletonGraphMethod()
    assert (method.n_reg, method.neighbours, method.blend_weights) == (3, "nodes", "distance")
    assert method.ct_som.rate == method.us_som.rate == 0.1


def test_the_tuned_settings_are_the_best_of_the_recorded_grids():
    check_tuned(SkeletonGraphMethod.tuned())
    check_tuned(SkeletonGraphMethod.tuned_whole(), "_whole")


def test_the_authors_choices_are_their_codes():
    method = SkeletonGraphMethod.as_authors()
    assert (method.n_reg, method.neighbours, method.blend_k, method.blend_weights) == (3, "hops", 3, "distance")
    ct, us = method.ct_som, method.us_som
    assert (ct.epochs, ct.samples, ct.pretrain_epochs, ct.pretrain_rate) == (5000, 500, 3, 0.02)
    assert (us.epochs, us.samples, us.pretrain_epochs) == (3000, 130, 0)
    for som in (ct, us):
        assert (som.rate, som.rate_schedule) == (0.1, "compounding")
        assert (som.radius, som.radius_schedule, som.winners) == (5, "compounding", "any")


def test_it_is_template_map_map_eq_3_eq_4(pair):
    source, target = pair
    method = replace(QUICK, neighbours="hops")  # 9 or more nodes: no rotation hangs on rounding
    result = method.register(source, target, np.random.default_rng(0))
    rng = np.random.default_rng(0)
    g_ct, _ = fit_som(template_graph(chest_frame(source)), source, QUICK.ct_som, rng)
    g_us, _ = fit_som(g_ct, target, QUICK.us_som, rng)
    assert np.array_equal(result.g_ct.nodes, g_ct.nodes)
    assert np.array_equal(result.g_us.nodes, g_us.nodes)
    assert np.array_equal(result.template.nodes, template_graph(chest_frame(source)).nodes)
    motions = local_transforms_literal(g_ct.nodes, g_us.nodes, g_ct.hops(directed=False), 3, "hops")
    rows = np.arange(0, len(source), 100)
    literal = blend_literal(source.points[rows], g_ct.nodes, motions, 3, "distance")
    assert np.abs(result.warped[rows] - literal).max() < 1e-6


def test_another_seed_gives_another_but_near_answer(pair):
    one, other = (QUICK.register(*pair, np.random.default_rng(seed)).warped for seed in (0, 1))
    apart = np.linalg.norm(one - other, axis=1)
    assert 0 < np.median(apart) < 15.0


def test_the_maps_close_on_their_clouds(pair):
    source, target = pair
    result = QUICK.register(source, target, np.random.default_rng(0))
    nodes = result.g_us.nodes
    distances = np.linalg.norm(target.points[:, None] - nodes[None], axis=2).min(axis=1)
    assert result.history[-1] == pytest.approx(distances.mean())
    assert distances.mean() < 6.0  # 246 nodes on such a surface are some 8 mm apart
    assert result.n_iterations == 120
    assert result.stop_reason


def test_a_schedule_that_ends_too_early_has_not_converged(pair):
    rng = np.random.default_rng
    assert SkeletonGraphMethod().register(*pair, rng(0)).converged
    short = replace(SomParams(), epochs=8, samples=50)
    for early in (SkeletonGraphMethod(ct_som=short), SkeletonGraphMethod(us_som=short)):
        result = early.register(*pair, rng(0))
        assert not result.converged
        assert "fell by" in result.stop_reason


def test_a_source_without_labels_or_with_a_part_missing_is_refused(pair):
    source, target = pair
    rng = np.random.default_rng(0)
    with pytest.raises(StudyError, match="expected labelled parts, got none"):
        QUICK.register(PointCloud(source.points), target, rng)
    keep = source.parts != Part.RIGHT_4
    with pytest.raises(StudyError, match="got none on RIGHT_4"):
        QUICK.register(PointCloud(source.points[keep], "ct", source.parts[keep]), target, rng)


def test_the_graphs_stay_with_the_result_through_every_wrapper(pair):
    source, target = pair
    result = run_method(VisibleSurface(QUICK), source, target, np.random.default_rng(0), "mine")
    assert isinstance(result, SkeletonRegistration)
    assert len(result.template) == len(result.g_ct) == len(result.g_us)
    assert result.warped.shape == source.points.shape
    assert result.method == "mine"


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"n_reg": 2}, "n_reg >= 3 nodes, got 2"),
        ({"n_reg": 0, "neighbours": "hops"}, "n_reg >= 1 hops, got 0"),
        ({"neighbours": "edges"}, r"neighbours nodes\|hops, got 'edges'"),
        ({"blend_k": 0}, "blend_k >= 1, got 0"),
        ({"blend_weights": "equal"}, r"blend_weights distance\|inverse_distance, got 'equal'"),
    ],
)
def test_bad_parameters_are_refused_by_name(bad, message):
    with pytest.raises(StudyError, match=f"skeleton_graph: expected {message}; "):
        SkeletonGraphMethod(**bad)
