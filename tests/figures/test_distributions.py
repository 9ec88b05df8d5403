"""Every value of every CT and method is there, a failure is named, the paper's numbers stand apart."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from figure_data import METHODS, PAPER, SOURCES, failing, metrics, texts
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch

from study import figures
from study.evaluation import in_order

EXAMPLES: dict[str, Callable[[], Figure]] = {
    "waypoint_boxes": lambda: figures.waypoint_boxes(metrics(), paper=PAPER),
    "hd_dots": lambda: figures.hd_dots(metrics(), paper=PAPER),
    "error_views": lambda: figures.error_views(metrics(), ("waypoint_error", "waypoint_error_inplane")),
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "empty metrics": lambda: figures.waypoint_boxes(metrics().iloc[:0]),
    "unknown metric": lambda: figures.hd_dots(metrics(), "hd99"),
    "two datasets": lambda: figures.hd_dots(pd.concat([metrics(), metrics().assign(dataset="open")])),
    "missing column": lambda: figures.hd_dots(metrics().drop(columns="status")),
    "only failures": lambda: figures.waypoint_boxes(failing()[lambda t: t["metric"] == "case"]),
    "no such views": lambda: figures.error_views(metrics(), ("hd99",)),
}


def test_boxes_hold_every_waypoint_of_every_ct_and_method() -> None:
    table = metrics()
    figure = figures.waypoint_boxes(table)
    *panels, means = figure.axes
    assert [ax.get_title(loc="left") for ax in panels] == ["ct1", "ct2", "ct10"]
    names = [label.get_text() for label in panels[0].get_yticklabels()]
    assert names == [figures.METHOD_STYLE[m].label for m in METHODS]
    for ax in panels:
        boxes = [p for p in ax.patches if isinstance(p, PathPatch)]
        assert [b.get_edgecolor()[:3] for b in boxes] == [to_rgb(figures.METHOD_STYLE[m].colour) for m in METHODS]
        assert "n = 20" in ax.get_xlabel()
    dots = [drawn.get_offsets() for ax in panels for drawn in ax.findobj(PathCollection)]
    assert sum(len(offsets) for offsets in dots) == len(SOURCES) * len(METHODS) * 20
    mine = (table["method"] == "icp") & (table["metric"] == "waypoint_error")
    np.testing.assert_allclose(dots[0][:, 0], table.loc[mine & (table["source"] == "ct1"), "value"])
    pooled = table.loc[mine, "value"]
    assert f"{pooled.mean():.2f} ± {pooled.std(ddof=0):.2f}" in texts(figure)
    assert means.get_xlabel() == "mm"
    assert "by the paper's protocol" in texts(figure)
    assert "simulated patient" in texts(figure)


def test_boxes_do_not_depend_on_the_order_of_rows() -> None:
    table = metrics()
    assert figures.png(figures.waypoint_boxes(table)) == figures.png(
        figures.waypoint_boxes(table.sort_values("method", kind="stable"))
    )


def test_a_failed_case_is_named_in_its_row() -> None:
    for draw in (figures.waypoint_boxes, figures.hd_dots):
        figure = draw(failing())
        (word,) = [text for ax in figure.axes for text in ax.texts if text.get_text() == "failed"]
        assert (word.axes.get_title(loc="left"), word.get_position()[1]) == ("ct2", METHODS.index("cpd"))
    boxes = [p for ax in figures.waypoint_boxes(failing()).axes for p in ax.patches if isinstance(p, PathPatch)]
    assert len(boxes) == 11
    assert ", n=2" in texts(figures.hd_dots(failing()))


def test_a_source_whose_methods_all_failed_says_so_once() -> None:
    table = pd.concat([failing(method=method).query("source == 'ct2' and method == @method") for method in METHODS])
    whole = metrics()
    table = pd.concat([whole[whole["source"] != "ct2"], table], ignore_index=True)
    for draw in (figures.waypoint_boxes, figures.hd_dots):
        words = [text.get_text() for ax in draw(table).axes for text in ax.texts if "failed" in text.get_text()]
        assert words == ["all failed"]


def test_the_truth_is_drawn_last_like_a_tuned_method() -> None:
    methods = ("truth", *METHODS)
    assert in_order(methods)[-1] == "truth"
    style = figures.method_style("truth")
    assert (style.tuned, style.marker) == (True, "*")
    for draw in (figures.waypoint_boxes, figures.hd_dots):
        assert "Perfect (truth)" in texts(draw(metrics(methods), paper=PAPER))


def test_uneven_boxes_say_their_range_of_n() -> None:
    figure = figures.waypoint_boxes(metrics().drop(index=0))
    assert [ax.get_xlabel() for ax in figure.axes[:3]] == ["mm; n = 19-20", "mm; n = 20", "mm; n = 20"]


def test_dots_end_with_the_mean_and_the_population_sd() -> None:
    table = metrics(n_targets=2)
    figure = figures.hd_dots(table, paper=PAPER)
    assert len(figure.axes) == len(SOURCES) + 1
    icp = table[(table["method"] == "icp") & (table["metric"] == "hd")].groupby("source")["value"].mean()
    assert f"{icp.mean():.2f} ± {icp.std(ddof=0):.2f}" in texts(figure)
    assert "paper, other data" in texts(figure)
    markers = [line.get_xdata()[0] for line in figure.axes[0].lines if line.get_marker() == "o"]
    np.testing.assert_allclose(markers, [icp["ct1"]])


def test_paper_markers_are_hollow_at_the_papers_numbers() -> None:
    figure = figures.hd_dots(metrics(), paper=PAPER)
    hollow = [line for line in figure.axes[-1].lines if line.get_markerfacecolor() == "white"]
    assert sorted(line.get_xdata()[0] for line in hollow) == [9.48, 17.35]


def test_error_views_explain_bar_and_number() -> None:
    shown = texts(figures.error_views(metrics(), ("waypoint_error",)))
    assert "mean waypoint error of a pair (mm)" in shown
    assert "population SD" in shown
