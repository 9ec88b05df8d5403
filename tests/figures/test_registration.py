"""Registrations share a scale; a path is joined within its space and says its error."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from figure_data import FRONT, METHODS, POINTS, WAYPOINTS, texts
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from study import figures

EXAMPLES: dict[str, Callable[[], Figure]] = {
    "registration_grid": lambda: figures.registration_grid({m: POINTS + 1.0 for m in METHODS[:3]}, POINTS),
    "transferred_path": lambda: figures.transferred_path(
        POINTS, WAYPOINTS, {m: WAYPOINTS.points + 1.0 for m in METHODS}
    ),
}
VIEW = figures.PairView(
    target=POINTS,
    goal=WAYPOINTS,
    warped={m: POINTS + 1.0 for m in METHODS[:3]},
    moved={m: WAYPOINTS.points + np.array([0.0, 4.0, 3.0]) for m in METHODS[:3]},
)
EXAMPLES["pairs_grid"] = lambda: figures.pairs_grid({"typical": VIEW, "worst": VIEW}, "Real people")
REFUSED: dict[str, Callable[[], Figure]] = {
    "no methods": lambda: figures.registration_grid({}, POINTS),
    "no target": lambda: figures.registration_grid({"icp": POINTS}, np.zeros((0, 3))),
    "no pairs": lambda: figures.pairs_grid({}, "Real people"),
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


def test_every_waypoint_has_an_arrow_to_where_it_was_carried() -> None:
    figure = figures.transferred_path(POINTS, WAYPOINTS, {"icp": WAYPOINTS.points + np.array([0.0, 4.0, 3.0])})
    ax = figure.axes[0]
    assert "mean 5.0 mm, in this view 3.0 mm" in ax.get_title(loc="left")
    (arrows,) = ax.findobj(Quiver)
    np.testing.assert_allclose(arrows.get_offsets(), WAYPOINTS.points[:, [0, 2]] * [-1, 1])
    np.testing.assert_allclose(np.column_stack([arrows.U, arrows.V]), [[0.0, 3.0]] * 20, atol=1e-9)
    assert figures.SIMULATED in texts(figure)
    assert "by the paper's protocol" in texts(figure)


def test_a_row_a_pair_and_a_column_a_method() -> None:
    figure = EXAMPLES["pairs_grid"]()
    titles = [ax.get_title(loc="left") for ax in figure.axes if ax.findobj(Quiver)]
    assert [title.splitlines()[0] for title in titles] == ["typical", "", "", "worst", "", ""]
