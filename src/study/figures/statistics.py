"""Pictures of numbers: errors per CT and method, choices, the error budget (sec. IV)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from study.errors import StudyError
from study.figures.style import (
    DARK,
    GREY,
    PAPER,
    SIMULATED,
    below,
    in_order,
    method_legend,
    method_style,
    new_figure,
    plain,
    require,
)
from study.metrics import METRICS, population_sd
from study.types import (
    Floats,
)


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key that puts ct2 before ct10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _table(df: pd.DataFrame, columns: Sequence[str], what: str) -> pd.DataFrame:
    missing = [column for column in columns if column not in df.columns]
    if missing:
        raise StudyError(f"expected a table with {', '.join(columns)}, got none of {', '.join(missing)}; see {what}")
    require(df, what)
    return df


def _cases(df: pd.DataFrame, metric: str) -> tuple[pd.DataFrame, pd.DataFrame, list[str], list[str]]:
    """Rows of a metric, rows of failed cases, subjects, methods."""
    _table(df, ("dataset", "subject", "method", "metric", "value", "status"), "rows of metrics.csv")
    if df["dataset"].nunique() != 1:
        raise StudyError(f"expected rows of one dataset, got {sorted(df['dataset'].unique())}; select one")
    chosen = df[(df["metric"] == metric) & np.isfinite(df["value"])]
    require(chosen, f"rows of metric {metric!r}")
    failed = df[df["status"].astype(str).str.startswith("failed")]
    both = pd.concat([chosen, failed])
    return chosen, failed, sorted(both["subject"].unique(), key=_natural), in_order(both["method"])


def _metric_label(metric: str) -> str:
    return f"{METRICS[metric].title} ({METRICS[metric].unit})" if metric in METRICS else f"{metric} (mm)"


def _signed(value: float) -> str:
    """Two decimals and a true minus sign; what rounds to 0 has none."""
    text = f"{value:+.2f}"
    return text.replace("-", "−") if float(text) else "0.00"


def _all_failed(ax: Axes, middle: float) -> None:
    ax.text(middle, 0.03, "failed", transform=ax.get_xaxis_transform(), ha="center", fontsize=8, color=DARK)


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


def _paper_point(ax: Axes, x: float, method: str, paper: pd.DataFrame) -> None:
    if method in paper.index:
        style = method_style(method)
        mean, sd = paper.loc[[method], ["mean", "sd"]].to_numpy(dtype=np.float64)[0]
        line: dict[str, Any] = {"fmt": style.marker, "mfc": "white", "mec": style.colour, "mew": 1.4, "ms": 7}
        ax.errorbar(x, mean, sd, ecolor=style.colour, capsize=3, zorder=5, **line)


def _highest(values: pd.Series, methods: Sequence[str], paper: pd.DataFrame | None) -> float:
    """The largest value to show, the tip of the paper's markers included."""
    rows = [] if paper is None else paper.loc[paper.index.isin(methods), ["mean", "sd"]].sum(axis=1).tolist()
    return float(max([values.max(), *rows]))


def waypoint_boxes(
    metrics: pd.DataFrame,
    metric: str = "waypoint_error",
    *,
    paper: pd.DataFrame | None = None,
    note: str = SIMULATED,
) -> Figure:
    """The paper's Fig. 4b: waypoint errors per CT and method, every waypoint a dot.

    Args:
        metrics: rows of one dataset, as ``results.read_metrics`` gives them; targets and seeds are pooled.
        metric: any metric of waypoints.
        paper: index method, columns ``mean`` and ``sd``: hollow markers of a last group.
        note: where the patient is from.

    Raises:
        StudyError: several datasets, or no value of that metric.
    """
    chosen, failed, subjects, methods = _cases(metrics, metric)
    names = [*subjects, *([PAPER] if paper is not None else [])]
    n_rows = -(-len(names) * (len(methods) + 1) // 48)
    per_row = -(-len(names) // n_rows)
    figure = new_figure(1.1 + 3.2 * n_rows, f"Waypoints carried from each CT to the patient ({note})")
    panels = figure.subplots(n_rows, 1, squeeze=False, sharey=True).ravel()
    sizes = chosen.groupby(["subject", "method"]).size()
    even = sizes.nunique() == 1
    high = _highest(chosen["value"], methods, paper)
    for ax, start in zip(panels, range(0, len(names), per_row), strict=False):
        here = names[start : start + per_row]
        places = _groups(ax, here, len(methods), per_row)
        for row, subject in zip(places, here, strict=True):
            nothing = subject in set(failed["subject"]) and subject not in set(chosen["subject"])
            if nothing:
                _all_failed(ax, float(row.mean()))
            for x, method in zip(row, methods, strict=True):
                if subject == PAPER and paper is not None:
                    _paper_point(ax, x, method, paper)
                    continue
                mine = chosen[(chosen["subject"] == subject) & (chosen["method"] == method)]
                values = mine["value"].to_numpy()
                lost = not nothing and bool(((failed["subject"] == subject) & (failed["method"] == method)).any())
                _box(
                    ax,
                    x,
                    values,
                    method,
                    "failed" if lost and not len(values) else "" if even or nothing else f"n={len(values)}",
                )
        ax.set_ylabel(_metric_label(metric), fontsize=9)
        ax.set_ylim(0, high * (1.05 if even and failed.empty else 1.2))
        ax.grid(axis="y", alpha=0.3)
        plain(ax)
    panels[0].set_title(
        f"n = {sizes.iloc[0]} waypoints a box" if even else "n: waypoints of a box", fontsize=9.5, loc="left"
    )
    dot = Line2D([], [], ls="", marker="_", ms=9, mew=2, color="black", label="median")
    hollow = Line2D([], [], ls="", marker="o", mfc="white", color=DARK, label=f"{PAPER}: mean ± SD")
    method_legend(figure, methods, [dot, hollow] if paper is not None else [dot])
    return figure


def _box(ax: Axes, x: float, values: Floats, method: str, text: str) -> None:
    style = method_style(method)
    if len(values):
        drawn = ax.boxplot(
            [values], positions=[x], widths=0.72, showfliers=False, patch_artist=True, manage_ticks=False
        )
        drawn["boxes"][0].set(facecolor=style.face, edgecolor=style.colour, hatch=style.hatch, linewidth=1.1)
        drawn["medians"][0].set(color="white" if max(style.face) < 0.3 else "black", linewidth=1.8)
        for line in (*drawn["whiskers"], *drawn["caps"]):
            line.set(color=style.colour, linewidth=1.1)
        aside = ((np.arange(len(values)) * 0.618) % 1 - 0.5) * 0.5  # even, and the same every time
        ax.scatter(x + aside, values, s=7, c=DARK, alpha=0.65, lw=0, zorder=4, rasterized=True)
    if text:
        high = ax.get_xaxis_transform()
        ax.text(x, 0.985, text, transform=high, rotation=90, ha="center", va="top", fontsize=7, color=style.colour)


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
    chosen, failed, subjects, methods = _cases(metrics, metric)
    figure = new_figure(4.4, f"{METRICS[metric].title if metric in METRICS else metric} ({note})")
    names = [*subjects, "mean ± SD", *([PAPER] if paper is not None else [])]
    ax = figure.subplots()
    places = _groups(ax, names, len(methods), len(names))
    nothing = set(failed["subject"]) - set(chosen["subject"])
    for row, subject in zip(places, subjects, strict=False):
        if subject in nothing:
            _all_failed(ax, float(row.mean()))
    high = _highest(chosen["value"], methods, paper)
    for column, method in enumerate(methods):
        style, means = method_style(method), []
        bar: dict[str, Any] = {"width": 0.86, "fc": style.face, "ec": style.colour, "hatch": style.hatch, "lw": 1.0}
        for x, subject in zip(places[:, column], subjects, strict=False):
            values = chosen[(chosen["subject"] == subject) & (chosen["method"] == method)]["value"].to_numpy()
            if len(values):
                means.append(values.mean())
                ax.bar(x, means[-1], **bar)
            elif subject not in nothing and ((failed["subject"] == subject) & (failed["method"] == method)).any():
                ax.text(x, 0, " failed", rotation=90, ha="center", va="bottom", fontsize=7, color=style.colour)
            if len(values) > 1:
                ax.scatter(np.full(len(values), x), values, s=7, c=DARK, lw=0, zorder=4)
        x = places[len(subjects), column]
        if means:
            mean, sd = float(np.mean(means)), population_sd(means)
            ax.bar(x, mean, yerr=sd, error_kw={"lw": 1.1, "capsize": 2.5}, **bar)
            text = f"{mean:.2f}±{sd:.2f}" + ("" if len(means) == len(subjects) else f", n={len(means)}")
            ax.text(x, 0.985, text, transform=ax.get_xaxis_transform(), rotation=90, ha="center", va="top", fontsize=7)
            high = max(high, mean + sd)
        if paper is not None:
            _paper_point(ax, places[-1, column], method, paper)
    ax.set_ylabel(_metric_label(metric), fontsize=9)
    ax.set_ylim(0, high / 0.68)  # the numbers stand above everything else
    ax.grid(axis="y", alpha=0.3)
    ax.set_axisbelow(True)
    plain(ax, f"SD: population, over n = {len(subjects)} columns")
    hollow = Line2D([], [], ls="", marker="o", mfc="white", color=DARK, label=f"{PAPER}: mean ± SD")
    method_legend(figure, methods, [hollow] if paper is not None else [])
    return figure


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
    _table(df, ("choice", "option", "role", "case", "value"), "rows of choices")
    roles = {"authors": ("authors' code", "#CC3311", "s"), "alternative": ("alternative", "#0077BB", "o")}
    lines = []
    for choice, rows in df.groupby("choice", sort=False):
        base = rows[rows["role"] == "paper"].set_index("case")["value"]
        require(base, f"the published option of {choice!r}")
        published = rows.loc[rows["role"] == "paper", "option"].iloc[0]
        for (option, role), other in rows[rows["role"] != "paper"].groupby(["option", "role"], sort=False):
            difference = (other.set_index("case")["value"] - base).dropna().to_numpy()
            require(difference, f"paired cases of {choice!r}: {option!r}")
            lines.append((f"{choice}\n{published} → {option}", str(role), difference))
    require(lines, "options other than the published")
    figure = new_figure(
        1.6 + 0.52 * len(lines), f"Change of the mean waypoint error against the published choice ({note})"
    )
    ax = figure.subplots()
    size = np.abs(np.concatenate([difference for *_, difference in lines]))
    end = float(np.clip(np.percentile(size, 95), 0.5, 1.2))
    for y, (_, role, difference) in enumerate(lines):
        _, colour, marker = roles.get(role, (role, DARK, "^"))
        aside = ((np.arange(len(difference)) * 0.618) % 1 - 0.5) * 0.36
        mean, sd = float(difference.mean()), population_sd(difference)
        ax.scatter(difference, y + aside, s=14, c=colour, alpha=0.45, lw=0)
        ax.errorbar(mean, y, xerr=sd, fmt=marker, color=colour, mec="black", ms=8, capsize=3)
        if role == "yardstick":
            ax.axvspan(mean - sd, mean + sd, color="#e8e8e8", lw=0, zorder=0)
        for side in (-1, 1):
            beyond = difference[side * difference > end]
            if len(beyond):
                far = beyond[np.argmax(np.abs(beyond))]
                text = _signed(far) if len(beyond) == 1 else f"{len(beyond)} cases, to {_signed(far)}"
                ax.plot(side * end, y, marker="<>"[side > 0], ms=9, color=colour, mec="black", zorder=5)
                at: dict[str, Any] = {"ha": "right" if side > 0 else "left", "va": "bottom", "fontsize": 7}
                ax.text(side * 1.05 * end, y - 0.2, text, zorder=6, **at)
        text = f"{_signed(mean)} (n={len(difference)})"
        ax.text(1.01, y, text, transform=ax.get_yaxis_transform(), va="center", fontsize=8)
    ax.axvline(0, color=DARK, lw=1)
    ax.set_xlim(-1.06 * end, 1.06 * end)
    ax.set_yticks(range(len(lines)), [label for label, _, _ in lines])
    ax.set_ylim(len(lines) - 0.5, -0.5)
    ax.set_xlabel("better ←  difference per case, mean ± SD (mm)  → worse", fontsize=9)
    ax.grid(axis="x", alpha=0.3)
    plain(ax)
    used = dict.fromkeys(role for _, role, _ in lines)
    marks = [roles.get(role, (role, DARK, "^")) for role in used]
    handles: list[Any] = [Line2D([], [], ls="", marker=m, color=colour, label=label) for label, colour, m in marks]
    if "yardstick" in used:
        handles.append(Patch(color="#e8e8e8", label="yardstick, mean ± SD"))
    if (size > end).any():
        handles.append(Line2D([], [], ls="", marker=">", color=GREY, mec="black", label="cases beyond the axis"))
    below(figure, handles, 5)
    return figure


def error_budget(df: pd.DataFrame, *, note: str = SIMULATED) -> Figure:
    """What each error of the ultrasound does to the cloud and, by method, to the waypoints.

    Args:
        df: long, columns ``source`` (of error, in the order to show), ``metric`` (``surface_distance`` of the cloud or
            ``waypoint_error``), ``method`` (ignored for the cloud) and ``value`` (mm); several rows of one kind
            (seeds, patients) are dots about their mean.
        note: where the patient is from.

    Raises:
        StudyError: no row of either metric.
    """
    _table(df, ("source", "metric", "method", "value"), "rows of the error budget")
    cloud, path = (df[df["metric"] == metric] for metric in ("surface_distance", "waypoint_error"))
    require(cloud, "rows of surface_distance")
    require(path, "rows of waypoint_error")
    sources, methods = list(dict.fromkeys(df["source"])), in_order(path["method"])
    figure = new_figure(1.5 + 0.46 * len(sources), f"What each error of the ultrasound costs ({note})")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=[1, 1.9])
    _strip(left, sources, cloud, 0.0, DARK, "o", DARK)
    for k, method in enumerate(methods):
        style = method_style(method)
        aside = 0.62 * ((k + 0.5) / len(methods) - 0.5)
        _strip(right, sources, path[path["method"] == method], aside, style.face, style.marker, style.colour)
    for ax, title in ((left, "cloud to the true surface, mean (mm)"), (right, "mean waypoint error (mm)")):
        for y in range(0, len(sources), 2):
            ax.axhspan(y - 0.5, y + 0.5, color="#f3f3f3", lw=0, zorder=0)
        ax.set_xlabel(title, fontsize=9)
        ax.set_xlim(0, None)
        ax.grid(axis="x", alpha=0.3)
        plain(ax)
    left.set_yticks(range(len(sources)), sources)
    left.set_ylim(len(sources) - 0.5, -0.5)
    styles = [method_style(method) for method in methods]
    marks = [Line2D([], [], ls="", marker=s.marker, mfc=s.face, mec=s.colour, label=s.label) for s in styles]
    below(figure, marks, min(5, len(marks)))
    return figure


def _strip(
    ax: Axes, sources: Sequence[str], rows: pd.DataFrame, aside: float, face: Any, marker: str, edge: str
) -> None:
    for y, source in enumerate(sources):
        values = rows.loc[rows["source"] == source, "value"].dropna().to_numpy()
        if len(values):
            if len(values) > 1:
                ax.plot([values.min(), values.max()], [y + aside] * 2, color=edge, lw=1, alpha=0.6)
                ax.scatter(values, np.full(len(values), y + aside), s=6, c=edge, lw=0, alpha=0.6)
            ax.scatter(values.mean(), y + aside, s=38, marker=marker, fc=face, ec=edge, lw=1.1, zorder=4)


def error_views(metrics: pd.DataFrame, views: Sequence[str], *, note: str = SIMULATED) -> Figure:
    """The same transferred waypoints, judged in several ways: a panel a metric, a row a method.

    Args:
        metrics: rows of one dataset, as ``results.read_metrics`` gives them.
        views: metrics of waypoints, in the order of the panels; one the dataset does not have is left out.
        note: where the patient is from.

    Raises:
        StudyError: several datasets, or none of the metrics.
    """
    _table(metrics, ("dataset", "subject", "target", "method", "metric", "value"), "rows of metrics.csv")
    known = [view for view in views if view in set(metrics["metric"])]
    require(known, f"rows of a metric among {', '.join(views)}")
    *_, methods = _cases(metrics, known[0])
    cases = metrics[metrics["metric"].isin(known)].groupby(["subject", "target", "seed", "method", "metric"])["value"]
    means = cases.mean().reset_index()
    figure = new_figure(1.6 + 0.34 * len(methods), f"The same waypoints, judged in {len(known)} ways ({note})")
    panels = np.atleast_1d(figure.subplots(1, len(known), sharex=True, sharey=True))
    for ax, view in zip(panels, known, strict=True):
        for y, method in enumerate(methods):
            values = means.loc[(means["metric"] == view) & (means["method"] == method), "value"].to_numpy()
            style = method_style(method)
            if y % 2 == 0:
                ax.axhspan(y - 0.5, y + 0.5, color="#f3f3f3", lw=0, zorder=0)
            if len(values):
                mean, sd = float(values.mean()), population_sd(values)
                ax.scatter(values, np.full(len(values), y + 0.2), s=8, c=style.colour, alpha=0.6, lw=0)
                line: dict[str, Any] = {"mfc": style.face, "mec": style.colour, "ecolor": style.colour, "ms": 7}
                ax.errorbar(mean, y - 0.08, xerr=sd, fmt=style.marker, capsize=2.5, zorder=4, **line)
                right = ax.get_yaxis_transform()
                ax.text(0.99, y - 0.08, f"{mean:.1f}", transform=right, ha="right", va="center", fontsize=8)
        title = METRICS[view].title if view in METRICS else view
        ax.grid(axis="x", alpha=0.3)
        plain(ax, title.replace(" in the feature plane", ",\nin the feature plane"))
        ax.set_xlabel("mean waypoint error of a pair (mm)", fontsize=8)
    figure.supxlabel("dot: a pair; bar: mean ± population SD over pairs; number: that mean", fontsize=8, color=DARK)
    # Room for the means that are written at the right.
    panels[0].set_xlim(0, 1.28 * float(means["value"].max()))
    panels[0].set_yticks(range(len(methods)), [method_style(method).label for method in methods])
    panels[0].set_ylim(len(methods) - 0.5, -0.5)
    return figure


def paired_differences(df: pd.DataFrame, reference: str, what: str, *, note: str = SIMULATED) -> Figure:
    """One method against each other on the same cases: a panel a dataset, a row a method, a dot a case.

    Args:
        df: columns ``dataset``, ``method`` (the other), ``difference`` (``reference`` minus the other, a row a case).
        reference: the method compared.
        what: what the difference is of, for the title.
        note: where the patient is from.

    Raises:
        StudyError: no difference.
    """
    _table(df, ("dataset", "method", "difference"), "paired differences")
    datasets, methods = list(dict.fromkeys(df["dataset"])), in_order(df["method"])
    label = method_style(reference).label
    figure = new_figure(1.6 + 0.36 * len(methods), f"{what}: {label} minus each other method ({note})")
    panels = np.atleast_1d(figure.subplots(1, len(datasets), sharex=True, sharey=True))
    for ax, dataset in zip(panels, datasets, strict=True):
        mine = df[df["dataset"] == dataset]
        for y, method in enumerate(methods):
            values = mine.loc[mine["method"] == method, "difference"].dropna().to_numpy()
            style = method_style(method)
            if y % 2 == 0:
                ax.axhspan(y - 0.5, y + 0.5, color="#f3f3f3", lw=0, zorder=0)
            if len(values):
                ax.scatter(values, np.full(len(values), y + 0.2), s=8, c=style.colour, alpha=0.6, lw=0)
                line: dict[str, Any] = {"mfc": style.face, "mec": style.colour, "ecolor": style.colour, "ms": 7}
                ax.errorbar(values.mean(), y - 0.08, xerr=population_sd(values), fmt=style.marker, capsize=2.5, **line)
        ax.axvline(0, color=DARK, lw=1)
        ax.grid(axis="x", alpha=0.3)
        plain(ax, f"{dataset}, n = {mine.groupby('method').size().max()} cases")
        ax.set_xlabel("difference (mm)", fontsize=8)
    how = f"{label} better ←  → worse.  Dot: a case; bar: mean ± population SD over cases"
    figure.supxlabel(how, fontsize=8, color=DARK)
    panels[0].set_yticks(range(len(methods)), [method_style(method).label for method in methods])
    panels[0].set_ylim(len(methods) - 0.5, -0.5)
    return figure
