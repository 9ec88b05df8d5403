"""Eqs. 3 and 4 against literal loops and planted motions."""

import numpy as np
import pytest
from oracles_som import blend_literal, local_transforms_literal

from study.errors import StudyError
from study.skeleton.graph import SkeletonGraph
from study.skeleton.template import template_graph
from study.skeleton.warp import blend, local_transforms
from study.types import Part, RigidTransform


@pytest.fixture(scope="module")
def pair(chest):
    """A bent, jittered template (no four nodes in a plane, no ties), its deformed partner and the hops."""
    rng = np.random.default_rng(0)
    template = template_graph(chest)
    x, y, z = template.nodes.T
    ct = np.column_stack([x, y - x**2 / 300, z]) + rng.normal(scale=2.0, size=(len(template), 3))
    us = RigidTransform.random(rng).apply(ct * [1.1, 1.0, 0.95]) + rng.normal(scale=1.0, size=ct.shape)
    return ct, us, template.hops(directed=False)


@pytest.mark.parametrize(("neighbours", "n_reg"), [("nodes", 3), ("nodes", 9), ("hops", 3)])
def test_local_transforms_are_eq_3_as_written(pair, neighbours, n_reg):
    ct, us, hops = pair
    rotations, translations = local_transforms(ct, us, hops, n_reg, neighbours)
    literal = local_transforms_literal(ct, us, hops, n_reg, neighbours)
    # 1e-6 mm: a rotation from three nodes nearly in a row is ill-conditioned, and two roads to it round differently.
    for i, (rotation, translation) in enumerate(literal):
        assert rotations[i] @ ct[i] + translations[i] == pytest.approx(rotation @ ct[i] + translation, abs=1e-6)
        assert rotations[i] == pytest.approx(rotation, abs=1e-6)
    assert np.linalg.det(rotations) == pytest.approx(np.ones(len(ct)))


def test_three_hops_hold_the_authors_9_to_25_nodes(pair):
    _, _, hops = pair
    members = (hops <= 3).sum(axis=1)
    assert (members.min(), members.max()) == (9, 25)
    assert np.median(members) == 16


@pytest.mark.parametrize("weights", ["distance", "inverse_distance"])
@pytest.mark.parametrize("k", [1, 3, 5])
def test_the_blend_is_eq_4_as_written(pair, weights, k):
    ct, us, hops = pair
    points = np.random.default_rng(1).uniform(ct.min(axis=0), ct.max(axis=0), (60, 3))
    motions = local_transforms(ct, us, hops, 9)
    fast = blend(points, ct, *motions, k, weights)
    literal = blend_literal(points, ct, list(zip(*motions, strict=True)), k, weights)
    assert np.abs(fast - literal).max() < 1e-9


@pytest.mark.parametrize("neighbours", ["nodes", "hops"])
@pytest.mark.parametrize("weights", ["distance", "inverse_distance"])
def test_a_rigid_motion_of_the_graph_moves_every_point_by_it(pair, neighbours, weights):
    ct, _, hops = pair
    motion = RigidTransform.random(np.random.default_rng(2))
    points = np.random.default_rng(3).uniform(ct.min(axis=0), ct.max(axis=0), (300, 3))
    moved = blend(points, ct, *local_transforms(ct, motion.apply(ct), hops, 3, neighbours), 3, weights)
    assert moved == pytest.approx(motion.apply(points), abs=1e-7)


def test_a_mirrored_graph_gives_proper_rotations(pair):
    ct, _, hops = pair
    for neighbours in ("nodes", "hops"):
        rotations, _ = local_transforms(ct, ct * [-1, 1, 1], hops, 3, neighbours)
        assert np.linalg.det(rotations) == pytest.approx(np.ones(len(ct)))


def test_eq_4_as_printed_lets_the_farthest_count_most():
    nodes = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
    rotations = np.tile(np.eye(3), (4, 1, 1))
    shifts = np.array([[0.0, 0, 0], [0, 0, 3], [0, 0, 3], [0, 0, 3]])
    on_a_node = nodes[:1]
    printed = blend(on_a_node, nodes, rotations, shifts, 3, "distance")
    sane = blend(on_a_node, nodes, rotations, shifts, 3, "inverse_distance")
    assert printed[0] == pytest.approx([0, 0, 3], abs=1e-6)  # a point on a node ignores it
    assert sane[0] == pytest.approx([0, 0, 0], abs=1e-6)


def test_ties_in_hops_are_broken_by_distance():
    nodes = np.array([[0.0, 0, 0], [9, 0, 0], [0, 5, 0], [0, 0, 7], [-8, 1, 1]])
    edges = np.array([(0, i) for i in range(1, 5)])
    hops = SkeletonGraph(nodes, edges, np.full(5, int(Part.STERNUM))).hops(directed=False)
    target = nodes.copy()
    target[[1, 4]] += 50.0  # the two far ones are wild; the node itself and its two nearest stay
    rotations, translations = local_transforms(nodes, target, hops, 3)
    assert rotations[0] == pytest.approx(np.eye(3), abs=1e-9)
    assert translations[0] == pytest.approx(np.zeros(3), abs=1e-9)


def test_what_does_not_pair_is_refused(pair):
    ct, us, hops = pair
    with pytest.raises(StudyError, match="expected paired nodes and"):
        local_transforms(ct[:-1], us, hops)
    with pytest.raises(StudyError, match="expected 3 <= n_reg <= 246 nodes for a rigid fit, got 2"):
        local_transforms(ct, us, hops, 2)
    with pytest.raises(StudyError, match=r"expected neighbours nodes\|hops, got 'rings'"):
        local_transforms(ct, us, hops, 3, "rings")
    motions = local_transforms(ct, us, hops)
    with pytest.raises(StudyError, match=r"expected weights distance\|inverse_distance, got 'even'"):
        blend(ct, ct, *motions, 3, "even")
    with pytest.raises(StudyError, match="expected 1 <= k <= 246 nodes, got 0"):
        blend(ct, ct, *motions, 0)
