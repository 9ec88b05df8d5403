"""Pictures of differences: what a choice changes, what an error costs, one method against each other (sec. II, IV)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from study.evaluation.pair import in_order
from study.evaluation.statistics import population_sd
from study.figures.canvas import below, new_figure, plain, require, require_columns
from study.figures.rows import judged_by, method_row, name_rows, spread, stripe_rows
from study.figures.style import DARK, DATASET_STYLE, GREY, SIMULATED, MethodStyle, method_style
from study.types import Floats

__all__ = ["difference_rows", "error_budget", "paired_differences", "sensitivity", "way"]

_YARDSTICK_COLOUR = "#e8e8e8"


@dataclass(frozen=True)
class _Option:
    """A row of `sensitivity`: an option, what it is, and its differences to the published one, a case each."""

    label: str
    role: str
    differences: Floats

    @property
    def drawn(self) -> tuple[str, str, str]:
        """Label, colour and marker of its role."""
        known = {"authors": ("authors' code", "#CC3311", "s"), "alternative": ("alternative", "#0077BB", "o")}
        return known.get(self.role, (self.role, DARK, "^"))


def sensitivity(df: pd.DataFrame, *, note: str = SIMULATED) -> Figure:
    """What each choice changes: paired differences of the mean waypoint error to the published choice.

    A single option that changes much does not stretch the axis: what lies beyond it is an arrow and a number.

    Args:
        df: a row per case and option, columns ``choice``, ``option`` (its name), ``role`` (``paper``, ``authors``,
            ``alternative``, or ``yardstick``, whose spread is shaded over all rows), ``case`` (what is paired) and
            ``value`` (mean waypoint error, mm).
        note: where the patient is from.

    Raises:
        StudyError: a choice without its published option, or an option without a paired case.
    """
    options = _options(df)
    title = f"Change of the mean waypoint error against the published choice ({note})"
    figure = new_figure(1.6 + 0.52 * len(options), title)
    ax = figure.subplots()
    sizes = np.abs(np.concatenate([option.differences for option in options]))
    end = float(np.clip(np.percentile(sizes, 95), 0.5, 1.2))
    for y, option in enumerate(options):
        _draw_option(ax, y, option)
        _draw_beyond(ax, y, option, end)
    ax.axvline(0, color=DARK, lw=1)
    ax.set_xlim(-1.06 * end, 1.06 * end)
    name_rows(ax, [option.label for option in options])
    ax.set_xlabel("better ←  difference per case, mean ± SD (mm)  → worse", fontsize=9)
    ax.grid(axis="x", alpha=0.3)
    plain(ax)
    marks = dict.fromkeys(option.drawn for option in options)
    handles: list[Any] = [Line2D([], [], ls="", marker=m, color=colour, label=label) for label, colour, m in marks]
    if any(option.role == "yardstick" for option in options):
        handles.append(Patch(color=_YARDSTICK_COLOUR, label="yardstick, mean ± SD"))
    if (sizes > end).any():
        handles.append(Line2D([], [], ls="", marker=">", color=GREY, mec="black", label="cases beyond the axis"))
    below(figure, handles, 5)
    return figure


def _options(df: pd.DataFrame) -> list[_Option]:
    """Every option but the published, paired with it case by case."""
    columns = ("choice", "option", "role", "case", "value")
    require_columns(df, columns, "rows of choices, one a case and option")
    options = []
    for choice, rows in df.groupby("choice", sort=False):
        base = rows[rows["role"] == "paper"].set_index("case")["value"]
        require(base, f"the published option of {choice!r}")
        published = rows.loc[rows["role"] == "paper", "option"].iloc[0]
        for (option, role), other in rows[rows["role"] != "paper"].groupby(["option", "role"], sort=False):
            differences = (other.set_index("case")["value"] - base).dropna().to_numpy()
            require(differences, f"paired cases of {choice!r}: {option!r}")
            options.append(_Option(f"{choice}\n{published} → {option}", str(role), differences))
    require(options, "options other than the published")
    return options


def _draw_option(ax: Axes, y: float, option: _Option) -> None:
    """A dot a case, mean ± SD over them, and the mean in words."""
    _, colour, marker = option.drawn
    values = option.differences
    mean, sd = float(values.mean()), population_sd(values)
    ax.scatter(values, y + spread(len(values), 0.36), s=14, c=colour, alpha=0.45, lw=0)
    ax.errorbar(mean, y, xerr=sd, fmt=marker, color=colour, mec="black", ms=8, capsize=3)
    if option.role == "yardstick":
        ax.axvspan(mean - sd, mean + sd, color=_YARDSTICK_COLOUR, lw=0, zorder=0)
    text = f"{_signed(mean)} (n={len(values)})"
    ax.text(1.01, y, text, transform=ax.get_yaxis_transform(), va="center", fontsize=8)


def _draw_beyond(ax: Axes, y: float, option: _Option, end: float) -> None:
    """An arrow at either end of the axis for the cases beyond it, and how far they go."""
    for side in (-1, 1):
        cases = option.differences[side * option.differences > end]
        if len(cases):
            far = cases[np.argmax(np.abs(cases))]
            text = _signed(far) if len(cases) == 1 else f"{len(cases)} cases, to {_signed(far)}"
            ax.plot(side * end, y, marker="<>"[side > 0], ms=9, color=option.drawn[1], mec="black", zorder=5)
            at: dict[str, Any] = {"ha": "right" if side > 0 else "left", "va": "bottom", "fontsize": 7}
            ax.text(side * 1.05 * end, y - 0.2, text, zorder=6, **at)


def _signed(value: float) -> str:
    """Two decimals and a true minus sign; what rounds to 0 has none."""
    text = f"{value:+.2f}"
    return text.replace("-", "−") if float(text) else "0.00"


def error_budget(df: pd.DataFrame, *, note: str = SIMULATED) -> Figure:
    """What each error of the ultrasound does to the cloud and, a panel a family of methods, to the waypoints.

    Args:
        df: long, columns ``error`` (in the order to show), ``metric`` (``surface_distance`` of the
            cloud or ``waypoint_error``), ``method`` (ignored for the cloud) and ``value`` (mm); of several rows of one
            kind (seeds, patients) the range is a line about their mean.
        note: where the patient is from.

    Raises:
        StudyError: no row of either metric.
    """
    require_columns(df, ("error", "metric", "method", "value"), "rows of study.evaluation.error_budget")
    cloud, path = (df[df["metric"] == metric] for metric in ("surface_distance", "waypoint_error"))
    require(cloud, "rows of surface_distance")
    require(path, "rows of waypoint_error")
    errors = list(dict.fromkeys(df["error"]))
    families: dict[str, list[str]] = {}
    for method in in_order(path["method"]):
        families.setdefault(method_style(method).label.partition(",")[0], []).append(method)
    figure = new_figure(1.6 + 0.3 * len(errors), f"What each error of the ultrasound costs ({note})")
    panels = np.atleast_1d(figure.subplots(1, 1 + len(families), sharey=True))
    _strip(panels[0], errors, cloud, 0.0, MethodStyle("", DARK, "o", tuned=True))
    for ax, methods in zip(panels[1:], families.values(), strict=True):
        for k, method in enumerate(methods):
            aside = 0.4 * ((k + 0.5) / len(methods) - 0.5)
            _strip(ax, errors, path[path["method"] == method], aside, method_style(method))
        if ax is not panels[1]:
            ax.sharex(panels[1])
    for ax, title in zip(panels, ("the cloud itself", *families), strict=True):
        stripe_rows(ax, len(errors))
        ax.set_xlim(0, None)
        ax.grid(axis="x", alpha=0.3)
        plain(ax, title)
        ax.set_xlabel(
            "mean waypoint error (mm)" if ax is not panels[0] else "to the true surface, mean (mm)", fontsize=8
        )
    name_rows(panels[0], errors)
    looks = (("#ffffff", GREY, "pale: as published or shipped"), (GREY, "#000000", "solid: tuned"))
    marks = [Line2D([], [], ls="", marker="o", mfc=face, mec=edge, label=label) for face, edge, label in looks]
    below(figure, marks, 2)
    return figure


def _strip(ax: Axes, errors: Sequence[str], rows: pd.DataFrame, aside: float, style: MethodStyle) -> None:
    """The mean of each error's values as a marker, ``aside`` of its row, their range as a line."""
    for y, error in enumerate(errors):
        values = rows.loc[rows["error"] == error, "value"].dropna().to_numpy()
        if len(values) > 1:
            ax.plot([values.min(), values.max()], [y + aside] * 2, color=style.colour, lw=1.2, alpha=0.7)
        if len(values):
            look: dict[str, Any] = {"marker": style.marker, "fc": style.face, "ec": style.edge}
            ax.scatter(values.mean(), y + aside, s=34, lw=1.0, zorder=4, **look)


def difference_rows(df: pd.DataFrame, reference: str, *, note: str = SIMULATED) -> Figure:
    """One method minus every other with its interval over people: a panel a metric, a row a method, a colour a dataset.

    Args:
        df: rows of `study.evaluation.difference_intervals` with columns ``metric`` (a name in ``METRICS``), ``dataset``
            and ``against``, besides ``value``, ``low``, ``high`` (mm) and ``is_tie``.
        reference: the method compared.
        note: where the patients are from.

    Raises:
        StudyError: no difference.
    """
    require_columns(df, ("metric", "dataset", "against", "value", "low", "high", "is_tie"), "difference intervals")
    metrics, datasets = (list(dict.fromkeys(df[name])) for name in ("metric", "dataset"))
    methods = in_order(df["against"])
    label = method_style(reference).label
    figure = new_figure(1.6 + 0.34 * len(methods), f"{label} minus each other method; left of 0 it is better ({note})")
    panels = np.atleast_1d(figure.subplots(1, len(metrics), sharey=True))
    for ax, metric in zip(panels, metrics, strict=True):
        stripe_rows(ax, len(methods))
        for k, dataset in enumerate(datasets):
            colour, marker = DATASET_STYLE[k % len(DATASET_STYLE)]
            mine = df[(df["metric"] == metric) & (df["dataset"] == dataset)].set_index("against")
            for method, row in mine.iterrows():
                y = methods.index(str(method)) + 0.6 * ((k + 0.5) / len(datasets) - 0.5)
                ax.plot([row["low"], row["high"]], [y, y], color=colour, lw=1.4)
                ax.plot(row["value"], y, marker=marker, ms=5, mec=colour, mfc="white" if row["is_tie"] else colour)
        ax.axvline(0, color=DARK, lw=1)
        ax.grid(axis="x", alpha=0.3)
        plain(ax, fill(judged_by(metric), 28))
        ax.set_xlabel("mean and 95 % interval (mm)", fontsize=8)
    name_rows(panels[0], [method_style(method).label for method in methods])
    marks = [
        Line2D([], [], marker=marker, color=colour, label=dataset)
        for dataset, (colour, marker) in zip(datasets, DATASET_STYLE * len(datasets), strict=False)
    ]
    marks.append(Line2D([], [], ls="", marker="o", mfc="white", mec=DARK, label="hollow: a tie"))
    below(figure, marks, 4)
    return figure


def paired_differences(df: pd.DataFrame, reference: str, what: str, *, note: str = SIMULATED) -> Figure:
    """One method against each other on the same cases: a panel a dataset, a row a method, a dot a case.

    Args:
        df: columns ``dataset``, ``method`` (the other), ``difference`` (mm, ``reference`` minus the other, a row a
            case).
        reference: the method compared.
        what: what the difference is of: a name in ``METRICS``, or words for the title.
        note: where the patient is from.

    Raises:
        StudyError: no difference.
    """
    require_columns(df, ("dataset", "method", "difference"), "paired differences, a row a case")
    datasets, methods = list(dict.fromkeys(df["dataset"])), in_order(df["method"])
    label = method_style(reference).label
    figure = new_figure(1.6 + 0.36 * len(methods), f"{judged_by(what)}: {label} minus each other method ({note})")
    panels = np.atleast_1d(figure.subplots(1, len(datasets), sharex=True, sharey=True))
    for ax, dataset in zip(panels, datasets, strict=True):
        mine = df[df["dataset"] == dataset]
        stripe_rows(ax, len(methods))
        for y, method in enumerate(methods):
            values = mine.loc[mine["method"] == method, "difference"].dropna().to_numpy()
            method_row(ax, y, values, method)
        ax.axvline(0, color=DARK, lw=1)
        ax.grid(axis="x", alpha=0.3)
        plain(ax, f"{dataset}, n = {mine.groupby('method').size().max()} cases")
        ax.set_xlabel("difference (mm)", fontsize=8)
    how = f"{label} better ←  → worse.  Dot: a case; bar: mean ± population SD over cases"
    figure.supxlabel(how, fontsize=8, color=DARK)
    name_rows(panels[0], [method_style(method).label for method in methods])
    return figure


def way(df: pd.DataFrame, *, note: str = SIMULATED) -> Figure:
    """Step by step from one method to another: a row a step, the error of each pair and their mean, joined downwards.

    Args:
        df: columns ``change``, ``case`` and ``true`` (mean true waypoint error, mm), steps in their order; ``in_plane``
            where it is known.
        note: where the patient is from.

    Raises:
        StudyError: no step.
    """
    require_columns(df, ("change", "case", "true"), "steps, a row a step and case")
    changes = list(dict.fromkeys(df["change"]))
    figure = new_figure(1.5 + 0.36 * len(changes), f"Mean true waypoint error, step by step ({note})")
    ax = figure.subplots()
    stripe_rows(ax, len(changes))
    for column, colour, marker, label in (
        ("true", "#0077BB", "o", "in space"),
        ("in_plane", "#EE7733", "s", "in plane"),
    ):
        if column not in df:
            continue
        means = df.groupby("change", sort=False)[column].mean()
        ax.plot(means, range(len(changes)), color=colour, lw=1, zorder=2)
        ax.scatter(means, range(len(changes)), c=colour, marker=marker, s=42, zorder=3, label=f"{label}, mean")
        rows = [changes.index(change) + 0.22 for change in df["change"]]
        ax.scatter(df[column], rows, c=colour, s=8, alpha=0.6, lw=0, zorder=3)
    name_rows(ax, [change if k == 0 else f"+ {change}" for k, change in enumerate(changes)])
    ax.set_xlim(left=0)
    ax.set_xlabel("mm; small dots: single pairs", fontsize=8)
    ax.legend(fontsize=8, loc="lower right")
    ax.grid(axis="x", alpha=0.3)
    plain(ax)
    return figure
