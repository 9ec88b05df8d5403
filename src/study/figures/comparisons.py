"""Pictures of differences: what a choice changes, what an error costs, one method against each other (sec. II, IV)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from study.figures.rows import method_row, name_rows, spread, stripe_rows
from study.figures.style import DARK, GREY, SIMULATED, MethodStyle, method_style
from study.types import Floats

__all__ = ["error_budget", "paired_differences", "sensitivity", "way"]

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
    """What each error of the ultrasound does to the cloud and, by method, to the waypoints.

    Args:
        df: long, columns ``error`` (in the order to show), ``metric`` (``surface_distance`` of the
            cloud or ``waypoint_error``), ``method`` (ignored for the cloud) and ``value`` (mm); several rows of one
            kind (seeds, patients) are dots about their mean.
        note: where the patient is from.

    Raises:
        StudyError: no row of either metric.
    """
    require_columns(df, ("error", "metric", "method", "value"), "rows of study.evaluation.error_budget")
    cloud, path = (df[df["metric"] == metric] for metric in ("surface_distance", "waypoint_error"))
    require(cloud, "rows of surface_distance")
    require(path, "rows of waypoint_error")
    errors, methods = list(dict.fromkeys(df["error"])), in_order(path["method"])
    figure = new_figure(1.5 + 0.46 * len(errors), f"What each error of the ultrasound costs ({note})")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=[1, 1.9])
    _strip(left, errors, cloud, 0.0, MethodStyle("", DARK, "o", tuned=True))
    for k, method in enumerate(methods):
        style = method_style(method)
        aside = 0.62 * ((k + 0.5) / len(methods) - 0.5)
        _strip(right, errors, path[path["method"] == method], aside, style)
    for ax, title in ((left, "cloud to the true surface, mean (mm)"), (right, "mean waypoint error (mm)")):
        stripe_rows(ax, len(errors))
        ax.set_xlabel(title, fontsize=9)
        ax.set_xlim(0, None)
        ax.grid(axis="x", alpha=0.3)
        plain(ax)
    name_rows(left, errors)
    styles = [method_style(method) for method in methods]
    marks = [Line2D([], [], ls="", marker=s.marker, mfc=s.face, mec=s.edge, label=s.label) for s in styles]
    below(figure, marks, min(5, len(marks)))
    return figure


def _strip(ax: Axes, errors: Sequence[str], rows: pd.DataFrame, aside: float, style: MethodStyle) -> None:
    """The mean of each error's values as a marker, ``aside`` of its row, their range as a line."""
    for y, error in enumerate(errors):
        values = rows.loc[rows["error"] == error, "value"].dropna().to_numpy()
        if len(values) > 1:
            ax.plot([values.min(), values.max()], [y + aside] * 2, color=style.colour, lw=1, alpha=0.6)
            ax.scatter(values, np.full(len(values), y + aside), s=6, c=style.colour, lw=0, alpha=0.6)
        if len(values):
            look: dict[str, Any] = {"marker": style.marker, "fc": style.face, "ec": style.edge}
            ax.scatter(values.mean(), y + aside, s=38, lw=1.1, zorder=4, **look)


def paired_differences(df: pd.DataFrame, reference: str, what: str, *, note: str = SIMULATED) -> Figure:
    """One method against each other on the same cases: a panel a dataset, a row a method, a dot a case.

    Args:
        df: columns ``dataset``, ``method`` (the other), ``difference`` (mm, ``reference`` minus the other, a row a
            case).
        reference: the method compared.
        what: what the difference is of, for the title.
        note: where the patient is from.

    Raises:
        StudyError: no difference.
    """
    require_columns(df, ("dataset", "method", "difference"), "paired differences, a row a case")
    datasets, methods = list(dict.fromkeys(df["dataset"])), in_order(df["method"])
    label = method_style(reference).label
    figure = new_figure(1.6 + 0.36 * len(methods), f"{what}: {label} minus each other method ({note})")
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
