"""Differences are paired, named with their sign and kept on the page."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from figure_data import METHODS, texts
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from study import figures


def budget() -> pd.DataFrame:
    rows = []
    for k, error in enumerate(("none", "latency", "all")):
        rows.append({"error": error, "metric": "surface_distance", "method": "", "value": 0.2 + k})
        rows += [
            {"error": error, "metric": "waypoint_error", "method": method, "value": 2.0 + k + seed / 10}
            for method in METHODS
            for seed in range(3)
        ]
    return pd.DataFrame(rows)


def choices() -> pd.DataFrame:
    rows = [
        ("rate", "constant", "paper", 2.0),
        ("rate", "compounding", "authors", 2.5),
        ("rate", "linear", "alternative", 1.75),
    ]
    return pd.DataFrame(
        [
            {"choice": c, "option": o, "role": r, "case": f"ct{k}", "value": v + k}
            for c, o, r, v in rows
            for k in range(4)
        ]
    )


def paired() -> pd.DataFrame:
    rows = [
        {"dataset": dataset, "method": method, "difference": k - 2.0}
        for dataset in ("open", "phantom")
        for method in (*METHODS[:3], "truth")
        for k in range(3)
    ]
    return pd.DataFrame(rows)


def steps() -> pd.DataFrame:
    rows = [("as published", 4.0, 1.8), ("visible surface", 2.5, 1.7), ("field", 1.6, 1.2)]
    return pd.DataFrame(
        [
            {"change": change, "case": f"ct{k}", "true": true + k, "in_plane": plane}
            for change, true, plane in rows
            for k in range(3)
        ]
    )


def intervals() -> pd.DataFrame:
    rows = [("icp", -2.0, -3.0, -1.0, False), ("cpd", 0.5, -1.0, 1.0, True)]
    return pd.DataFrame(
        [
            dict(zip(("against", "value", "low", "high", "is_tie"), row, strict=True), metric=metric, dataset=dataset)
            for metric in ("hd", "true_waypoint_error")
            for dataset in ("phantom", "open")
            for row in rows
        ]
    )


EXAMPLES: dict[str, Callable[[], Figure]] = {
    "sensitivity": lambda: figures.sensitivity(choices()),
    "error_budget": lambda: figures.error_budget(budget()),
    "paired_differences": lambda: figures.paired_differences(paired(), "skeleton_graph", "Waypoint error"),
    "way": lambda: figures.way(steps()),
    "difference_rows": lambda: figures.difference_rows(intervals(), "skeleton_graph"),
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "empty choices": lambda: figures.sensitivity(choices().iloc[:0]),
    "no published option": lambda: figures.sensitivity(choices()[lambda t: t["role"] != "paper"]),
    "nothing paired": lambda: figures.sensitivity(choices()[lambda t: (t["role"] == "paper") ^ (t["case"] == "ct1")]),
    "budget without paths": lambda: figures.error_budget(budget()[lambda t: t["metric"] != "waypoint_error"]),
    "a way without steps": lambda: figures.way(steps().iloc[:0]),
    "no intervals": lambda: figures.difference_rows(intervals().iloc[:0], "icp"),
    "no differences": lambda: figures.paired_differences(paired().iloc[:0], "icp", "Waypoint error"),
}


def test_sensitivity_shows_paired_differences() -> None:
    figure = figures.sensitivity(choices())
    shown = texts(figure)
    assert "+0.50 (n=4)" in shown
    assert "−0.25 (n=4)" in shown
    assert "constant → compounding" in shown
    cloud = figure.axes[0].collections[0].get_offsets()
    np.testing.assert_allclose(cloud[:, 0], 0.5)


def test_a_wide_option_does_not_stretch_the_axis_and_says_how_far_it_goes() -> None:
    table = choices()
    wide = table[table["option"] == "compounding"].assign(option="all nodes", value=lambda t: t["value"] + 4.0)
    near = table[table["option"] == "constant"].assign(option="others", role="yardstick", choice="draws")
    draws = table[table["option"] == "constant"].assign(choice="draws")
    figure = figures.sensitivity(pd.concat([table, wide, draws, near]))
    (ax,) = figure.axes
    assert ax.get_xlim()[1] < 1.3
    assert "4 cases, to +4.50" in texts(figure)
    assert "0.00 (n=4)" in texts(figure)
    assert not any(sign + "0.00" in texts(figure) for sign in "+-−")
    assert len([p for p in ax.patches if isinstance(p, Rectangle)]) == 1  # the yardstick's band


def test_paired_differences_say_once_which_side_is_better() -> None:
    figure = figures.paired_differences(paired(), "skeleton_graph", "Waypoint error")
    shown = texts(figure)
    assert shown.count("better") == 1
    assert shown.startswith("Waypoint error: ") or "\nWaypoint error: " in shown
    assert [ax.get_xlabel() for ax in figure.axes] == ["difference (mm)"] * 2
    assert "Perfect (truth)" in shown


def test_error_budget_keeps_the_order_of_sources_and_starts_at_zero() -> None:
    figure = figures.error_budget(budget())
    left, *panels = figure.axes
    assert len(panels) == len(METHODS)  # a family each
    assert [label.get_text() for label in left.get_yticklabels()] == ["none", "latency", "all"]
    bottom, top = left.get_ylim()
    assert bottom > top  # the first source on top
    assert left.get_xlim()[0] == 0
    assert {panel.get_xlim() for panel in panels} == {panels[0].get_xlim()}
    assert panels[0].get_xlim()[0] == 0


def test_tuned_and_shipped_of_one_method_share_a_panel() -> None:
    both = pd.concat([budget(), budget()[lambda t: t["metric"] == "waypoint_error"].assign(method="icp_tuned")])
    figure = figures.error_budget(both)
    assert [ax.get_title(loc="left") for ax in figure.axes[:2]] == ["the cloud itself", "ICP"]
    assert len(figure.axes) == 1 + len(METHODS)


def test_difference_rows_say_who_judges_and_leave_ties_hollow() -> None:
    figure = figures.difference_rows(intervals(), "skeleton_graph")
    titles = [ax.get_title(loc="left").replace("\n", " ") for ax in figure.axes]
    assert titles == ["Hausdorff distance, by the paper's protocol", "True waypoint error"]
    marks = [line for line in figure.axes[0].lines if len(line.get_xdata()) == 1 and line.get_marker() != "None"]
    assert [line.get_markerfacecolor() == "white" for line in marks] == [False, True, False, True]
    assert [line.get_xdata()[0] for line in marks] == [-2.0, 0.5, -2.0, 0.5]


def test_the_way_has_a_row_a_step_and_its_mean() -> None:
    figure = figures.way(steps())
    shown = texts(figure)
    assert all(name in shown for name in ("as published", "+ visible surface", "+ field"))
    line = figure.axes[0].lines[0]
    np.testing.assert_allclose(line.get_xdata(), [5.0, 3.5, 2.6])
    np.testing.assert_array_equal(line.get_ydata(), [0, 1, 2])
    assert len(figures.way(steps().drop(columns="in_plane")).axes[0].lines) == 1
