"""The graph counts its hops as a breadth-first search does, and keeps its topology."""

import numpy as np
import pytest
from oracles_som import hops_literal

from study.errors import StudyError
from study.skeleton.graph import SkeletonGraph


def test_hops_are_those_of_a_breadth_first_search():
    rng = np.random.default_rng(5)
    edges = rng.integers(30, size=(45, 2))
    graph = SkeletonGraph(rng.normal(size=(30, 3)), edges, np.zeros(30, dtype=np.int64))
    for directed in (True, False):
        hops = graph.hops(directed=directed)
        assert np.array_equal(hops, hops_literal(30, edges, directed=directed))
        assert (hops == 30).any()  # unreachable pairs are there and say so
    assert np.array_equal(graph.hops(directed=False), graph.hops(directed=False).T)


def test_geodesics_run_along_the_links_either_way():
    nodes = np.array([[0, 0, 0], [3.0, 4, 0], [3, 0, 0], [90, 0, 0]])
    graph = SkeletonGraph(nodes, np.array([[0, 1], [1, 0], [1, 2]]), np.zeros(4, dtype=np.int64))
    assert graph.edge_lengths_mm().tolist() == [5, 5, 4]
    lengths = graph.geodesics_mm()
    assert lengths[0].tolist() == [0, 5, 9, np.inf]  # not the 3 mm through the air
    assert np.array_equal(lengths, lengths.T)


def test_other_nodes_keep_the_links_and_are_checked():
    graph = SkeletonGraph(np.eye(3), np.array([[0, 1], [1, 2]]), np.zeros(3, dtype=np.int64))
    moved = graph.with_nodes(np.eye(3) + 1)
    assert np.array_equal(moved.edges, graph.edges)
    assert np.array_equal(moved.nodes, np.eye(3) + 1)
    assert np.array_equal(graph.nodes, np.eye(3))
    with pytest.raises(StudyError, match="graph nodes"):
        graph.with_nodes(np.full((3, 3), np.nan))
