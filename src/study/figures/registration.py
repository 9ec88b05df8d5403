"""Pictures of registrations: the warped clouds and the transferred path of each method (sec. III-D, IV)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from study.errors import StudyError
from study.evaluation.pair import in_order
from study.figures.canvas import (
    WIDTH_IN,
    View,
    below,
    bounds,
    dots,
    look,
    new_figure,
    project,
    require,
    thin,
)
from study.figures.style import DARK, GREY, PALE, SIMULATED, lighter, method_style, steps
from study.geometry.points import nearest
from study.types import Floats, Ints, RigidTransform, Waypoints, as_points

__all__ = ["registration_grid", "transferred_path"]

_ERROR_COLOUR = "#DC0050"


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

    Raises:
        StudyError: no method, or a cloud without points.
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
    tall = float(np.ptp(extents[0][:, 1])) * scale
    figure = new_figure(0.5 + rows * (tall + 0.65), "Warped CT clouds on the US cloud (grey)")
    grid = figure.subplots(rows, 4, width_ratios=widths * 2, squeeze=False)
    drawn: Any = None
    for k, (name, points) in enumerate(clouds.items()):
        text = f"{method_style(name).label}\nmean {residual[name].mean():.1f}, largest {residual[name].max():.1f} mm"
        panels = grid[k // 2, 2 * (k % 2) :]
        for ax, view, extent, title in zip(panels, views, extents, (text, "from the right"), strict=False):
            dots(ax, project(us, view, T_us_chest), PALE, size=2.5)
            some = thin(len(points))
            seen = project(points[some], view, T_us_chest)
            drawn = dots(ax, seen, residual[name][some], size=3.5, cmap=steps("viridis"), vmin=0, vmax=top)
            look(ax, view, extent, title)
            if view == "side":
                ax.set_ylabel("")
    for ax in grid.ravel()[4 * rows - 2 * (2 * rows - len(clouds)) :]:
        ax.set_axis_off()
    bar = figure.colorbar(drawn, ax=grid, extend="max", shrink=0.7, aspect=35, pad=0.01)
    bar.set_label("distance of a warped CT point to the US cloud (mm)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return figure


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
        if np.shape(transferred[method]) != truth.points.shape:
            raise StudyError(
                f"{method}: expected a row per waypoint {truth.points.shape}, got {np.shape(transferred[method])}; "
                "transfer all waypoints, in their order"
            )
        found = project(transferred[method], "front", T_us_chest, method)
        dots(ax, cloud, PALE, size=3)
        if warped is not None and method in warped:
            pale = to_hex(lighter(method_style(method).colour, 0.55))
            dots(ax, project(warped[method], "front", T_us_chest), pale, size=1.5, alpha=0.5)
        text = _draw_path(ax, goal, found, _spaces(truth.labels), method)
        look(ax, "front", extent, text)
    for ax in grid[len(methods) :]:
        ax.set_axis_off()
    hollow = Line2D([], [], marker="o", ls="-", mfc="white", color=DARK, label="defined on the patient")
    filled = Line2D([], [], marker="D", ls="-", color=GREY, label="transferred from CT, in the method's colour")
    error_line = Line2D([], [], color=_ERROR_COLOUR, lw=1.2, label="error of a waypoint")
    below(figure, [hollow, filled, error_line], 3)
    return figure


def _draw_path(ax: Axes, goal: Floats, found: Floats, spaces: Sequence[Ints], method: str) -> str:
    """Both paths and the error of each waypoint; returns the panel's title."""
    style = method_style(method)
    for rows in spaces:
        ax.plot(*goal[rows, :2].T, color=DARK, lw=1.0)
        ax.plot(*found[rows, :2].T, color=style.colour, lw=1.3)
    errors = list(np.stack([goal, found], 1)[:, :, :2])
    ax.add_collection(LineCollection(errors, colors=_ERROR_COLOUR, linewidths=1.2, zorder=6))
    ax.scatter(goal[:, 0], goal[:, 1], s=34, fc="white", ec=DARK, lw=1.2, zorder=4)
    marker: dict[str, Any] = {"marker": style.marker, "fc": style.face, "ec": style.edge}
    ax.scatter(found[:, 0], found[:, 1], s=30, lw=1.2, zorder=5, **marker)
    error, flat = (np.linalg.norm((found - goal)[:, :n], axis=1) for n in (3, 2))
    return f"{style.label}: mean error {error.mean():.1f} mm, in this view {flat.mean():.1f} mm"


def _spaces(labels: Sequence[str]) -> list[Ints]:
    """Row numbers of the waypoints of each intercostal space, in the order of the path."""
    names = np.array([label.rsplit(".", 1)[0] for label in labels])
    return [np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())]
