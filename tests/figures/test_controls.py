"""The controls' pictures keep the order of their steps and name what they show."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from figure_data import PARTS, POINTS, texts
from matplotlib.figure import Figure

from study import figures
from study.figures.canvas import T_RAS_CHEST

STEPS = ("as it is", "sweep errors off", "both", "floor: path transfer")
MEASURES = ("hd", "waypoint_error", "visible_hd", "visible_waypoint_error_inplane")


def steps() -> pd.DataFrame:
    rows = [
        {"pair": f"ct{pair}/p", "step": step, "metric": metric, "value": 10.0 - 2 * k + pair}
        for pair in range(3)
        for k, step in enumerate(STEPS)
        for metric in ("hd", "hd95", "msd", "waypoint_error")
        if metric.startswith("waypoint") or not step.startswith("floor")
    ]
    return pd.DataFrame(rows)


def agreement() -> pd.DataFrame:
    rows = [
        {
            "dataset": dataset,
            "source": f"ct{pair}",
            "measure": measure,
            "truth": truth,
            "rho": 0.9 - 0.4 * k + pair / 10,
        }
        for dataset in ("phantom", "planted")
        for pair in range(2)
        for k, measure in enumerate(MEASURES)
        for truth in ("true_waypoint_error", "registered_waypoint_error")
    ]
    return pd.DataFrame(rows)


def point(**changes: Any) -> Figure:
    given: dict[str, Any] = {
        "warped": POINTS,
        "visible": PARTS > 0,
        "us": POINTS + np.array([0.0, 3.0, 0.0]),
        "place": POINTS[5],
        "partner": POINTS[5] + np.array([0.0, 3.0, 4.0]),
    }
    given |= changes
    return figures.hausdorff_point(*given.values(), T_us_chest=T_RAS_CHEST)


EXAMPLES: dict[str, Callable[[], Figure]] = {
    "truth_floor": lambda: figures.truth_floor(steps()),
    "rank_agreement": lambda: figures.rank_agreement(agreement()),
    "hausdorff_point": point,
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "no steps": lambda: figures.truth_floor(steps().iloc[:0]),
    "no agreement": lambda: figures.rank_agreement(agreement().iloc[:0]),
    "agreement without truth": lambda: figures.rank_agreement(agreement().drop(columns="truth")),
    "no cloud": lambda: point(warped=POINTS[:0]),
}


def test_bars_are_means_of_the_pairs_in_the_order_of_the_steps() -> None:
    figure = figures.truth_floor(steps())
    first, *_, path = [ax for ax in figure.axes if ax.get_visible()]
    assert [label.get_text() for label in first.get_yticklabels()] == list(STEPS)
    bottom, top = first.get_ylim()
    assert bottom > top  # the first step on top
    assert [bar.get_width() for bar in first.patches] == [11.0, 9.0, 7.0]
    assert [bar.get_width() for bar in path.patches] == [11.0, 9.0, 7.0, 5.0]
    assert texts(figure).count("does not apply") == 3
    assert "mean over 3 pairs" in texts(figure)


def test_a_row_shows_every_pair_of_every_data_set() -> None:
    figure = figures.rank_agreement(agreement())
    assert len(figure.axes) == 2
    for ax in figure.axes:
        shown = np.concatenate([dots.get_offsets() for dots in ax.collections])
        np.testing.assert_allclose(np.sort(shown[:, 0]), np.sort(agreement()["rho"][::2]))
        assert ax.get_xlim()[0] <= -0.3
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert labels[-1] == "Waypoint error in the feature plane, visible part"
    assert {"phantom: mean; dot: a pair", "planted: mean; dot: a pair"} <= set(texts(figure).splitlines())


def test_the_deciding_point_stands_at_its_place_with_its_distance() -> None:
    figure = point()
    assert texts(figure).count("5.0 mm") == 3  # in the title and in both views
    front, side = figure.axes
    at = T_RAS_CHEST.inverse.apply(POINTS[5][None])[0]
    for ax, place in ((front, at[:2]), (side, at[[2, 1]])):
        (star,) = [line for line in ax.lines if line.get_marker() == "*"]
        np.testing.assert_allclose(star.get_xydata()[0], place)
