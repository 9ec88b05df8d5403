"""Eq. 2 against its literal loop, schedules against the published and the authors' numbers."""

from dataclasses import replace

import numpy as np
import pytest
from oracles_som import som_literal

from study.alignment.frame import chest_frame
from study.errors import StudyError
from study.skeleton.graph import SkeletonGraph
from study.skeleton.som import SomParams, fit_som, neighbourhood, quantisation_error_mm
from study.skeleton.template import template_graph
from study.types import Part, PointCloud

SHORT = SomParams(epochs=4, samples=25, radius=5.0)


@pytest.fixture(scope="module")
def start(ct_clouds):
    return template_graph(chest_frame(ct_clouds["ct1"])), ct_clouds["ct1"]


@pytest.mark.parametrize("params", [SHORT, replace(SHORT, radius_schedule="compounding", rate_schedule="compounding")])
def test_the_fast_map_is_eq_2_as_written(start, params):
    graph, cloud = start
    fast, _ = fit_som(graph, cloud, params, np.random.default_rng(7))
    literal = som_literal(graph, cloud.points, params, np.random.default_rng(7))
    assert np.abs(literal - graph.nodes).max() > 1.0  # it went somewhere
    # Sums in another order: 1e-9 is a thousand roundings of coordinates of 100 mm.
    assert np.abs(fast.nodes - literal).max() < 1e-9
    assert np.array_equal(fast.edges, graph.edges)
    assert np.array_equal(fast.parts, graph.parts)


def test_the_defaults_are_the_papers():
    params = SomParams()
    assert (params.rate, params.rate_schedule) == (0.1, "constant")
    assert (params.pretrain_epochs, params.pretrain_rate) == (3, 0.02)
    assert params.winners == "any"
    assert (params.radius, params.radius_schedule) == (5, "linear")  # theirs and ours; the paper has neither


def test_the_authors_rate_compounds():
    params = SomParams(epochs=5000, rate_schedule="compounding")
    assert params.rate_at(0) == 0.1
    assert params.rate_at(1) == pytest.approx(0.1 * (1 - 1 / 5000))
    assert params.rate_at(200) == pytest.approx(1.7e-3, rel=0.03)
    assert params.rate_at(213) < 0.1 / 100 <= params.rate_at(212)
    assert params.rate_at(500) == pytest.approx(5e-13, rel=0.2)
    rate = 0.1
    for epoch in range(300):  # their loop
        rate = rate * (1 - epoch / 5000)
        assert params.rate_at(epoch) == pytest.approx(rate, rel=1e-9)


def test_rates_and_radii_are_functions_of_the_epoch():
    for kind in ("constant", "linear", "compounding"):
        params = SomParams(epochs=50, rate_schedule=kind)
        backwards = [params.rate_at(epoch) for epoch in reversed(range(50))]
        assert backwards[::-1] == [params.rate_at(epoch) for epoch in range(50)]
        assert params.rate_at(-1) == params.rate_at(-3) == params.pretrain_rate
    assert [SomParams(epochs=10).rate_at(epoch) for epoch in (0, 9)] == [0.1, 0.1]
    for kind in ("linear", "compounding"):
        params = SomParams(epochs=50, radius_schedule=kind)
        backwards = [params.radius_at(epoch) for epoch in reversed(range(-3, 50))]
        assert backwards[::-1] == [params.radius_at(epoch) for epoch in range(-3, 50)]
    linear = SomParams(epochs=10, rate_schedule="linear")
    assert [linear.rate_at(epoch) for epoch in (0, 5, 9)] == pytest.approx([0.1, 0.05, 0.01])


def test_our_radius_takes_the_whole_schedule_to_fall():
    params = SomParams(epochs=5000, radius=5.0)
    radii = [params.radius_at(epoch) for epoch in range(5000)]
    assert [params.radius_at(epoch) for epoch in (-3, -2, -1)] == [5.0] * 3
    assert radii == sorted(radii, reverse=True)
    # It is over 5 hops at epoch 0 only, since the rule cuts fractions off.
    assert [radii.index(hops) for hops in (5.0, 4.0, 3.0, 2.0, 1.0)] == [0, 1, 1251, 2501, 3751]


@pytest.mark.parametrize(
    ("pretrain_epochs", "epochs", "first"),
    [(3, 5000, [5, 4, 3, 3, 2, 1, 1]), (0, 3000, [5, 4, 3, 2, 1, 1])],  # their CT map, their US map
)
def test_the_authors_radius_is_at_1_hop_within_a_few_epochs(pretrain_epochs, epochs, first):
    params = SomParams(epochs=epochs, pretrain_epochs=pretrain_epochs, radius_schedule="compounding")
    radii = [params.radius_at(epoch) for epoch in range(-pretrain_epochs, epochs)]
    assert radii[: len(first)] == first
    assert set(radii[len(first) :]) == {1.0}


@pytest.mark.parametrize(("pretrain_epochs", "epochs"), [(3, 5000), (0, 3000), (3, 10), (3, 4), (5, 2), (1, 1)])
def test_the_authors_radius_is_their_loop(pretrain_epochs, epochs):
    radius, radii = 5, []
    for e in (*range(pretrain_epochs), *range(epochs)):
        radius = min(radius, int((radius - 1) * (1 - e / epochs)) + 1)
        radii.append(radius)
    params = SomParams(epochs=epochs, pretrain_epochs=pretrain_epochs, radius_schedule="compounding")
    assert [params.radius_at(epoch) for epoch in range(-pretrain_epochs, epochs)] == radii


def test_the_neighbourhood_is_a_gaussian_of_hops_that_ends_at_the_radius():
    hops = np.array([[0, 1, 3], [1, 0, 2], [3, 3, 0]])
    theta = neighbourhood(hops, 2.0)
    assert theta[0, 1] == pytest.approx(np.exp(-1 / 8))
    assert theta[1, 2] == pytest.approx(np.exp(-4 / 8))
    assert theta[2].tolist() == [0, 0, 1]  # no path leads there
    assert theta[0].tolist() == [1, pytest.approx(np.exp(-1 / 8)), 0]  # 3 hops are beyond 2


def column_of_three(one_way: bool) -> SkeletonGraph:
    """Three nodes above each other, links from the lower to the upper, and back unless one-way."""
    edges = [(1, 0), (2, 1)] + ([] if one_way else [(0, 1), (1, 2)])
    nodes = np.array([[0, 0, 40.0], [0, 0, 0], [0, 0, -40.0]])
    return SkeletonGraph(nodes, np.array(edges), np.full(3, int(Part.LEFT_4)))


@pytest.mark.parametrize("one_way", [True, False])
def test_in_pretraining_the_lower_row_drags_the_upper_never_the_reverse(one_way):
    graph = column_of_three(one_way)
    params = SomParams(epochs=1, samples=20, rate=1e-12, pretrain_rate=0.02)

    def pulled_by(height: float) -> np.ndarray:
        cloud = PointCloud(np.array([30.0, 0, height]) + np.random.default_rng(0).normal(scale=5, size=(60, 3)))
        return np.linalg.norm(fit_som(graph, cloud, params, np.random.default_rng(1))[0].nodes - graph.nodes, axis=1)

    by_upper, by_lower = pulled_by(40.0), pulled_by(-40.0)
    assert by_upper[0] > 5
    assert by_lower[2] > 5
    assert (by_lower[:2] > 1).all()
    if one_way:
        assert by_upper[1:] == pytest.approx([0, 0], abs=1e-8)
    else:
        assert (by_upper[1:] > 1).all()


def test_after_pretraining_links_run_both_ways():
    graph = column_of_three(True)
    cloud = PointCloud(np.array([30.0, 0, 40]) + np.random.default_rng(0).normal(scale=5, size=(60, 3)))
    params = SomParams(epochs=1, samples=20, pretrain_epochs=0)
    moved = fit_som(graph, cloud, params, np.random.default_rng(1))[0].nodes - graph.nodes
    assert (np.linalg.norm(moved, axis=1) > 1).all()


def test_the_map_closes_on_the_cloud_and_tells_how(start):
    graph, cloud = start
    fitted, history = fit_som(graph, cloud, SomParams(epochs=100), np.random.default_rng(0))
    before, after = (quantisation_error_mm(g.nodes, cloud.points) for g in (graph, fitted))
    assert history[-1] == after
    assert after < 0.8 * before
    assert np.isfinite(history).all()
    distances = np.linalg.norm(cloud.points[:, None] - fitted.nodes[None], axis=2).min(axis=1)
    assert after == pytest.approx(distances.mean())


def test_the_same_seed_gives_the_same_bytes_and_nothing_is_written_to(start):
    graph, cloud = start
    before = graph.nodes.tobytes(), cloud.points.tobytes()
    runs = [fit_som(graph, cloud, SHORT, np.random.default_rng(seed))[0].nodes.tobytes() for seed in (3, 3, 4)]
    assert runs[0] == runs[1] != runs[2]
    assert (graph.nodes.tobytes(), cloud.points.tobytes()) == before
    assert not graph.nodes.flags.writeable


def test_own_part_winners_never_leave_their_part(start):
    graph, cloud = start
    shifted = cloud.only(Part.STERNUM) + np.array([400.0, 0, 0])
    only_sternum = PointCloud(shifted, parts=np.zeros(len(shifted), dtype=np.int64))
    params = replace(SHORT, winners="own_part", radius=1.0)
    moved = fit_som(graph, only_sternum, params, np.random.default_rng(0))[0].nodes - graph.nodes
    # All points lie beyond the right branches, whose nodes would win; of its own part the sternum's edge does.
    winner = np.linalg.norm(moved, axis=1).argmax()
    assert graph.parts[winner] == Part.STERNUM
    free = fit_som(graph, only_sternum, replace(params, winners="any"), np.random.default_rng(0))[0].nodes - graph.nodes
    assert graph.parts[np.linalg.norm(free, axis=1).argmax()] != Part.STERNUM
    with pytest.raises(StudyError, match="expected labelled parts for winners 'own_part', got none"):
        fit_som(graph, PointCloud(cloud.points), params, np.random.default_rng(0))


@pytest.mark.parametrize(
    "bad",
    [
        {"epochs": 0},
        {"samples": 0},
        {"pretrain_epochs": -1},
        {"rate": 0.0},
        {"rate": 1.5},
        {"pretrain_rate": -0.1},
        {"radius": 0.5},
        {"rate_schedule": "falling"},
        {"radius_schedule": "constant"},
        {"winners": "best"},
        {"rate": float("nan")},
    ],
)
def test_parameters_that_make_no_map_are_refused(bad):
    with pytest.raises(StudyError, match=r"expected .*, got "):
        SomParams(**bad)
