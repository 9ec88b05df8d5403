"""Graphs show every node and edge, and which edges run one way only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from figure_data import GRAPH, POINTS, texts
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from study import figures

EXAMPLES: dict[str, Callable[[], Figure]] = {
    "skeleton_graph": lambda: figures.skeleton_graph(GRAPH, POINTS),
    "graph_triptych": lambda: figures.graph_triptych(GRAPH, GRAPH, GRAPH, POINTS, POINTS),
    "som_progress": lambda: figures.som_progress({"CT": (5.0, 3.0, 2.5), "US": (4.0, 2.0)}),
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "no histories": lambda: figures.som_progress({}),
    "empty history": lambda: figures.som_progress({"CT": ()}),
}


def test_one_way_edges_are_arrows_in_their_direction() -> None:
    np.testing.assert_array_equal(figures.one_way(GRAPH.edges), [False, False, True, True])
    figure = figures.skeleton_graph(GRAPH)
    (arrows,) = figure.axes[0].findobj(Quiver)
    nodes = GRAPH.nodes[:, [0, 2]] * [-1, 1]
    np.testing.assert_allclose(arrows.get_offsets(), nodes[[1, 3]])
    np.testing.assert_allclose(np.column_stack([arrows.U, arrows.V]), nodes[[2, 2]] - nodes[[1, 3]])
    assert "2 of them one-way" in texts(figure)


def test_fitted_graphs_have_no_arrows() -> None:
    top, *fitted = EXAMPLES["graph_triptych"]().axes
    assert len(top.findobj(Quiver)) == 1
    assert [len(ax.findobj(Quiver)) for ax in fitted] == [0, 0]
    assert [len(ax.findobj(LineCollection)[0].get_segments()) for ax in fitted] == [len(GRAPH.edges)] * 2


def test_triptych_numbers_every_node_of_the_template() -> None:
    figure = EXAMPLES["graph_triptych"]()
    numbers = {text.get_text() for text in figure.axes[0].texts}
    assert {str(k) for k in range(len(GRAPH))} <= numbers
