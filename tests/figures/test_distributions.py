"""Every value of every CT and method is there, a failure is named, the paper's numbers stand apart."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from figure_data import METHODS, PAPER, SOURCES, failing, metrics, texts
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Rectangle

from study import figures
from study.evaluation import in_order

EXAMPLES: dict[str, Callable[[], Figure]] = {
    "waypoint_boxes": lambda: figures.waypoint_boxes(metrics(), paper=PAPER),
    "hd_bars": lambda: figures.hd_bars(metrics(), paper=PAPER),
    "error_views": lambda: figures.error_views(metrics(), ("waypoint_error", "waypoint_error_inplane")),
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "empty metrics": lambda: figures.waypoint_boxes(metrics().iloc[:0]),
    "unknown metric": lambda: figures.hd_bars(metrics(), "hd99"),
    "two datasets": lambda: figures.hd_bars(pd.concat([metrics(), metrics().assign(dataset="open")])),
    "missing column": lambda: figures.hd_bars(metrics().drop(columns="status")),
    "only failures": lambda: figures.waypoint_boxes(failing()[lambda t: t["metric"] == "case"]),
    "no such views": lambda: figures.error_views(metrics(), ("hd99",)),
}


def test_boxes_hold_every_waypoint_of_every_ct_and_method() -> None:
    table = metrics()
    figure = figures.waypoint_boxes(table)
    (ax,) = figure.axes
    boxes = [p for p in ax.patches if isinstance(p, PathPatch)]
    assert len(boxes) == len(SOURCES) * len(METHODS)
    assert [label.get_text() for label in ax.get_xticklabels()] == ["ct1", "ct2", "ct10"]
    assert [b.get_edgecolor()[:3] for b in boxes[:4]] == [to_rgb(figures.METHOD_STYLE[m].colour) for m in METHODS]
    dots = [drawn.get_offsets() for drawn in ax.findobj(PathCollection)]
    assert sum(len(offsets) for offsets in dots) == len(SOURCES) * len(METHODS) * 20
    first = table[(table["source"] == "ct1") & (table["method"] == "icp") & (table["metric"] == "waypoint_error")]
    np.testing.assert_allclose(dots[0][:, 1], first["value"])
    assert ax.get_ylabel() == "Waypoint error (mm)"
    assert "n = 20" in texts(figure)
    assert "simulated patient" in texts(figure)


def test_boxes_do_not_depend_on_the_order_of_rows() -> None:
    table = metrics()
    assert figures.png(figures.waypoint_boxes(table)) == figures.png(
        figures.waypoint_boxes(table.sort_values("method", kind="stable"))
    )


def test_a_failed_case_is_named_where_its_box_would_be() -> None:
    for draw in (figures.waypoint_boxes, figures.hd_bars):
        figure = draw(failing())
        (word,) = [text for text in figure.axes[0].texts if text.get_text().strip() == "failed"]
        assert word.get_color() == figures.METHOD_STYLE["cpd"].colour
    assert len([p for p in figures.waypoint_boxes(failing()).axes[0].patches if isinstance(p, PathPatch)]) == 11
    assert ", n=2" in texts(figures.hd_bars(failing()))


def test_a_source_whose_methods_all_failed_says_so_once() -> None:
    table = pd.concat([failing(method=method).query("source == 'ct2' and method == @method") for method in METHODS])
    whole = metrics()
    table = pd.concat([whole[whole["source"] != "ct2"], table], ignore_index=True)
    for draw in (figures.waypoint_boxes, figures.hd_bars):
        words = [text.get_text() for text in draw(table).axes[0].texts if "failed" in text.get_text()]
        assert words == ["failed"]


def test_the_truth_is_drawn_last_like_a_tuned_method() -> None:
    methods = ("truth", *METHODS)
    assert in_order(methods)[-1] == "truth"
    style = figures.method_style("truth")
    assert (style.tuned, style.hatch, style.marker) == (True, "", "*")
    for draw in (figures.waypoint_boxes, figures.hd_bars):
        assert "Perfect (truth)" in texts(draw(metrics(methods), paper=PAPER))


def test_uneven_boxes_print_their_own_n() -> None:
    table = metrics().drop(index=0)
    shown = texts(figures.waypoint_boxes(table))
    assert "n=19" in shown
    assert shown.count("n=20") == 11


def test_bars_end_with_the_mean_and_the_population_sd() -> None:
    table = metrics(n_targets=2)
    figure = figures.hd_bars(table, paper=PAPER)
    (ax,) = figure.axes
    bars = [p for p in ax.patches if isinstance(p, Rectangle) and p.get_width() == pytest.approx(0.86)]
    assert len(bars) == (len(SOURCES) + 1) * len(METHODS)
    icp = table[(table["method"] == "icp") & (table["metric"] == "hd")].groupby("source")["value"].mean()
    assert bars[3].get_height() == pytest.approx(icp.mean())
    assert f"{icp.mean():.2f}±{icp.std(ddof=0):.2f}" in texts(figure)
    assert "paper, other data" in texts(figure)


def test_paper_markers_are_hollow_at_the_papers_numbers() -> None:
    figure = figures.hd_bars(metrics(), paper=PAPER)
    hollow = [line for line in figure.axes[0].lines if line.get_markerfacecolor() == "white"]
    assert sorted(line.get_ydata()[0] for line in hollow) == [9.48, 17.35]


def test_error_views_explain_bar_and_number() -> None:
    shown = texts(figures.error_views(metrics(), ("waypoint_error",)))
    assert "mean waypoint error of a pair (mm)" in shown
    assert "population SD" in shown
