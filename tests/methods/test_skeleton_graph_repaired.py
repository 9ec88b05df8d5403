"""The mended graph: its steps in their order, its field, what it recovers, and its recorded settings."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from oracles import check_tuned

from study import METHODS
from study.alignment.chest import align
from study.alignment.frame import chest_frame
from study.errors import StudyError
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.methods.skeleton_graph_repaired import RepairedRegistration, SkeletonGraphRepaired
from study.methods.visible_surface import VisibleSurface
from study.pipeline import register_aligned
from study.skeleton.batch_som import BatchSomParams, fit_batch_som
from study.skeleton.spline import NodeSpline
from study.skeleton.template import template_graph
from study.types import Part, PointCloud

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def alignment(ct_clouds, us_cloud):
    return align(PointCloud(ct_clouds["ct2"].points, "ct"), PointCloud(us_cloud.points, "us"))


@pytest.fixture(scope="module")
def pair(alignment):
    return alignment.source.cloud.moved(alignment.T_us_ct), alignment.target.cloud


def test_it_is_registered_on_the_visible_surface_as_tuned():
    assert METHODS["skeleton_graph_repaired"] == VisibleSurface(SkeletonGraphRepaired.tuned())
    check_tuned(SkeletonGraphRepaired.tuned())


@pytest.mark.parametrize("every", [True, False])
def test_it_is_template_map_map_and_field(pair, every):
    source, target = pair
    method = SkeletonGraphRepaired(smooth_every_epoch=every)
    result = method.register(source, target, RNG)
    template = template_graph(chest_frame(source))
    g_ct = template.with_nodes(fit_batch_som(template, source, method.ct_som).nodes)
    smoother = method.spline.smoother(g_ct.nodes) if every else None
    reached = fit_batch_som(g_ct, target, method.us_som, smoother).nodes
    field = method.spline.field(g_ct.nodes, reached)
    assert np.array_equal(result.g_ct.nodes, g_ct.nodes)
    assert np.array_equal(result.g_us.nodes, field.apply(g_ct.nodes))
    assert np.array_equal(result.warped, field.apply(source.points))
    assert "nodes moved" in result.stop_reason


def test_the_field_survives_every_wrapper_and_carries_hidden_points_and_waypoints(alignment):
    result = register_aligned(alignment, METHODS["skeleton_graph_repaired"], RNG)
    assert isinstance(result, RepairedRegistration)
    source = alignment.source.cloud.points
    assert np.array_equal(result.source, source)
    assert result.warped == pytest.approx(result.carry(source), abs=1e-9)  # seen and hidden alike
    assert result.transfer(source[::500]) == pytest.approx(result.warped[::500], abs=1e-9)
    assert result.field.apply(result.g_ct.nodes) == pytest.approx(result.g_us.nodes, abs=1e-9)


def test_a_planted_deformation_is_found_better_than_by_the_papers_maps(pair):
    source, _ = pair
    frame = chest_frame(source)
    x, y, z = frame.T_cloud_chest.inverse.apply(source.points).T
    bent = np.column_stack([x * 1.04, y + 5 * np.sin(x / 50), z + 3 * np.cos(x / 60)])
    planted = frame.T_cloud_chest.apply(bent)
    # The other half of the points is what the target shows.
    shown = np.random.default_rng(1).permutation(len(source))[: len(source) // 2]
    target = PointCloud(planted[shown], "bent", source.parts[shown])
    errors = [
        np.linalg.norm(method.register(source, target, np.random.default_rng(0)).warped - planted, axis=1).mean()
        for method in (SkeletonGraphRepaired(), SkeletonGraphMethod.tuned())
    ]
    assert np.linalg.norm(source.points - planted, axis=1).mean() > 4.0
    assert errors[0] < 1.5
    assert errors[0] < 0.7 * errors[1]


def test_a_strip_that_the_sweep_missed_pulls_its_nodes_away_less_than_the_papers(pair):
    source, _ = pair
    up = chest_frame(source).T_cloud_chest.inverse.apply(source.points)[:, 1]
    missed = np.abs(up) < 8.0  # right across the chest
    seen = PointCloud(source.points[~missed], "gap", source.parts[~missed])
    moved = [
        np.linalg.norm(method.register(source, seen, np.random.default_rng(0)).warped - source.points, axis=1)[missed]
        for method in (SkeletonGraphRepaired(), SkeletonGraphMethod.tuned())
    ]
    # A map fills what it sees: wide gaps are the weakness of every one of them.
    assert moved[0].mean() < 0.6 * moved[1].mean()


def test_a_map_stopped_in_its_fall_has_not_converged(pair):
    short = BatchSomParams(epochs=4, max_rest=0)
    for early in ({"ct_som": short}, {"us_som": short}):
        assert not replace(SkeletonGraphRepaired(), **early).register(*pair, RNG).converged
    assert SkeletonGraphRepaired().register(*pair, RNG).converged


def test_a_cloud_without_labels_or_with_a_part_missing_is_refused(pair):
    source, target = pair
    with pytest.raises(StudyError, match="expected labelled parts, got none"):
        SkeletonGraphRepaired().register(PointCloud(source.points), target, RNG)
    with pytest.raises(StudyError, match="expected labelled parts for winners 'own_part', got none"):
        SkeletonGraphRepaired().register(source, PointCloud(target.points), RNG)
    keep = source.parts != Part.RIGHT_4
    with pytest.raises(StudyError, match="got none on RIGHT_4"):
        SkeletonGraphRepaired().register(PointCloud(source.points[keep], "ct", source.parts[keep]), target, RNG)


def test_every_choice_is_a_named_parameter():
    method = asdict(SkeletonGraphRepaired(spline=NodeSpline("linear", 30.0)))
    assert (method["ct_som"]["winners"], method["us_som"]["lengths"]) == ("own_part", "geodesic")
    assert method["spline"] == {"kernel": "linear", "smoothing": 30.0}
