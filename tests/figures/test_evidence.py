"""Evidence is drawn level by level and choice by choice, and what was refused is on the page."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from figure_data import texts
from matplotlib.figure import Figure

from study import figures
from study.evaluation.disturbances import KINDS
from study.evaluation.sensitivity import MEASURES


def levels() -> pd.DataFrame:
    rows = []
    for kind, named in KINDS.items():
        for k, level in enumerate((0.0, 1.0, 2.5)):
            for j, method in enumerate(("coarse", "icp_tuned", "skeleton_graph")):
                median = 2.0 + k + 0.3 * j
                spread = {"p5": median - 1, "p95": median + 2, "low": median - 0.4, "high": median + 0.5}
                counts = {"draws": 20, "by_hand": 3 if k == 2 else 0, "failed": 4 if (k, j) == (2, 1) else 0}
                what = {
                    "kind": kind,
                    "title": named.title,
                    "unit": named.unit,
                    "level": level,
                    "method": method,
                    "metric": "true_waypoint_error",
                }
                rows.append({**what, "median": median, **spread, **counts})
    return pd.DataFrame(rows)


def tried() -> pd.DataFrame:
    rows = []
    for choice in ("draws", "rate", "blend"):
        for role, option, change in (("paper", "one", 0.0), ("alternative", "other", 0.25), ("authors", "theirs", 0.5)):
            named = "yardstick" if choice == "draws" and role == "alternative" else role
            for metric in MEASURES:
                size = change if choice != "blend" else 8 * change
                numbers = {"mean": 2.0 + size, "published": 2.0, "change": size, "low": size - 0.1, "high": size + 0.1}
                what = {"choice": choice, "option": option, "role": named, "metric": metric, "people": 12}
                rows.append({**what, "failed": 2 if option == "theirs" else 0, **numbers})
    return pd.DataFrame(rows)


EXAMPLES: dict[str, Callable[[], Figure]] = {
    "robustness": lambda: figures.robustness(levels()),
    "choices": lambda: figures.choices(tried()),
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "no level": lambda: figures.robustness(levels().iloc[:0]),
    "another metric": lambda: figures.robustness(levels(), "hd"),
    "published alone": lambda: figures.choices(tried()[lambda t: t["role"] == "paper"]),
    "no summary of choices": lambda: figures.choices(tried().drop(columns="low")),
}


def test_robustness_has_a_panel_a_kind_with_what_was_refused_and_failed() -> None:
    figure = figures.robustness(levels())
    shown = texts(figure)
    assert [ax.get_title(loc="left") for ax in figure.axes] == [kind.title for kind in KINDS.values()]
    assert shown.count("3\nrefused") == len(KINDS)
    assert shown.count("×4") == len(KINDS)
    medians = [line.get_ydata() for line in figure.axes[0].lines if len(line.get_ydata()) == 3]
    np.testing.assert_allclose(medians, [[2, 3, 4], [2.6, 3.6, 4.6], [2.3, 3.3, 4.3]])  # as METHODS has them


def test_clouds_that_fail_every_method_are_counted_once() -> None:
    lost = levels()
    lost.loc[lost["level"] == lost["level"].max(), "failed"] = 6
    shown = texts(figures.robustness(lost))
    assert shown.count("3\nrefused\n6\nlost") == shown.count("6\nlost") > 0
    assert "×6" not in shown


def test_choices_are_cut_into_pages_that_hold_every_one_once() -> None:
    summary = tried()
    whole = [name for page in figures.choice_pages(summary) for name in page]
    pages = figures.choice_pages(summary, most=3)
    assert len(pages) > 1
    assert [name for page in pages for name in page] == whole
    assert set(whole) == set(summary.loc[summary["role"] != "paper", "choice"])
    part = texts(figures.choices(summary, pages[0]))
    assert all((f"{name}:" in part) == (name in pages[0]) for name in whole)


def test_choices_have_a_row_each_with_the_change_of_every_measure() -> None:
    figure = figures.choices(tried())
    shown = texts(figure)
    assert len(figure.axes) == 3 * 6
    assert "rate: one →" in shown
    assert "theirs (2 refused)" in shown
    assert "published: 200.0" in shown  # a share of 2, in %
    rate = [line.get_xdata()[0] for line in figure.axes[6].lines if len(line.get_xdata()) == 1]
    assert rate == [0.25, 0.5]
    assert "+4.0" in shown  # beyond the axis
