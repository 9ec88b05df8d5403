"""Pictures of registrations: the warped clouds and the transferred path of each method (sec. III-D, IV)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
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
from study.figures.style import DARK, PALE, SIMULATED, method_style, steps
from study.geometry.points import nearest
from study.types import Floats, RigidTransform, Waypoints, as_points

__all__ = ["PairView", "pairs_grid", "registration_grid", "transferred_path"]

_ERROR_COLOUR = "#DC0050"
_LONGER = 3  # than they are: arrows of errors of a few millimetres on a chest
_METHODS_A_ROW = 4


def registration_grid(
    warped: Mapping[str, ArrayLike],
    target: ArrayLike,
    *,
    T_us_chest: RigidTransform | None = None,
    most_mm: float | None = None,
    title: str = "Warped CT clouds on the US cloud (grey), from the front and, narrow, from the right",
) -> Figure:
    """Each method's warped CT cloud on the US cloud, front and side, coloured by distance to the US cloud.

    Args:
        warped: by method, (n, 3) mm in the US frame.
        target: (m, 3) mm, the US cloud.
        T_us_chest: chest coordinates to the US frame; None for RAS+.
        most_mm: top of the shared colour scale; the 98th percentile of all distances when None.
        title: above the panels.

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
    rows = -(-len(clouds) // _METHODS_A_ROW)
    columns = min(_METHODS_A_ROW, len(clouds))
    scale = (WIDTH_IN - 3.2) / (columns * sum(widths))  # inches a mm
    tall = float(np.ptp(extents[0][:, 1])) * scale
    figure = new_figure(0.9 + rows * (tall + 0.55), title)
    grid = figure.subplots(rows, 2 * columns, width_ratios=widths * columns, squeeze=False, sharey=True)
    drawn: Any = None
    for k, (name, points) in enumerate(clouds.items()):
        text = f"{method_style(name).label}\nmean {residual[name].mean():.1f}, largest {residual[name].max():.1f} mm"
        panels = grid[k // columns, 2 * (k % columns) :]
        for ax, view, extent, words in zip(panels, views, extents, (text, ""), strict=False):
            dots(ax, project(us[thin(len(us), 1600)], view, T_us_chest), PALE, size=1.5)
            size = 2.5 if len(clouds) > 2 else 9.0  # larger in large panels
            drawn = _by_distance(ax, points, residual[name], view, T_us_chest, top, size)
            look(ax, view, extent, words)
            ax.set_xlabel("left (mm)" if view == "front" else "front (mm)", fontsize=8)
    for ax in grid.ravel():
        ax.label_outer()
    for ax in grid.ravel()[2 * len(clouds) :]:
        ax.set_axis_off()
    _distance_bar(figure, drawn, grid)
    return figure


def _by_distance(
    ax: Axes,
    points: Floats,
    distance: Floats,
    view: View,
    T_us_chest: RigidTransform | None,
    top: float,
    size: float = 2.5,
) -> Any:
    """A warped cloud, coloured by its distance to the US cloud."""
    some = thin(len(points), 1600)  # more cannot be told apart in a small panel, and weigh
    seen = project(points[some], view, T_us_chest)
    return dots(ax, seen, distance[some], size=size, cmap=steps("viridis"), vmin=0, vmax=top)


def _distance_bar(figure: Figure, drawn: Any, grid: Any) -> None:
    """One colour bar for all panels, three inches tall at most."""
    shrink = min(0.9, 3.0 / figure.get_figheight())
    bar = figure.colorbar(drawn, ax=grid, extend="max", shrink=shrink, aspect=20, pad=0.01)
    bar.set_label("distance of a warped CT point to the US cloud (mm)", fontsize=8)
    bar.ax.tick_params(labelsize=8)


@dataclass(frozen=True)
class PairView:
    """A pair of a CT and a patient as several methods registered it; all in the US frame.

    Attributes:
        target: (m, 3) mm, the US cloud.
        goal: the waypoints they were to reach.
        warped: by method, the CT cloud (n, 3) mm.
        moved: by method, the carried waypoints (k, 3) mm, row i belongs to ``goal.points[i]``.
        T_us_chest: chest coordinates to the US frame; None for RAS+.
    """

    target: Floats
    goal: Waypoints
    warped: Mapping[str, Floats]
    moved: Mapping[str, Floats]
    T_us_chest: RigidTransform | None = None


def pairs_grid(pairs: Mapping[str, PairView], title: str, *, most_mm: float = 12.0) -> Figure:
    """Several pairs under several methods: a row a pair, a column a method, with the errors of the path as arrows.

    Args:
        pairs: by what the row shows; all with the same methods.
        title: above them; says who judges.
        most_mm: top of the shared colour scale.

    Raises:
        StudyError: no pair or no method.
    """
    require(pairs, "pairs")
    methods = in_order(next(iter(pairs.values())).warped)
    require(methods, "registrations")
    extents = {
        name: bounds(*(project(p, "front", pair.T_us_chest) for p in (pair.target, *pair.warped.values())))
        for name, pair in pairs.items()
    }
    heights = [float(np.divide(*np.ptp(extent, axis=0)[::-1])) for extent in extents.values()]
    figure = new_figure(1.1 + sum(heights) * (WIDTH_IN - 1.7) / len(methods) + 0.5 * len(pairs), title)
    grid = figure.subplots(len(pairs), len(methods), squeeze=False, height_ratios=heights)
    drawn: Any = None
    for row, (name, pair) in zip(grid, pairs.items(), strict=True):
        us = as_points(pair.target, "target")
        goal = project(pair.goal.points, "front", pair.T_us_chest)
        for ax, method in zip(row, methods, strict=True):
            dots(ax, project(us[thin(len(us), 1600)], "front", pair.T_us_chest), PALE, size=1.5)
            distance = nearest(pair.warped[method], us)[0]
            drawn = _by_distance(ax, pair.warped[method], distance, "front", pair.T_us_chest, most_mm)
            found = project(_paired(pair.moved[method], pair.goal, method), "front", pair.T_us_chest)
            text = _draw_path(ax, goal, found, method)
            look(ax, "front", extents[name], f"{name}\n{text}" if ax is row[0] else f"\n{text}")
            ax.set_ylabel("")
            ax.label_outer()
    _distance_bar(figure, drawn, grid)
    below(figure, _path_handles(), 2)
    return figure


def transferred_path(
    target: ArrayLike,
    truth: Waypoints,
    transferred: Mapping[str, ArrayLike],
    *,
    T_us_chest: RigidTransform | None = None,
    note: str = SIMULATED,
) -> Figure:
    """The paper's Fig. 4a: the waypoints defined on the US cloud, and how far off the carried ones end, as arrows.

    Args:
        target: (m, 3) mm, the US cloud.
        truth: the waypoints of the patient, US frame.
        transferred: by method, (k, 3) mm, row i belongs to ``truth.points[i]``.
        T_us_chest: chest coordinates to the US frame; None for RAS+.
        note: where the patient is from.

    Raises:
        StudyError: no method, or waypoints that do not pair.
    """
    require(transferred, "transferred waypoints")
    cloud, goal = (project(p, "front", T_us_chest) for p in (target, truth.points))
    methods = in_order(transferred)
    columns = min(_METHODS_A_ROW, len(methods))
    rows = -(-len(methods) // columns)
    extent = bounds(cloud, goal, *(project(p, "front", T_us_chest) for p in transferred.values()))
    wide, tall = np.ptp(extent, axis=0)
    title = f"{len(truth)} waypoints from CT to US, by the paper's protocol ({note})"
    panel_in = min((WIDTH_IN - 0.9) / columns, 6.5)  # one method alone need not fill the page
    figure = new_figure(1.0 + rows * (panel_in * tall / wide + 0.4), title)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for ax, method in zip(grid, methods, strict=False):
        found = project(_paired(transferred[method], truth, method), "front", T_us_chest, method)
        dots(ax, cloud, PALE, size=2)
        look(ax, "front", extent, _draw_path(ax, goal, found, method))
        ax.label_outer()
    for ax in grid[len(methods) :]:
        ax.set_axis_off()
    below(figure, _path_handles(), 2)
    return figure


def _path_handles() -> list[Line2D]:
    hollow = Line2D([], [], marker="o", ls="", mfc="white", color=DARK, label="where a waypoint belongs")
    text = f"from there to where it was carried, drawn {_LONGER} times as long"
    return [hollow, Line2D([], [], color=_ERROR_COLOUR, lw=1.6, marker=">", ms=5, label=text)]


def _paired(points: ArrayLike, goal: Waypoints, method: str) -> Floats:
    if np.shape(points) != goal.points.shape:
        raise StudyError(
            f"{method}: expected a row per waypoint {goal.points.shape}, got {np.shape(points)}; "
            "transfer all waypoints, in their order"
        )
    return np.asarray(points, dtype=np.float64)


def _draw_path(ax: Axes, goal: Floats, found: Floats, method: str) -> str:
    """The error of each waypoint as an arrow; returns the panel's title."""
    ax.scatter(goal[:, 0], goal[:, 1], s=16, fc="white", ec=DARK, lw=0.9, zorder=4)
    arrow: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1 / _LONGER, "units": "xy", "width": 1.3}
    ax.quiver(goal[:, 0], goal[:, 1], *(found - goal)[:, :2].T, color=_ERROR_COLOUR, zorder=6, **arrow)
    error, flat = (np.linalg.norm((found - goal)[:, :n], axis=1) for n in (3, 2))
    return f"{method_style(method).label}\nmean {error.mean():.1f} mm, in this view {flat.mean():.1f} mm"
