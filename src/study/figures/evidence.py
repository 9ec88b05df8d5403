"""Pictures of evidence: how true methods stay as clouds get worse, and what each choice changes, tearing included."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from study.evaluation.metrics import METRICS
from study.evaluation.pair import in_order
from study.figures.canvas import below, new_figure, plain, require, require_columns
from study.figures.style import DARK, GREY, method_style

__all__ = ["choice_pages", "choices", "robustness"]

_SUMMARY = (
    "kind",
    "title",
    "unit",
    "level",
    "method",
    "metric",
    "draws",
    "median",
    "p5",
    "p95",
    "low",
    "high",
    "by_hand",
    "failed",
)
_COLUMNS = 3
_LUCK_COLOUR = "#e8e8e8"
_BAND_COLOUR = "#dddddd"
_ROLE = {"authors": ("authors' code", "#CC3311", "s"), "alternative": ("alternative", "#0077BB", "o")}
# What `choices` shows of an option: metric, heading, factor to the axis' unit, unit.
_VIEWS = (
    ("true_waypoint_error", "true error", 1.0, "mm"),
    ("true_waypoint_error_inplane", "true, in plane", 1.0, "mm"),
    ("waypoint_error", "protocol", 1.0, "mm"),
    ("stretched_share", "torn links", 100.0, "%"),
    ("folded_share", "folded over", 100.0, "%"),
    ("wrong_part_share", "on another part", 100.0, "%"),
)


def robustness(summary: pd.DataFrame, metric: str = "true_waypoint_error") -> Figure:
    """A panel a kind of disturbance: by method the median over draws, its interval and the band of the draws.

    Levels stand at even steps. Above them stands in how many draws the coarse alignment refused the clouds, so that the
    methods started by hand; × and a number in its colour under that is a method of which draws failed.

    Args:
        summary: of `study.evaluation.robustness.robustness_summary`.
        metric: which of its errors.

    Raises:
        StudyError: no row of that metric.
    """
    require_columns(summary, _SUMMARY, "a robustness summary")
    rows = summary[summary["metric"] == metric]
    require(rows, f"rows of metric {metric!r}")
    kinds, methods = list(dict.fromkeys(rows["kind"])), in_order(rows["method"])
    n_rows = -(-len(kinds) // _COLUMNS)
    figure = new_figure(1.5 + 3.0 * n_rows, f"{METRICS[metric].title} as the clouds get worse (synthetic people)")
    panels = figure.subplots(n_rows, _COLUMNS, squeeze=False, sharey=True).ravel()
    top = 1.25 * float(rows["high"].max())
    for ax, kind in zip(panels, kinds, strict=False):
        mine = rows[rows["kind"] == kind]
        _draw_kind(ax, mine, methods, top)
        plain(ax, mine["title"].iloc[0])
        ax.set_xlabel(mine["unit"].iloc[0], fontsize=8)
    for ax in panels[::_COLUMNS]:
        ax.set_ylabel("mean over the waypoints (mm)", fontsize=8)
    for ax in panels[len(kinds) :]:
        ax.remove()
    draws = rows["draws"].max()
    handles: list[Any] = []
    for method in methods:
        s = method_style(method)
        handles.append(Line2D([], [], color=s.colour, ls=_dashes(method), marker=s.marker, mfc=s.face, label=s.label))
    handles += [
        Patch(color=_BAND_COLOUR, label=f"5th-95th percentile of {draws} draws"),
        Line2D([], [], color=DARK, lw=2.5, label="95 % interval of the median"),
        Line2D([], [], ls="", label="n refused: draws that were started by hand"),
        Line2D([], [], ls="", label="n lost: draws without a cloud, for every method"),
        Line2D([], [], ls="", label="×n: draws of a method that failed"),
    ]
    below(figure, handles, 4)
    return figure


def _dashes(method: str) -> str:
    return "-" if method_style(method).tuned else "--"


def _draw_kind(ax: Axes, rows: pd.DataFrame, methods: list[str], top: float) -> None:
    levels = list(dict.fromkeys(rows["level"]))
    alike = rows.groupby("level")["failed"].nunique() == 1  # clouds that cannot be made fail every method
    for k, method in enumerate(methods):
        mine = rows[rows["method"] == method].set_index("level").reindex(levels)
        style = method_style(method)
        x = np.arange(len(levels)) + 0.1 * len(levels) * ((k + 0.5) / len(methods) - 0.5)
        ax.fill_between(x, mine["p5"], mine["p95"], color=style.colour, alpha=0.1, lw=0)
        ax.vlines(x, mine["low"], mine["high"], color=style.colour, lw=2.5, alpha=0.8)
        ax.plot(
            x,
            mine["median"],
            _dashes(method),
            color=style.colour,
            lw=1.1,
            marker=style.marker,
            ms=4.5,
            mfc=style.face,
            mec=style.colour,
        )
        for place, level, failed in zip(x, levels, mine["failed"], strict=True):
            if failed and not alike[level]:
                ax.text(place, 0.86 * top, f"×{failed:.0f}", color=style.colour, fontsize=7, ha="center", va="center")
    for place, level in enumerate(levels):
        mine = rows[rows["level"] == level]
        by_hand, failed = mine["by_hand"].max(), mine["failed"].max()
        told = [f"{by_hand}\nrefused"] if by_hand else []
        told += [f"{failed}\nlost"] if failed and alike[level] else []
        if told:
            ax.text(place, 0.985 * top, "\n".join(told), color=DARK, fontsize=7, ha="center", va="top")
    ax.set_xticks(range(len(levels)), [f"{level:g}" for level in levels])
    ax.set_xlim(-0.5, len(levels) - 0.5)
    ax.set_ylim(0, top)
    ax.grid(axis="y", alpha=0.3)


def choice_pages(summary: pd.DataFrame, most: int = 24) -> list[list[str]]:
    """The choices of a sensitivity summary on as many pages as keep each figure on a screen.

    Args:
        summary: of `study.evaluation.sensitivity.sensitivity_summary`.
        most: rows of a page; a heading counts as one.
    """
    options = summary[summary["role"] != "paper"].drop_duplicates(["choice", "option"])
    pages: list[list[str]] = []
    room = 0
    for choice, n in options.groupby("choice", sort=False).size().items():
        if n + 1 > room:
            pages.append([])
            room = most
        pages[-1].append(str(choice))
        room -= n + 1
    return pages


def choices(summary: pd.DataFrame, only: Sequence[str] | None = None) -> Figure:
    """A panel a choice and measure: what each option changes against the published one, mean and 95 % interval.

    Args:
        summary: of `study.evaluation.sensitivity.sensitivity_summary`.
        only: the choices to draw, see `choice_pages`; all when None.

    Raises:
        StudyError: no option beside the published ones.
    """
    columns = ("choice", "option", "role", "metric", "people", "failed", "published", "change", "low", "high")
    require_columns(summary, columns, "a sensitivity summary")
    listed = summary[summary["role"] != "paper"].drop_duplicates(["choice", "option"])
    require(listed, "options other than the published")
    names = [name for name in dict.fromkeys(listed["choice"]) if only is None or name in only]
    require(names, "choices")
    counts = [int((listed["choice"] == name).sum()) for name in names]
    people = int(summary["people"].max())
    figure = new_figure(
        1.9 + 0.2 * sum(counts) + 0.29 * len(names), f"What each choice changes ({people} synthetic pairs)"
    )
    grid = figure.subplots(
        len(names), len(_VIEWS), squeeze=False, sharex="col", height_ratios=[n + 0.5 for n in counts]
    )
    for row, name in enumerate(names):
        for ax, view in zip(grid[row], _VIEWS, strict=True):
            _draw_choice(ax, summary, name, view)
        published = summary.loc[(summary["choice"] == name) & (summary["role"] == "paper"), "option"].iloc[0]
        grid[row, 0].set_title(f"{name}: {published} →", fontsize=8.5, loc="left", pad=2.5)
    for column, view in enumerate(_VIEWS):
        _scale(grid[:, column], summary, view, names)
    marks: list[Any] = [Line2D([], [], ls="", marker=m, color=c, label=label) for label, c, m in _ROLE.values()]
    marks.append(Patch(color=_LUCK_COLOUR, label="other seeds of the published graph, 95 % interval"))
    marks.append(Line2D([], [], ls="", marker=">", color=GREY, mec="black", label="beyond the axis"))
    below(figure, marks, 4)
    return figure


def _of(summary: pd.DataFrame, view: tuple[str, str, float, str]) -> pd.DataFrame:
    rows = summary[(summary["metric"] == view[0]) & (summary["role"] != "paper")]
    return rows.assign(**{name: view[2] * rows[name] for name in ("change", "low", "high")})


def _draw_choice(ax: Axes, summary: pd.DataFrame, choice: str, view: tuple[str, str, float, str]) -> None:
    rows = _of(summary, view)
    luck = rows[rows["role"] == "yardstick"]
    if len(luck):
        ax.axvspan(luck["low"].iloc[0], luck["high"].iloc[0], color=_LUCK_COLOUR, lw=0, zorder=0)
    ax.axvline(0, color=DARK, lw=0.8)
    mine = rows[rows["choice"] == choice]
    for y, (_, one) in enumerate(mine.iterrows()):
        _, colour, marker = _ROLE.get(str(one["role"]), ("", DARK, "^"))
        ax.plot([one["low"], one["high"]], [y, y], color=colour, lw=1.8)
        ax.plot(one["change"], y, marker=marker, color=colour, ms=5, mec="black", mew=0.5)
    ax.set_ylim(len(mine) - 0.5, -0.5)
    first = view is _VIEWS[0]
    lost = [f" ({n} refused)" if n else "" for n in mine["failed"]]
    ax.set_yticks(range(len(mine)), [a + b for a, b in zip(mine["option"], lost, strict=True)] if first else [])
    ax.grid(axis="x", alpha=0.3)
    ax.tick_params(labelsize=7.5, length=2)
    ax.spines[["top", "right"]].set_visible(False)


def _scale(axes: Any, summary: pd.DataFrame, view: tuple[str, str, float, str], names: Sequence[str]) -> None:
    """One axis for a column, that a single wide option does not stretch, and the heading with the published mean."""
    metric, heading, factor, unit = view
    rows = _of(summary, view)
    end = max(float(np.nanpercentile(np.abs(rows["change"]), 85)) * 1.3, 0.02 * factor)
    for ax in axes:
        ax.set_xlim(-end, end)
    for choice, ax in zip(names, axes, strict=True):
        for y, change in enumerate(rows.loc[rows["choice"] == choice, "change"]):
            if abs(change) > end:
                side = np.sign(change)
                ax.plot(side * 0.93 * end, y, marker=">" if side > 0 else "<", ms=6, color=GREY, mec="black")
                at: dict[str, Any] = {"ha": "right" if side > 0 else "left", "va": "center", "fontsize": 7, "zorder": 6}
                at["bbox"] = {"fc": "white", "ec": "none", "pad": 0.6}
                ax.text(side * 0.8 * end, y, f"{change:+.1f}".replace("-", "−"), **at)
    value = factor * float(summary.loc[(summary["metric"] == metric) & (summary["role"] == "paper"), "mean"].iloc[0])
    axes[-1].set_xlabel(f"{heading} ({unit})\npublished: {value:.{1 if unit == '%' else 2}f}", fontsize=8)
