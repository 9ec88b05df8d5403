"""Registrations share a scale; a path is joined within its space and says its error."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from figure_data import FRONT, METHODS, POINTS, WAYPOINTS, texts
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure

from study import figures

EXAMPLES: dict[str, Callable[[], Figure]] = {
    "registration_grid": lambda: figures.registration_grid({m: POINTS + 1.0 for m in METHODS[:3]}, POINTS),
    "transferred_path": lambda: figures.transferred_path(
        POINTS, WAYPOINTS, {m: WAYPOINTS.points + 1.0 for m in METHODS}
    ),
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "no methods": lambda: figures.registration_grid({}, POINTS),
    "no target": lambda: figures.registration_grid({"icp": POINTS}, np.zeros((0, 3))),
    "no paths": lambda: figures.transferred_path(POINTS, WAYPOINTS, {}),
    "unpaired": lambda: figures.transferred_path(POINTS, WAYPOINTS, {"icp": WAYPOINTS.points[:3]}),
}


def test_registrations_share_one_colour_scale() -> None:
    warped = {"icp": POINTS + 8.0 * FRONT, "skeleton_graph": POINTS + FRONT}
    figure = figures.registration_grid(warped, POINTS)
    scales = {
        drawn.get_clim()
        for drawn in figure.findobj(PathCollection)
        if drawn.get_array() is not None and len(drawn.axes.texts)
    }
    assert len(scales) == 1
    assert "Skeleton graph\nmean 1.0" in texts(figure)
    assert "ICP\nmean" in figure.axes[0].get_title(loc="left")


def test_path_joins_waypoints_within_a_space_only_and_says_the_error() -> None:
    figure = figures.transferred_path(POINTS, WAYPOINTS, {"icp": WAYPOINTS.points + np.array([0.0, 4.0, 3.0])})
    ax = figure.axes[0]
    assert sorted(len(line.get_xdata()) for line in ax.lines) == [3] * 8 + [4] * 4
    assert "mean error 5.0 mm, in this view 3.0 mm" in ax.get_title(loc="left")
    (errors,) = ax.findobj(LineCollection)
    assert len(errors.get_segments()) == 20
    assert figures.SIMULATED in texts(figure)
