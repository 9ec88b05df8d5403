"""Pictures of errors per CT and method: the paper's Fig. 4b, Table I as bars, several judges side by side (sec. IV)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.evaluation.pair import in_order
from study.evaluation.statistics import population_sd
from study.figures.canvas import method_legend, new_figure, plain, require, require_columns
from study.figures.rows import method_row, name_rows, spread, stripe_rows
from study.figures.style import DARK, PAPER, SIMULATED, method_style
from study.naming import natural_key
from study.types import Floats

__all__ = ["error_views", "hd_bars", "waypoint_boxes"]

_SMALL: dict[str, Any] = {"rotation": 90, "ha": "center", "fontsize": 7}  # numbers and words that stand in a column


@dataclass(frozen=True)
class _Cases:
    """What is known of one metric: a column a CT and a method.

    Attributes:
        values: rows with a finite value.
        failures: rows of failed cases.
        sources: the CTs, ct2 before ct10.
        methods: in the order of the legend.
    """

    values: pd.DataFrame
    failures: pd.DataFrame
    sources: list[str]
    methods: list[str]

    def of(self, source: str, method: str) -> Floats:
        """Values of one CT and method, in the order of the rows."""
        mine = (self.values["source"] == source) & (self.values["method"] == method)
        return self.values.loc[mine, "value"].to_numpy(dtype=np.float64)

    def failed(self, source: str, method: str) -> bool:
        """Whether that method failed on that CT while another did not."""
        mine = (self.failures["source"] == source) & (self.failures["method"] == method)
        return bool(mine.any()) and not self.all_failed(source)

    def all_failed(self, source: str) -> bool:
        """Whether no method gave a value on that CT."""
        return source in set(self.failures["source"]) - set(self.values["source"])


def _cases(metrics: pd.DataFrame, metric: str) -> _Cases:
    columns = ("dataset", "source", "method", "metric", "value", "status")
    require_columns(metrics, columns, "metrics as study.results.read_metrics gives them")
    if metrics["dataset"].nunique() != 1:
        raise StudyError(f"expected rows of one dataset, got {sorted(metrics['dataset'].unique())}; select one")
    values = metrics[(metrics["metric"] == metric) & np.isfinite(metrics["value"])]
    require(values, f"rows of metric {metric!r}")
    failures = metrics[metrics["status"].astype(str).str.startswith("failed")]
    both = pd.concat([values, failures])
    return _Cases(values, failures, sorted(both["source"].unique(), key=natural_key), in_order(both["method"]))


def waypoint_boxes(
    metrics: pd.DataFrame,
    metric: str = "waypoint_error",
    *,
    paper: pd.DataFrame | None = None,
    note: str = SIMULATED,
) -> Figure:
    """The paper's Fig. 4b: waypoint errors per CT and method, every waypoint a dot.

    Args:
        metrics: rows of one dataset, as `study.results.read_metrics` gives them; targets and seeds are pooled.
        metric: any metric of waypoints.
        paper: index method, columns ``mean`` and ``sd``: hollow markers of a last group.
        note: where the patient is from.

    Raises:
        StudyError: several datasets, or no value of that metric.
    """
    cases = _cases(metrics, metric)
    groups = [*cases.sources, *([PAPER] if paper is not None else [])]
    n_rows = -(-len(groups) * (len(cases.methods) + 1) // 48)
    per_row = -(-len(groups) // n_rows)
    figure = new_figure(1.1 + 3.2 * n_rows, f"Waypoints carried from each CT to the patient ({note})")
    panels = figure.subplots(n_rows, 1, squeeze=False, sharey=True).ravel()
    sizes = cases.values.groupby(["source", "method"]).size()
    even = sizes.nunique() == 1
    top = _highest(cases, paper) * (1.05 if even and cases.failures.empty else 1.2)  # room for words above the boxes
    for ax, start in zip(panels, range(0, len(groups), per_row), strict=False):
        here = groups[start : start + per_row]
        for group, places in zip(here, _groups(ax, here, len(cases.methods), per_row), strict=True):
            if paper is not None and group == PAPER:
                _paper_points(ax, places, cases.methods, paper)
            else:
                _source_boxes(ax, places, cases, group, counted=not even)
        _error_axis(ax, metric, top)
        plain(ax)
    every = f"n = {sizes.iloc[0]} waypoints a box" if even else "n: waypoints of a box"
    panels[0].set_title(every, fontsize=9.5, loc="left")
    median = Line2D([], [], ls="", marker="_", ms=9, mew=2, color="black", label="median")
    method_legend(figure, cases.methods, [median, *_paper_handles(paper)])
    return figure


def _source_boxes(ax: Axes, places: Floats, cases: _Cases, source: str, *, counted: bool) -> None:
    """The boxes of one CT, a method each, with their number of waypoints if ``counted``; or that they failed."""
    if cases.all_failed(source):
        _say_all_failed(ax, places)
        return
    for x, method in zip(places, cases.methods, strict=True):
        values, colour = cases.of(source, method), method_style(method).colour
        if len(values):
            _box(ax, x, values, method)
        text = "failed" if cases.failed(source, method) and not len(values) else f"n={len(values)}" if counted else ""
        if text:
            ax.text(x, 0.985, text, transform=ax.get_xaxis_transform(), va="top", color=colour, **_SMALL)


def _box(ax: Axes, x: float, values: Floats, method: str) -> None:
    style = method_style(method)
    drawn = ax.boxplot([values], positions=[x], widths=0.72, showfliers=False, patch_artist=True, manage_ticks=False)
    drawn["boxes"][0].set(facecolor=style.face, edgecolor=style.edge, hatch=style.hatch, linewidth=1.1)
    drawn["medians"][0].set(color="white" if max(style.face) < 0.3 else "black", linewidth=1.8)
    for line in (*drawn["whiskers"], *drawn["caps"]):
        line.set(color=style.colour, linewidth=1.1)
    ax.scatter(x + spread(len(values), 0.5), values, s=7, c=DARK, alpha=0.65, lw=0, zorder=4, rasterized=True)


def hd_bars(
    metrics: pd.DataFrame, metric: str = "hd", *, paper: pd.DataFrame | None = None, note: str = SIMULATED
) -> Figure:
    """Table I as bars: a metric per CT and method, then mean ± population SD over the CTs.

    Args:
        metrics: rows of one dataset; several values of a CT (targets, seeds) are averaged, and shown as dots.
        metric: one of ``METRICS``.
        paper: index method, columns ``mean`` and ``sd``: hollow markers beside the mean bars.
        note: where the patient is from.

    Raises:
        StudyError: several datasets, or no value of that metric.
    """
    cases = _cases(metrics, metric)
    figure = new_figure(4.4, f"{_title(metric)} ({note})")
    names = [*cases.sources, "mean ± SD", *([PAPER] if paper is not None else [])]
    ax = figure.subplots()
    places = _groups(ax, names, len(cases.methods), len(names))
    for row, source in zip(places, cases.sources, strict=False):
        if cases.all_failed(source):
            _say_all_failed(ax, row)
    high = _highest(cases, paper)
    n = len(cases.sources)
    for column, method in enumerate(cases.methods):
        means = _source_bars(ax, places[:n, column], cases, method)
        if means:
            high = max(high, _mean_bar(ax, places[n, column], means, n, method))
    if paper is not None:
        _paper_points(ax, places[-1], cases.methods, paper)
    _error_axis(ax, metric, high / 0.68)  # the numbers stand above everything else
    ax.set_axisbelow(True)
    plain(ax, f"SD: population, over n = {n} columns")
    method_legend(figure, cases.methods, _paper_handles(paper))
    return figure


def _bar_style(method: str) -> dict[str, Any]:
    style = method_style(method)
    return {"width": 0.86, "fc": style.face, "ec": style.edge, "hatch": style.hatch, "lw": 1.0}


def _source_bars(ax: Axes, places: Floats, cases: _Cases, method: str) -> list[float]:
    """A bar a CT, the mean of its values, which are dots if there are several; returns the means."""
    means: list[float] = []
    for x, source in zip(places, cases.sources, strict=True):
        values = cases.of(source, method)
        if len(values):
            means.append(values.mean())
            ax.bar(x, means[-1], **_bar_style(method))
        elif cases.failed(source, method):
            ax.text(x, 0, " failed", va="bottom", color=method_style(method).colour, **_SMALL)
        if len(values) > 1:
            ax.scatter(np.full(len(values), x), values, s=7, c=DARK, lw=0, zorder=4)
    return means


def _mean_bar(ax: Axes, x: float, means: Sequence[float], n_sources: int, method: str) -> float:
    """Mean ± SD over the CTs, its numbers at the top; returns the tip of the whisker."""
    mean, sd = float(np.mean(means)), population_sd(means)
    ax.bar(x, mean, yerr=sd, error_kw={"lw": 1.1, "capsize": 2.5}, **_bar_style(method))
    text = f"{mean:.2f}±{sd:.2f}" + ("" if len(means) == n_sources else f", n={len(means)}")
    ax.text(x, 0.985, text, transform=ax.get_xaxis_transform(), va="top", **_SMALL)
    return mean + sd


def error_views(metrics: pd.DataFrame, views: Sequence[str], *, note: str = SIMULATED) -> Figure:
    """The same transferred waypoints, judged in several ways: a panel a metric, a row a method.

    Args:
        metrics: rows of one dataset, as `study.results.read_metrics` gives them.
        views: metrics of waypoints, in the order of the panels; one the dataset does not have is left out.
        note: where the patient is from.

    Raises:
        StudyError: several datasets, or none of the metrics.
    """
    columns = ("dataset", "source", "target", "method", "seed", "metric", "value")
    require_columns(metrics, columns, "metrics as study.results.read_metrics gives them")
    known = [view for view in views if view in set(metrics["metric"])]
    require(known, f"rows of a metric among {', '.join(views)}")
    methods = _cases(metrics, known[0]).methods
    pairs = metrics[metrics["metric"].isin(known)].groupby(["source", "target", "seed", "method", "metric"])["value"]
    means = pairs.mean().reset_index()
    figure = new_figure(1.6 + 0.34 * len(methods), f"The same waypoints, judged in {len(known)} ways ({note})")
    panels = np.atleast_1d(figure.subplots(1, len(known), sharex=True, sharey=True))
    for ax, view in zip(panels, known, strict=True):
        stripe_rows(ax, len(methods))
        for y, method in enumerate(methods):
            mine = (means["metric"] == view) & (means["method"] == method)
            values = means.loc[mine, "value"].to_numpy(dtype=np.float64)
            method_row(ax, y, values, method, zorder=4)
            if len(values):
                at: dict[str, Any] = {"transform": ax.get_yaxis_transform(), "ha": "right", "va": "center"}
                ax.text(0.99, y - 0.08, f"{values.mean():.1f}", fontsize=8, **at)
        ax.grid(axis="x", alpha=0.3)
        plain(ax, _title(view).replace(" in the feature plane", ",\nin the feature plane"))
        ax.set_xlabel("mean waypoint error of a pair (mm)", fontsize=8)
    figure.supxlabel("dot: a pair; bar: mean ± population SD over pairs; number: that mean", fontsize=8, color=DARK)
    # Room for the means that are written at the right.
    panels[0].set_xlim(0, 1.28 * float(means["value"].max()))
    name_rows(panels[0], [method_style(method).label for method in methods])
    return figure


def _title(metric: str) -> str:
    return METRICS[metric].title if metric in METRICS else metric


def _error_axis(ax: Axes, metric: str, top: float) -> None:
    """The metric and its unit up the page, from 0."""
    unit = f" ({METRICS[metric].unit})" if metric in METRICS else ""
    ax.set_ylabel(f"{_title(metric)}{unit}", fontsize=9)
    ax.set_ylim(0, top)
    ax.grid(axis="y", alpha=0.3)


def _groups(ax: Axes, names: Sequence[str], n_methods: int, n_groups: int) -> Floats:
    """Shade every other group and name it, with room for ``n_groups``; returns positions (group, method)."""
    width = n_methods + 1.2
    starts = np.arange(len(names)) * width
    for k in range(0, len(names), 2):
        ax.axvspan(starts[k] - 1.1, starts[k] + n_methods + 0.1, color="#f3f3f3", lw=0, zorder=0)
    ax.set_xticks(starts + (n_methods - 1) / 2, names)
    ax.tick_params(axis="x", length=0)
    ax.set_xlim(-1.1, n_groups * width - 1.1)
    return np.asarray(starts[:, None] + np.arange(n_methods), dtype=np.float64)


def _say_all_failed(ax: Axes, places: Floats) -> None:
    middle = float(places.mean())
    ax.text(middle, 0.03, "failed", transform=ax.get_xaxis_transform(), ha="center", fontsize=8, color=DARK)


def _paper_points(ax: Axes, places: Floats, methods: Sequence[str], paper: pd.DataFrame) -> None:
    """The paper's mean ± SD, a hollow marker each of the methods it has."""
    for x, method in zip(places, methods, strict=True):
        if method in paper.index:
            style = method_style(method)
            mean, sd = paper.loc[[method], ["mean", "sd"]].to_numpy(dtype=np.float64)[0]
            line: dict[str, Any] = {"fmt": style.marker, "mfc": "white", "mec": style.colour, "mew": 1.4, "ms": 7}
            ax.errorbar(x, mean, sd, ecolor=style.colour, capsize=3, zorder=5, **line)


def _paper_handles(paper: pd.DataFrame | None) -> list[Line2D]:
    hollow = Line2D([], [], ls="", marker="o", mfc="white", color=DARK, label=f"{PAPER}: mean ± SD")
    return [hollow] if paper is not None else []


def _highest(cases: _Cases, paper: pd.DataFrame | None) -> float:
    """The largest value to show, the tip of the paper's markers included."""
    rows: list[float] = []
    if paper is not None:
        rows = paper.loc[paper.index.isin(cases.methods), ["mean", "sd"]].sum(axis=1).tolist()
    return float(max([cases.values["value"].max(), *rows]))
