"""Pictures of the method: coarse alignment, skeleton graph, registration, the transferred path (sec. III, IV)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import ArrayLike

from study.errors import StudyError
from study.figures.style import (
    CT_COLOUR,
    DARK,
    GREY,
    LEVEL_COLOUR,
    PALE,
    SIMULATED,
    US_COLOUR,
    WIDTH_IN,
    View,
    below,
    bounds,
    dots,
    in_order,
    lighter,
    look,
    method_style,
    name_parts,
    new_figure,
    part_colours,
    part_legend,
    plain,
    project,
    require,
    steps,
    thin,
)
from study.geometry import nearest
from study.types import (
    Bools,
    Floats,
    Ints,
    RigidTransform,
    SkeletonGraph,
    Waypoints,
    as_points,
)


@dataclass(frozen=True)
class CoarseView:
    """What the coarse alignment saw of one cloud (sec. III-A).

    Attributes:
        plane: (n, 2) mm, the cloud in its feature plane.
        rectangles: scale (mm a pixel), centre (2,) in the plane and angle (degrees, counter-clockwise from y) of the
            sternum rectangle found at each scale.
        local: (n, 2) mm, the cloud in sternum coordinates.
        edges_mm: distance of the sternum's edges from its axis, at x < 0 and at x > 0.
        seeds: (k, 2) mm in sternum coordinates.
        chest: (n, 2) mm, the cloud in chest coordinates, x to the patient's left and y up.
        parts: (n,) of `Part`.
        size_mm: width and height of the rectangle.
    """

    plane: Floats
    rectangles: Sequence[tuple[float, Floats, float]]
    local: Floats
    edges_mm: tuple[float, float]
    seeds: Floats
    chest: Floats
    parts: Ints
    size_mm: tuple[float, float] = (30.0, 90.0)


_EDGE_COLOUR, _SEED_COLOUR, _ERROR_COLOUR = "#882255", "#F0E442", "#DC0050"
_SCALE_STYLE = (("#555555", 3.5), ("#56B4E9", 2.2), ("#D55E00", 1.6))


def coarse_steps(views: Mapping[str, CoarseView]) -> Figure:
    """The paper's Fig. 2: the sternum at three scales, its edges and the seeds, the labelled branches; a row a cloud.

    Raises:
        StudyError: no view, or one without points.
    """
    require(views, "views")
    figure = new_figure(0.9 + 3.1 * len(views), "Coarse alignment: sternum, branches, labels")
    scales: dict[float, Polygon] = {}
    for row, (name, view) in zip(figure.subplots(len(views), 3, squeeze=False), views.items(), strict=True):
        require(view.plane, f"points of {name}")
        flat = [np.column_stack([points, np.zeros(len(points))]) for points in (view.plane, view.local, view.chest)]
        titles = (f"{name}: feature plane, rectangle at each scale", "edges of the sternum, seeds", "labelled branches")
        for ax, points, title in zip(row, flat, titles, strict=True):
            coloured = ax is row[2]
            dots(ax, points, part_colours(view.parts, len(points)) if coloured else "#9db2c4", size=3)
            look(ax, "front" if coloured else "side", bounds(points, margin_mm=16.0 if coloured else 8.0), title)
        row[0].set_xlabel("x in the plane (mm)", fontsize=8)
        row[0].set_ylabel("y in the plane (mm)", fontsize=8)
        row[1].set_xlabel("across the sternum (mm)", fontsize=8)
        row[1].set_ylabel("along the sternum (mm)", fontsize=8)
        half = np.array(view.size_mm) / 2 * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
        for (scale, centre, angle), style in zip(view.rectangles, _SCALE_STYLE, strict=False):
            c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            corners = half @ np.array([[c, s], [-s, c]]) + centre
            colour, width = style
            scales[scale] = row[0].add_patch(
                Polygon(corners, fill=False, ec=colour, lw=width, label=f"sternum at {scale:g} mm a pixel")
            )
        row[1].axvline(0, color=DARK, lw=0.8, ls=":")
        for x in (-view.edges_mm[0], view.edges_mm[1]):
            row[1].axvline(x, color=_EDGE_COLOUR, lw=1.6)
        row[1].scatter(*np.asarray(view.seeds).T, s=70, marker="*", c=_SEED_COLOUR, ec="black", lw=0.7, zorder=5)
        name_parts(row[2], flat[2], view.parts)
    edge = Line2D([], [], color=_EDGE_COLOUR, lw=1.6, label="edge of the sternum")
    seed = Line2D([], [], ls="", marker="*", ms=9, color=_SEED_COLOUR, mec="black", mew=0.7, label="seed of a branch")
    part_legend(figure, [*(scales[scale] for scale in sorted(scales, reverse=True)), edge, seed])
    return figure


def coarse_overlay(
    ct: ArrayLike, us: ArrayLike, ct_aligned: ArrayLike, *, T_us_chest: RigidTransform | None = None
) -> Figure:
    """Both clouds before and after the coarse alignment (the paper's Fig. 2, right).

    Args:
        ct, us: (n, 3) and (m, 3) mm, each in the frame it came in.
        ct_aligned: (n, 3) mm, the CT cloud in the US frame.
        T_us_chest: chest coordinates to the US frame; None for RAS+.
    """
    views: tuple[View, ...] = ("front", "front", "side")
    pairs = [
        (project(c, v, T_us_chest), project(us, v, T_us_chest))
        for c, v in zip((ct, ct_aligned, ct_aligned), views, strict=True)
    ]
    extents = [bounds(*pair) for pair in pairs]
    ratios = [np.divide(*np.ptp(extent, axis=0)) for extent in extents]
    tall = float(np.clip((WIDTH_IN - 2.0) / sum(ratios) + 1.2, 3.2, 6.0))
    figure = new_figure(tall, "CT and US clouds before and after the coarse alignment")
    titles = ("before, as given", "after: sternums overlaid, from the front", "from the right")
    panels = figure.subplots(1, 3, width_ratios=ratios)
    for ax, pair, view, extent, title in zip(panels, pairs, views, extents, titles, strict=True):
        for points, colour in zip(pair, (CT_COLOUR, US_COLOUR), strict=True):
            dots(ax, points, colour, size=3, alpha=0.55)
        if ax is not panels[0]:
            look(ax, view, extent, title)
    # Before, the CT has no left or up that holds in this frame.
    look(panels[0], "side", extents[0], titles[0])
    panels[0].set_xlabel("US patient's axes: left (mm)", fontsize=8)
    panels[0].set_ylabel("US patient's axes: up (mm)", fontsize=8)
    handles = [Line2D([], [], ls="", marker="o", color=c, label=n) for c, n in ((CT_COLOUR, "CT"), (US_COLOUR, "US"))]
    below(figure, handles, 2)
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
    T: RigidTransform | None,
    numbers: bool,
    title: str,
    *,
    directed: bool = True,
) -> None:
    nodes = project(graph.nodes, "front", T)
    extent = bounds(nodes, margin_mm=12.0)
    if points is not None:
        cloud = project(points, "front", T)
        extent = bounds(nodes, cloud)
        dots(ax, cloud, PALE, size=3)
    single = one_way(graph.edges) & directed
    flat = nodes[:, :2]
    links = LineCollection(list(flat[graph.edges[~single]]), colors="#777777", linewidths=0.7, zorder=2)
    ax.add_collection(links)
    if single.any():
        tail, head = flat[graph.edges[single, 0]], flat[graph.edges[single, 1]]
        if numbers:  # the arrow ends where the nodes begin
            gap = 1.35 * (head - tail) / np.maximum(np.linalg.norm(head - tail, axis=1, keepdims=True), 1e-9)
            tail, head = tail + gap, head - gap
        arrow: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "units": "xy", "width": 0.32}
        arrow |= {"headwidth": 4.5, "headlength": 4.5, "headaxislength": 4.2, "color": "black", "zorder": 4}
        ax.quiver(tail[:, 0], tail[:, 1], *(head - tail).T, **arrow)
    colours = part_colours(graph.parts, len(nodes))
    x, y = flat.T
    if numbers:
        ax.scatter(x, y, s=150, c=1 - 0.45 * (1 - colours), ec=colours, lw=1.3, zorder=3)
    else:
        ax.scatter(x, y, s=13, c=colours, ec="white", lw=0.3, zorder=5)
    for number, place in enumerate(flat if numbers else []):
        ax.text(place[0], place[1], str(number), fontsize=6, ha="center", va="center_baseline", zorder=6)
    look(ax, "front", extent, title)


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
    _draw_graph(figure.subplots(), graph, points, T_cloud_chest, numbers, _counted(graph))
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
    """
    figure = new_figure(10.6, "Skeleton graph: the template, then the two maps")
    grid = figure.add_gridspec(2, 2, height_ratios=[1.45, 1])
    top, left, right = (figure.add_subplot(grid[place]) for place in ((0, slice(None)), (1, 0), (1, 1)))
    _draw_graph(top, template, None, T_cloud_chest, True, f"template: {_counted(template)}")
    _draw_graph(left, g_ct, ct_points, T_cloud_chest, False, "graph of the CT cloud, from the template", directed=False)
    _draw_graph(
        right, g_us, us_points, T_cloud_chest, False, "graph of the US cloud, from the CT graph", directed=False
    )
    part_legend(figure)
    return figure


def som_progress(histories: Mapping[str, Sequence[float]]) -> Figure:
    """Quantisation error (mean distance from points to their nearest node, mm) over each map's schedule.

    Args:
        histories: by the map's name, errors at even steps.
    """
    require(histories, "histories")
    figure = new_figure(3.4, "How well each map covers its cloud")
    ax = figure.subplots()
    colours = (CT_COLOUR, US_COLOUR, DARK, *LEVEL_COLOUR.values())
    for k, (name, history) in enumerate(histories.items()):
        require(history, f"history of {name}")
        x = np.linspace(0, 100, len(history))
        ax.plot(
            x,
            history,
            marker="o" if len(history) <= 40 else "",
            ms=3,
            color=colours[k % len(colours)],
            label=f"{name}: ends at {history[-1]:.2f} mm",
        )
    ax.set(xlabel="part of the schedule (%)", ylabel="points to nearest node (mm)", ylim=(0, None))
    plain(ax)
    ax.grid(alpha=0.25)
    ax.legend(fontsize=8, frameon=False)
    return figure


def registration_grid(
    warped: Mapping[str, ArrayLike],
    target: ArrayLike,
    *,
    T_us_chest: RigidTransform | None = None,
    most_mm: float | None = None,
) -> Figure:
    """Each method's warped CT cloud on the US cloud, front and side, coloured by distance to the US cloud.

    Args:
        warped: by method, (n, 3) mm in the US frame.
        target: (m, 3) mm, the US cloud.
        T_us_chest: chest coordinates to the US frame; None for RAS+.
        most_mm: top of the shared colour scale; the 98th percentile of all distances when None.
    """
    require(warped, "registrations")
    us = as_points(target, "target")
    clouds = {name: as_points(warped[name], name) for name in in_order(warped)}
    residual = {name: nearest(points, us)[0] for name, points in clouds.items()}
    top = most_mm or max(1.0, float(np.ceil(np.percentile(np.concatenate(list(residual.values())), 98))))
    views: tuple[View, View] = ("front", "side")
    every = np.concatenate([us, *clouds.values()])
    extents = [bounds(project(every, view, T_us_chest)) for view in views]
    widths = [float(np.ptp(extent[:, 0])) for extent in extents]
    rows = -(-len(clouds) // 2)
    scale = (WIDTH_IN - 2.2) / (2 * sum(widths))  # inches a mm
    title = "Warped CT clouds on the US cloud (grey)"
    figure = new_figure(0.5 + rows * (float(np.ptp(extents[0][:, 1])) * scale + 0.65), title)
    grid = figure.subplots(rows, 4, width_ratios=widths * 2, squeeze=False)
    drawn: Any = None
    for k, (name, points) in enumerate(clouds.items()):
        text = f"{method_style(name).label}\nmean {residual[name].mean():.1f}, largest {residual[name].max():.1f} mm"
        for ax, view, extent, title in zip(
            grid[k // 2, 2 * (k % 2) :], views, extents, (text, "from the right"), strict=False
        ):
            dots(ax, project(us, view, T_us_chest), PALE, size=2.5)
            order = thin(len(points))
            seen = project(points[order], view, T_us_chest)
            drawn = dots(ax, seen, residual[name][order], size=3.5, cmap=steps("viridis"), vmin=0, vmax=top)
            look(ax, view, extent, title)
            if view == "side":
                ax.set_ylabel("")
    for ax in grid.ravel()[4 * rows - 2 * (2 * rows - len(clouds)) :]:
        ax.set_axis_off()
    bar = figure.colorbar(drawn, ax=grid, extend="max", shrink=0.7, aspect=35, pad=0.01)
    bar.set_label("distance of a warped CT point to the US cloud (mm)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return figure


def _spaces(labels: Sequence[str]) -> list[Ints]:
    """Row numbers of the waypoints of each intercostal space, in the order of the path."""
    names = np.array([label.rsplit(".", 1)[0] for label in labels])
    return [np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())]


def transferred_path(
    target: ArrayLike,
    truth: Waypoints,
    transferred: Mapping[str, ArrayLike],
    *,
    warped: Mapping[str, ArrayLike] | None = None,
    T_us_chest: RigidTransform | None = None,
    note: str = SIMULATED,
) -> Figure:
    """The paper's Fig. 4a: the path carried from CT over the US cloud beside the waypoints defined there.

    Args:
        target: (m, 3) mm, the US cloud.
        truth: the waypoints of the patient, US frame.
        transferred: by method, (k, 3) mm, row i belongs to ``truth.points[i]``.
        warped: by method, the warped CT cloud (n, 3) mm, or None.
        T_us_chest: chest coordinates to the US frame; None for RAS+.
        note: where the patient is from.

    Raises:
        StudyError: no method, or waypoints that do not pair.
    """
    require(transferred, "transferred waypoints")
    cloud, goal = (project(p, "front", T_us_chest) for p in (target, truth.points))
    methods = in_order(transferred)
    columns = min(2, len(methods))
    rows = -(-len(methods) // columns)
    extent = bounds(cloud, goal, *(project(p, "front", T_us_chest) for p in transferred.values()))
    wide, tall = np.ptp(extent, axis=0)
    title = f"{len(truth)} waypoints from CT to US ({note})"
    panel_in = min(WIDTH_IN - 0.9, 6.5 * columns) / columns  # one method alone need not fill the page
    figure = new_figure(0.9 + rows * (panel_in * tall / wide + 0.4), title)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, method in zip(grid, methods, strict=False):
        style = method_style(method)
        if np.shape(transferred[method]) != truth.points.shape:
            raise StudyError(
                f"{method}: expected a row per waypoint {truth.points.shape}, got {np.shape(transferred[method])}"
            )
        found = project(transferred[method], "front", T_us_chest, method)
        dots(ax, cloud, PALE, size=3)
        if warped is not None and method in warped:
            dots(
                ax,
                project(warped[method], "front", T_us_chest),
                to_hex(lighter(style.colour, 0.55)),
                size=1.5,
                alpha=0.5,
            )
        for rows_of_space in _spaces(truth.labels):
            ax.plot(*goal[rows_of_space, :2].T, color=DARK, lw=1.0)
            ax.plot(*found[rows_of_space, :2].T, color=style.colour, lw=1.3)
        ax.add_collection(
            LineCollection(list(np.stack([goal, found], 1)[:, :, :2]), colors=_ERROR_COLOUR, linewidths=1.2, zorder=6)
        )
        ax.scatter(*goal[:, :2].T, s=34, fc="white", ec=DARK, lw=1.2, zorder=4)
        ax.scatter(*found[:, :2].T, s=30, marker=style.marker, fc=style.face, ec=style.colour, lw=1.2, zorder=5)
        error, flat = (np.linalg.norm((found - goal)[:, :n], axis=1) for n in (3, 2))
        text = f"{style.label}: mean error {error.mean():.1f} mm, in this view {flat.mean():.1f} mm"
        look(ax, "front", extent, text)
    for ax in grid[len(methods) :]:
        ax.set_axis_off()
    hollow = Line2D([], [], marker="o", ls="-", mfc="white", color=DARK, label="defined on the patient")
    filled = Line2D([], [], marker="D", ls="-", color=GREY, label="transferred from CT, in the method's colour")
    error_line = Line2D([], [], color=_ERROR_COLOUR, lw=1.2, label="error of a waypoint")
    below(figure, [hollow, filled, error_line], 3)
    return figure
