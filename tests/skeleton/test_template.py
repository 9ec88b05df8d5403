"""The template is the authors' grid: counted, placed and linked as sec. III-B says."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from study.skeleton.template import template_graph
from study.types import CARTILAGES, Part


def rows_of(graph, part):
    """Nodes of a part as rows (top first) of indices, medial first."""
    index = np.flatnonzero(graph.parts == part)
    heights = np.round(graph.nodes[index, 2], 6)
    return [
        sorted(index[heights == height], key=lambda i: abs(graph.nodes[i, 0] - 1.0))
        for height in sorted(set(heights), reverse=True)
    ]


def test_it_has_246_nodes_in_the_authors_rows_and_columns(chest):
    graph = template_graph(chest)
    assert len(graph) == 246
    counts = Counter(int(part) for part in graph.parts)
    assert counts.pop(Part.STERNUM) == 18 * 5
    assert len(counts) == 8
    for part in CARTILAGES:
        assert counts[part] == 3 * {2: 5, 3: 6, 4: 7, 5: 8}[part.level]
        assert [len(row) for row in rows_of(graph, part)] == [counts[part] // 3] * 3
    assert [len(row) for row in rows_of(graph, Part.STERNUM)] == [5] * 18


def test_it_has_774_directed_edges_of_which_60_run_one_way(chest):
    graph = template_graph(chest)
    edges = {(int(a), int(b)) for a, b in graph.edges}
    assert len(edges) == len(graph.edges) == 774
    assert all(a != b for a, b in edges)
    one_way = [(a, b) for a, b in edges if (b, a) not in edges]
    assert len(one_way) == 60
    for lower, upper in one_way:
        assert graph.parts[lower] == graph.parts[upper]
        assert Part(graph.parts[lower]).level in (4, 5)
        assert graph.nodes[upper, 2] > graph.nodes[lower, 2]
        assert graph.nodes[upper, 0] == pytest.approx(graph.nodes[lower, 0])
    # Every vertical link of levels 4 and 5 is among them: 2 gaps × (7 + 8) columns × 2 sides.
    assert len(one_way) == 2 * (7 + 8) * 2


def test_branches_leave_the_sternum_from_its_edge_with_gaps_of_3_2_1_rows(chest):
    graph = template_graph(chest)
    sternum = rows_of(graph, Part.STERNUM)
    row_of = {int(node): r for r, row in enumerate(sternum) for node in row}
    attached = {}
    for part in CARTILAGES:
        links = [(int(a), int(b)) for a, b in graph.edges if graph.parts[a] == Part.STERNUM and graph.parts[b] == part]
        attached[part] = sorted(row_of[a] for a, _ in links)
        for a, b in links:
            assert [b, a] in graph.edges.tolist()
            side = -1 if part.side == "left" else 1  # x points to the patient's right
            edge = max(side * graph.nodes[node, 0] for node in row_of)
            assert side * graph.nodes[a, 0] == pytest.approx(edge)
    for side in (CARTILAGES[:4], CARTILAGES[4:]):
        rows = [attached[part] for part in side]
        assert all(len(three) == 3 and three == list(range(three[0], three[0] + 3)) for three in rows)
        assert rows[0][0] == 0
        assert rows[-1][-1] == 17
        assert [lower[0] - upper[-1] - 1 for upper, lower in pairwise(rows)] == [3, 2, 1]
    assert np.array_equal(np.array(list(attached.values()))[:4], np.array(list(attached.values()))[4:])


def test_it_is_flat_and_drawn_to_the_measures_of_the_chest(chest):
    graph = template_graph(chest)
    assert np.abs((graph.nodes - chest.origin) @ chest.front).max() == pytest.approx(0)
    across = (graph.nodes - chest.origin) @ chest.left
    sternum = graph.parts == Part.STERNUM
    assert np.abs(across[sternum]).max() == pytest.approx(chest.width_mm / 2 * 4 / 5)  # cell centres of five columns
    for part in CARTILAGES:
        mine = graph.parts == part
        assert (np.sign(across[mine]) == (1 if part.side == "left" else -1)).all()
        lateral = np.abs(across[mine])
        assert lateral.min() > chest.width_mm / 2
        assert lateral.max() < chest.width_mm / 2 + chest.reach_mm[part]
        assert lateral.max() > chest.width_mm / 2 + 0.85 * chest.reach_mm[part]
        middle = (graph.nodes[mine] - chest.origin) @ chest.up
        assert np.median(middle) == pytest.approx(chest.root_mm[part])


def test_everything_hangs_together(chest):
    graph = template_graph(chest)
    assert graph.hops(directed=False).max() < len(graph)
    assert graph.hops(directed=True).max() < len(graph)
    assert (np.linalg.norm(graph.nodes[graph.edges[:, 0]] - graph.nodes[graph.edges[:, 1]], axis=1) > 1.0).all()


def test_upper_rows_reach_lower_ones_only_by_way_of_the_sternum(chest):
    graph = template_graph(chest)
    directed, undirected = graph.hops(directed=True), graph.hops(directed=False)
    for part in (Part.LEFT_4, Part.RIGHT_5):
        for upper_row, lower_row in pairwise(rows_of(graph, part)):
            for column, (upper, lower) in enumerate(zip(upper_row, lower_row, strict=True)):
                assert directed[lower, upper] == 1
                assert directed[upper, lower] == 2 * (column + 1) + 1  # in, one row down, out
                assert undirected[upper, lower] == 1
