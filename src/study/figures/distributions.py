"""Pictures of errors per CT and method: the paper's Fig. 4b, Table I as dots, several judges side by side (sec. IV)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.evaluation.pair import in_order
from study.evaluation.statistics import population_sd
from study.figures.canvas import StudyFigure, new_figure, plain, require, require_columns
from study.figures.rows import judged_by, method_row, name_rows, spread, stripe_rows
from study.figures.style import DARK, PAPER, SIMULATED, lighter, method_style
from study.naming import natural_key
from study.types import Floats

__all__ = ["error_views", "hd_dots", "waypoint_boxes"]

_PANELS_A_ROW = 6


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
    """The paper's Fig. 4b: waypoint errors, a panel a CT, a row a method, every waypoint a dot in its box.

    Args:
        metrics: rows of one dataset, as `study.results.read_metrics` gives them; targets and seeds are pooled.
        metric: any metric of waypoints.
        paper: index method, columns ``mean`` and ``sd``: hollow markers of a last panel, beside mean ± SD of ours.
        note: where the patient is from.

    Raises:
        StudyError: several datasets, or no value of that metric.
    """
    cases = _cases(metrics, metric)
    title = f"Waypoints carried from each CT to the patient: {judged_by(metric)} ({note})"
    figure, panels = _small_multiples(cases, title)
    for ax, source in zip(panels, cases.sources, strict=False):
        for y, method in enumerate(cases.methods):
            values = cases.of(source, method)
            if len(values):
                _box(ax, y, values, method)
            _say_failed(ax, y, cases, source, method)
        _error_axis(ax, metric, _n_waypoints(cases, source))
    pooled = {name: np.concatenate([cases.of(source, name) for source in cases.sources]) for name in cases.methods}
    _mean_panel(panels[len(cases.sources)], cases, pooled, paper, metric)
    _end(panels, cases, paper)
    what = "box: quartiles, bar: median; dot: a waypoint. Last panel: mean ± population SD over all waypoints"
    figure.supxlabel(what + _paper_words(paper), fontsize=8, color=DARK)
    return figure


def _n_waypoints(cases: _Cases, source: str) -> str:
    """``n = 20``, or the range of counts where methods lost some."""
    sizes = {len(values) for method in cases.methods if len(values := cases.of(source, method))}
    return f"n = {'-'.join(str(n) for n in sorted({min(sizes), max(sizes)}))}" if sizes else ""


def _box(ax: Axes, y: float, values: Floats, method: str) -> None:
    style = method_style(method)
    plot: dict[str, Any] = {"showfliers": False, "patch_artist": True, "manage_ticks": False}
    drawn = ax.boxplot([values], positions=[y], widths=0.66, orientation="horizontal", **plot)
    drawn["boxes"][0].set(facecolor=lighter(style.colour, 0.35 if style.tuned else 0.72), edgecolor=style.edge, lw=0.9)
    drawn["medians"][0].set(color="black", linewidth=1.8)
    for line in (*drawn["whiskers"], *drawn["caps"]):
        line.set(color=style.colour, linewidth=0.9)
    ax.scatter(values, y + spread(len(values), 0.5), s=5, c=DARK, alpha=0.6, lw=0, zorder=4, rasterized=True)


def hd_dots(
    metrics: pd.DataFrame, metric: str = "hd", *, paper: pd.DataFrame | None = None, note: str = SIMULATED
) -> Figure:
    """Table I as dots: a panel a CT, a row a method, then mean ± population SD over the CTs.

    Args:
        metrics: rows of one dataset; several values of a CT (targets, seeds) are averaged, and shown as small dots.
        metric: one of ``METRICS``.
        paper: index method, columns ``mean`` and ``sd``: hollow markers beside the means.
        note: where the patient is from.

    Raises:
        StudyError: several datasets, or no value of that metric.
    """
    cases = _cases(metrics, metric)
    figure, panels = _small_multiples(cases, f"{judged_by(metric)} ({note})")
    means: dict[str, list[float]] = {method: [] for method in cases.methods}
    for ax, source in zip(panels, cases.sources, strict=False):
        for y, method in enumerate(cases.methods):
            values = cases.of(source, method)
            if len(values):
                means[method].append(float(values.mean()))
                _marker(ax, y, means[method][-1], method)
            if len(values) > 1:
                ax.scatter(values, np.full(len(values), y), s=6, c=DARK, alpha=0.6, lw=0, zorder=4)
            _say_failed(ax, y, cases, source, method)
        _error_axis(ax, metric)
    _mean_panel(panels[len(cases.sources)], cases, means, paper, metric)
    _end(panels, cases, paper)
    what = f"Last panel: mean ± population SD over n = {len(cases.sources)} columns"
    figure.supxlabel(what + _paper_words(paper), fontsize=8, color=DARK)
    return figure


def _small_multiples(cases: _Cases, title: str) -> tuple[StudyFigure, list[Axes]]:
    """A panel a CT and one for their means, as many as fit beside each other; rows are methods."""
    names = [*cases.sources, "mean ± SD"]
    rows = -(-len(names) // _PANELS_A_ROW)
    columns = -(-len(names) // rows)
    figure = new_figure(1.1 + rows * (0.75 + 0.25 * len(cases.methods)), title)
    panels = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel())
    for ax in panels[len(names) :]:
        ax.set_axis_off()
    for ax, name in zip(panels, names, strict=False):
        stripe_rows(ax, len(cases.methods))
        plain(ax, name)
        ax.grid(axis="x", alpha=0.3)
    return figure, panels[: len(names)]


def _marker(ax: Axes, y: float, value: float, method: str, **bar: Any) -> None:
    """A value in the method's style; ``xerr`` and the like go to the error bar."""
    style = method_style(method)
    look: dict[str, Any] = {"mfc": style.face, "mec": style.edge, "ecolor": style.colour, "ms": 6.5, "capsize": 2.5}
    ax.errorbar(value, y, fmt=style.marker, zorder=3, **(look | bar))


def _mean_panel(
    ax: Axes, cases: _Cases, values: Mapping[str, Sequence[float] | Floats], paper: pd.DataFrame | None, metric: str
) -> None:
    """Mean ± SD of each method's values with its numbers, and the paper's hollow."""
    for y, (method, mine) in enumerate(values.items()):
        if len(mine):
            mean, sd = float(np.mean(mine)), population_sd(mine)
            _marker(ax, y - 0.12, mean, method, xerr=sd)
            at: dict[str, Any] = {"va": "center", "transform": ax.get_yaxis_transform(), "fontsize": 7.5}
            short = "" if len(mine) == max(map(len, values.values())) else f", n={len(mine)}"
            ax.text(1.03, y, f"{mean:.2f} ± {sd:.2f}{short}", **at)
        if paper is not None and method in paper.index:
            mean, sd = paper.loc[[method], ["mean", "sd"]].to_numpy(dtype=np.float64)[0]
            _marker(ax, y + 0.26, mean, method, xerr=sd, mfc="white", mec=method_style(method).colour, mew=1.3, ms=5)
    _error_axis(ax, metric)


def _paper_words(paper: pd.DataFrame | None) -> str:
    return f"; hollow: {PAPER}, mean ± SD" if paper is not None else ""


def _say_failed(ax: Axes, y: float, cases: _Cases, source: str, method: str) -> None:
    """A case that failed says so in its row; where all did, the middle row says it once."""
    text = "failed" if cases.failed(source, method) and not len(cases.of(source, method)) else ""
    if cases.all_failed(source) and method == cases.methods[len(cases.methods) // 2]:
        text = "all failed"
    if text:
        ax.text(0.03, y, text, transform=ax.get_yaxis_transform(), va="center", color=DARK, fontsize=7.5)


def _end(panels: Sequence[Axes], cases: _Cases, paper: pd.DataFrame | None) -> None:
    """Names at the left, one scale from 0."""
    name_rows(panels[0], [method_style(method).label for method in cases.methods])
    panels[0].set_xlim(0, 1.06 * _highest(cases, paper))


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
        plain(ax, fill(judged_by(view), 30))
        ax.set_xlabel("mean waypoint error of a pair (mm)", fontsize=8)
    figure.supxlabel("dot: a pair; bar: mean ± population SD over pairs; number: that mean", fontsize=8, color=DARK)
    # Room for the means that are written at the right.
    panels[0].set_xlim(0, 1.28 * float(means["value"].max()))
    name_rows(panels[0], [method_style(method).label for method in methods])
    return figure


def _error_axis(ax: Axes, metric: str, words: str = "") -> None:
    """The unit across the page, and how much is behind it."""
    unit = METRICS[metric].unit if metric in METRICS else ""
    ax.set_xlabel(f"{unit}{'; ' * bool(words)}{words}", fontsize=8)


def _highest(cases: _Cases, paper: pd.DataFrame | None) -> float:
    """The largest value to show, the tip of the paper's markers included."""
    rows: list[float] = []
    if paper is not None:
        rows = paper.loc[paper.index.isin(cases.methods), ["mean", "sd"]].sum(axis=1).tolist()
    return float(max([cases.values["value"].max(), *rows]))
