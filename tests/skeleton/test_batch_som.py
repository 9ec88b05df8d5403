"""The batch map against a literal loop, its schedule, and what a missed strip does to it."""

from dataclasses import replace

import numpy as np
import pytest
from oracles_som import hops_literal

from study.alignment.frame import chest_frame
from study.errors import StudyError
from study.skeleton.batch_som import CUT, BatchSomParams, fit_batch_som
from study.skeleton.graph import SkeletonGraph
from study.skeleton.spline import NodeSpline
from study.skeleton.template import template_graph
from study.types import Part, PointCloud

SHORT = BatchSomParams(epochs=3, max_rest=0)


@pytest.fixture(scope="module")
def start(ct_clouds):
    cloud = ct_clouds["ct1"]
    rows = np.random.default_rng(0).permutation(len(cloud))[:400]
    return template_graph(chest_frame(cloud)), PointCloud(cloud.points[rows], "ct", cloud.parts[rows])


def literal(graph, cloud, params, smoother=None):
    """Every node at the mean of all points, each weighed by theta of its winner."""
    lengths = params.lengths_mm(graph)
    nodes = placed = graph.nodes
    for epoch in range(params.epochs):
        radius = params.radius_mm(epoch)
        winners = []
        for point, part in zip(cloud.points, cloud.parts, strict=True):
            apart = np.linalg.norm(placed - point, axis=1)
            if params.winners == "own_part":
                apart[graph.parts != part] = np.inf
            winners.append(apart.argmin())
        nodes = placed.copy()
        for s in range(len(graph)):
            theta = np.exp(-(lengths[winners, s] ** 2) / (2 * radius**2)) * (lengths[winners, s] <= CUT * radius)
            if theta.sum() > 0:
                nodes[s] = theta @ cloud.points / theta.sum()
        placed = nodes if smoother is None else graph.nodes + smoother @ (nodes - graph.nodes)
    return nodes


@pytest.mark.parametrize("params", [SHORT, replace(SHORT, winners="any", lengths="hops")])
@pytest.mark.parametrize("smooth", [False, True])
def test_the_fast_map_is_the_literal_one(start, params, smooth):
    graph, cloud = start
    smoother = NodeSpline().smoother(graph.nodes) if smooth else None
    fast, slow = fit_batch_som(graph, cloud, params, smoother), literal(graph, cloud, params, smoother)
    assert np.abs(slow - graph.nodes).max() > 1.0  # it went somewhere
    assert np.abs(fast.nodes - slow).max() < 1e-9  # sums in another order
    assert len(fast.history) == 3


def test_the_radius_falls_by_one_factor_and_stays():
    params = BatchSomParams(epochs=5, start_radius_mm=16.0, end_radius_mm=1.0)
    assert [params.radius_mm(epoch) for epoch in range(7)] == pytest.approx([16, 8, 4, 2, 1, 1, 1])


def test_lengths_are_millimetres_either_way():
    line = SkeletonGraph(
        [[0, 0, 0], [10.0, 0, 0], [10, 2, 0], [50, 0, 0]], np.array([[0, 1], [1, 2]]), np.zeros(4, int)
    )
    hops, mm = BatchSomParams(lengths="hops").lengths_mm(line), BatchSomParams().lengths_mm(line)
    assert mm[0].tolist() == [0, 10, 12, np.inf]
    assert hops[0].tolist() == [0, 6, 12, np.inf]  # each hop the mean of 10 and 2
    assert np.array_equal(hops[:3, :3], 6.0 * hops_literal(4, line.edges, directed=False)[:3, :3])


def test_it_rests_and_says_how_far_its_last_step_was(start):
    graph, cloud = start
    rested, cut = fit_batch_som(graph, cloud, BatchSomParams()), fit_batch_som(graph, cloud, BatchSomParams(max_rest=0))
    assert rested.moved_mm < 0.05 <= cut.moved_mm
    assert len(cut.history) == 20 < len(rested.history) <= 50
    assert rested.history[-1] < 0.8 * rested.history[0]


def test_a_node_without_points_stays_or_follows_the_others(start):
    graph, cloud = start
    moved = np.array([0.0, 4.0, 0.0])
    kept = cloud.parts != Part.LEFT_3
    torn = PointCloud(cloud.points[kept] + moved, "us", cloud.parts[kept])
    fitted = graph.with_nodes(fit_batch_som(graph, cloud, BatchSomParams()).nodes)
    far = (graph.parts == Part.LEFT_3) & (fitted.geodesics_mm()[graph.parts != Part.LEFT_3].min(axis=0) > 12.0)
    assert far.sum() > 3
    params = BatchSomParams(start_radius_mm=3.0)  # reaches no further than 9 mm
    alone = fit_batch_som(fitted, torn, params).nodes - fitted.nodes
    smooth = fit_batch_som(fitted, torn, params, NodeSpline().smoother(fitted.nodes)).nodes - fitted.nodes
    assert np.abs(alone[far]).max() == 0
    assert np.linalg.norm(smooth[far] - moved, axis=1).max() < 2.0


def test_a_cloud_without_labels_is_refused(start):
    graph, cloud = start
    with pytest.raises(StudyError, match="expected labelled parts for winners 'own_part', got none"):
        fit_batch_som(graph, PointCloud(cloud.points), SHORT)
    assert len(fit_batch_som(graph, PointCloud(cloud.points), replace(SHORT, winners="any")).history) == 3


@pytest.mark.parametrize(
    "bad",
    [
        {"epochs": 1},
        {"max_rest": -1},
        {"at_rest_mm": np.nan},
        {"end_radius_mm": 0.0},
        {"start_radius_mm": 1.0},
        {"winners": "all"},
        {"lengths": "euclidean"},
    ],
)
def test_bad_parameters_are_refused(bad):
    with pytest.raises(StudyError, match="batch map: expected"):
        BatchSomParams(**bad)
