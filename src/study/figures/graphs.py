"""Pictures of the skeleton graph: the template, its maps on the clouds, how well they cover them (sec. III-B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from study.figures.canvas import bounds, dots, look, new_figure, part_legend, plain, project, require
from study.figures.style import CT_COLOUR, DARK, LEVEL_COLOUR, PALE, US_COLOUR, part_colours
from study.skeleton.graph import SkeletonGraph
from study.types import Bools, Floats, Ints, RigidTransform

__all__ = ["graph_triptych", "one_way", "skeleton_graph", "som_progress"]


def skeleton_graph(
    graph: SkeletonGraph,
    points: ArrayLike | None = None,
    *,
    T_cloud_chest: RigidTransform | None = None,
    numbers: bool = False,
    title: str = "Skeleton graph",
) -> Figure:
    """A graph over its cloud from the front; edges that run one way only are arrows.

    Args:
        graph: nodes in any frame.
        points: (n, 3) mm in that frame, or None.
        T_cloud_chest: chest coordinates to that frame; None for RAS+.
        numbers: write each node's number on it.
        title: above it.
    """
    figure = new_figure(7.4, title)
    _draw_graph(figure.subplots(), graph, points, T_cloud_chest, _counted(graph), numbers=numbers)
    part_legend(figure)
    return figure


def graph_triptych(
    template: SkeletonGraph,
    g_ct: SkeletonGraph,
    g_us: SkeletonGraph,
    ct_points: ArrayLike,
    us_points: ArrayLike,
    *,
    T_cloud_chest: RigidTransform | None = None,
) -> Figure:
    """The paper's Fig. 3: the numbered template, then the graph on the CT and on the US cloud, all in one frame.

    The template is directed; the fitted graphs are undirected by then, and have no arrows.

    Args:
        template: placed on the CT cloud.
        g_ct, g_us: fitted to each cloud.
        ct_points, us_points: (n, 3) and (m, 3) mm.
        T_cloud_chest: chest coordinates to the frame of all; None for RAS+.
    """
    figure = new_figure(10.6, "Skeleton graph: the template, then the two maps")
    grid = figure.add_gridspec(2, 2, height_ratios=[1.45, 1])
    top, left, right = (figure.add_subplot(grid[place]) for place in ((0, slice(None)), (1, 0), (1, 1)))
    _draw_graph(top, template, None, T_cloud_chest, f"template: {_counted(template)}", numbers=True)
    titles = ("graph of the CT cloud, from the template", "graph of the US cloud, from the CT graph")
    for ax, graph, points, title in zip((left, right), (g_ct, g_us), (ct_points, us_points), titles, strict=True):
        _draw_graph(ax, graph, points, T_cloud_chest, title, directed=False)
    part_legend(figure)
    return figure


def som_progress(histories: Mapping[str, Sequence[float]]) -> Figure:
    """Quantisation error (mean distance from points to their nearest node, mm) over each map's schedule.

    Args:
        histories: by the map's name, errors at even steps.

    Raises:
        StudyError: no map, or one without errors.
    """
    require(histories, "histories")
    figure = new_figure(3.4, "How well each map covers its cloud")
    ax = figure.subplots()
    colours = (CT_COLOUR, US_COLOUR, DARK, *LEVEL_COLOUR.values())
    for k, (name, history) in enumerate(histories.items()):
        require(history, f"history of {name}")
        share = np.linspace(0, 100, len(history))
        style: dict[str, Any] = {
            "marker": "o" if len(history) <= 40 else "",
            "ms": 3,
            "color": colours[k % len(colours)],
        }
        ax.plot(share, history, label=f"{name}: ends at {history[-1]:.2f} mm", **style)
    ax.set(xlabel="part of the schedule (%)", ylabel="points to nearest node (mm)", ylim=(0, None))
    plain(ax)
    ax.grid(alpha=0.25)
    ax.legend(fontsize=8, frameon=False)
    return figure


def one_way(edges: Ints) -> Bools:
    """(e,) which of the directed edges (e, 2) have no counterpart."""
    there = {(int(a), int(b)) for a, b in edges}
    return np.array([(int(b), int(a)) not in there for a, b in edges], dtype=bool)


def _counted(graph: SkeletonGraph) -> str:
    single = int(one_way(graph.edges).sum())
    return f"{len(graph)} nodes, {len(graph.edges)} directed edges, {single} of them one-way (arrows)"


def _draw_graph(
    ax: Axes,
    graph: SkeletonGraph,
    points: ArrayLike | None,
    T_cloud_chest: RigidTransform | None,
    title: str,
    *,
    numbers: bool = False,
    directed: bool = True,
) -> None:
    """A graph from the front, over its cloud; ``directed`` draws what runs one way only as arrows."""
    nodes = project(graph.nodes, "front", T_cloud_chest)
    extent = bounds(nodes, margin_mm=12.0)
    if points is not None:
        cloud = project(points, "front", T_cloud_chest)
        extent = bounds(nodes, cloud)
        dots(ax, cloud, PALE, size=3)
    _draw_edges(ax, nodes[:, :2], graph.edges, one_way(graph.edges) & directed, clear_mm=1.35 if numbers else 0.0)
    _draw_nodes(ax, nodes[:, :2], part_colours(graph.parts, len(nodes)), numbers)
    look(ax, "front", extent, title)


def _draw_edges(ax: Axes, flat: Floats, edges: Ints, arrows: Bools, clear_mm: float) -> None:
    """Edges between nodes at ``flat`` (m, 2) mm; arrows end ``clear_mm`` off both nodes, which numbers make large."""
    lines = LineCollection(list(flat[edges[~arrows]]), colors="#777777", linewidths=0.7, zorder=2)
    ax.add_collection(lines)
    if not arrows.any():
        return
    tail, head = flat[edges[arrows, 0]], flat[edges[arrows, 1]]
    if clear_mm:
        gap = clear_mm * (head - tail) / np.maximum(np.linalg.norm(head - tail, axis=1, keepdims=True), 1e-9)
        tail, head = tail + gap, head - gap
    arrow: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "units": "xy", "width": 0.32}
    arrow |= {"headwidth": 4.5, "headlength": 4.5, "headaxislength": 4.2, "color": "black", "zorder": 4}
    ax.quiver(tail[:, 0], tail[:, 1], *(head - tail).T, **arrow)


def _draw_nodes(ax: Axes, flat: Floats, colours: Floats, numbers: bool) -> None:
    """Nodes in the colour of their part; those with numbers are large and pale, so that the number can be read."""
    x, y = flat.T
    if not numbers:
        ax.scatter(x, y, s=13, c=colours, ec="white", lw=0.3, zorder=5)
        return
    ax.scatter(x, y, s=150, c=1 - 0.45 * (1 - colours), ec=colours, lw=1.3, zorder=3)
    for number, place in enumerate(flat):
        ax.text(place[0], place[1], str(number), fontsize=6, ha="center", va="center_baseline", zorder=6)
