"""Pictures of the controls: why a perfect registration does not score zero, and which measures order as truth does."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from study.evaluation.metrics import METRICS
from study.figures.canvas import View, below, bounds, dots, look, new_figure, plain, project, require, require_columns
from study.figures.rows import judged_by, name_rows, spread, stripe_rows
from study.figures.style import CT_COLOUR, DARK, DATASET_STYLE, GREY, SIMULATED, US_COLOUR, lighter
from study.types import Bools, Floats, RigidTransform

__all__ = ["hausdorff_point", "rank_agreement", "truth_floor"]

_MEASURED, _FLOOR = "#0077BB", "#c8c8c8"
_UNSEEN = to_hex(lighter(CT_COLOUR, 0.62))
_SLAB_MM = 8.0  # half the thickness of the slice that the side view shows


def truth_floor(df: pd.DataFrame, *, note: str = SIMULATED) -> Figure:
    """What the known deformation itself scores as the differences between the clouds are taken away, step by step.

    Args:
        df: rows of `study.evaluation.truth_floor`, of one pair or several: ``pair``, ``step`` (in the order to show),
            ``metric`` and ``value`` (mm). A step whose name starts with "floor" is drawn as one.
        note: where the patient is from.

    Raises:
        StudyError: no row.
    """
    require_columns(df, ("pair", "step", "metric", "value"), "rows of study.evaluation.truth_floor")
    steps, metrics = (list(dict.fromkeys(df[name])) for name in ("step", "metric"))
    n_rows = -(-len(metrics) // 3)
    figure = new_figure(
        1.0 + n_rows * (0.9 + 0.3 * len(steps)), f"What a perfect registration scores, and why ({note})"
    )
    panels = figure.subplots(n_rows, 3, sharey=True, squeeze=False)
    for ax, metric in zip(panels.flat, metrics, strict=False):
        _draw_steps(ax, steps, df[df["metric"] == metric])
        plain(ax, fill(judged_by(metric), 36))
        ax.set_xlabel("mm", fontsize=8)
    for ax in panels.flat[len(metrics) :]:
        ax.set_visible(False)
    name_rows(panels[0, 0], steps)
    n = df["pair"].nunique()
    figure.supxlabel(f"bar and number: mean over {n} pair{'s' * (n > 1)}; dot: a pair", fontsize=8, color=DARK)
    return figure


def _draw_steps(ax: Axes, steps: Sequence[str], rows: pd.DataFrame) -> None:
    """A bar a step, a dot a pair, and the mean in words beyond both."""
    longest = float(rows["value"].max())
    for y, step in enumerate(steps):
        values = rows.loc[rows["step"] == step, "value"].to_numpy()
        if not len(values):
            ax.text(0.02 * longest, y, "does not apply", va="center", fontsize=7.5, color=GREY)
            continue
        ax.barh(y, values.mean(), height=0.66, color=_FLOOR if step.startswith("floor") else lighter(_MEASURED, 0.35))
        ax.scatter(values, y + spread(len(values), 0.4), s=9, c=DARK, lw=0, zorder=3)
        end = max(float(values.max()), float(values.mean())) + 0.03 * longest
        ax.text(end, y, f"{values.mean():.2f}", va="center", fontsize=8)
    ax.set_xlim(0, 1.16 * longest)
    ax.grid(axis="x", alpha=0.3)
    ax.set_axisbelow(True)


def hausdorff_point(
    warped: ArrayLike,
    visible: Bools,
    us: ArrayLike,
    place: ArrayLike,
    partner: ArrayLike,
    *,
    T_us_chest: RigidTransform,
    note: str = SIMULATED,
) -> Figure:
    """The point that decides a Hausdorff distance: where it lies, and what of it ultrasound could have seen.

    Args:
        warped: (n, 3) mm, the CT cloud in the US frame.
        visible: (n,) whether a probe could see a CT point.
        us: (m, 3) mm, the US cloud.
        place: (3,) mm, the deciding point.
        partner: (3,) mm, the nearest point of the other cloud.
        T_us_chest: chest coordinates to the US frame.
        note: where the patient is from.

    Raises:
        StudyError: no point.
    """
    require(np.asarray(warped), "a warped cloud")
    distance = float(np.linalg.norm(np.subtract(place, partner)))
    figure = new_figure(5.2, f"The point that decides a Hausdorff distance of {distance:.1f} mm ({note})")
    front, side = figure.subplots(1, 2, width_ratios=[1.8, 1])
    left = T_us_chest.inverse.apply(np.atleast_2d(place))[0, 0]
    views: tuple[tuple[Axes, View, str], ...] = (
        (front, "front", "from the front; shaded: the slice at the right"),
        (side, "side", f"{2 * _SLAB_MM:g} mm slice, from the right"),
    )
    for ax, view, title in views:
        clouds = [project(points, view, T_us_chest) for points in (warped, us)]
        seen = np.asarray(visible)
        if view == "side":
            near = [np.abs(project(points, "front", T_us_chest)[:, 0] - left) < _SLAB_MM for points in (warped, us)]
            clouds, seen = [cloud[rows] for cloud, rows in zip(clouds, near, strict=True)], seen[near[0]]
        _draw_clouds(ax, clouds[0], seen, clouds[1], size=3.0 if view == "front" else 14.0)
        ends = project(np.array([place, partner], dtype=np.float64), view, T_us_chest)
        _draw_distance(ax, ends, distance)
        look(ax, view, bounds(*clouds, margin_mm=6.0 if view == "front" else 18.0), title)
    front.axvspan(left - _SLAB_MM, left + _SLAB_MM, color="#eeeeee", lw=0, zorder=0)
    colours: dict[str, Any] = {
        "CT, unseen by a probe": _UNSEEN,
        "CT, visible": CT_COLOUR,
        "ultrasound": US_COLOUR,
    }
    handles: list[Any] = [Line2D([], [], ls="", marker="o", color=c, label=label) for label, c in colours.items()]
    handles.append(Line2D([], [], color="black", marker="*", ms=10, label="the deciding point, to its nearest"))
    below(figure, handles, 4)
    return figure


def _draw_clouds(ax: Axes, warped: Floats, visible: Bools, us: Floats, size: float) -> None:
    for points, colour in ((warped[~visible], _UNSEEN), (warped[visible], CT_COLOUR), (us, US_COLOUR)):
        dots(ax, points, colour, size)


def _draw_distance(ax: Axes, ends: Floats, distance: float) -> None:
    x, y = float(ends[0, 0]), float(ends[0, 1])
    ax.plot(ends[:, 0], ends[:, 1], color="black", lw=1.5, zorder=5)
    ax.plot(x, y, marker="*", ms=14, color="black", mec="white", zorder=6)
    halo = [withStroke(linewidth=3, foreground="white")]
    at: dict[str, Any] = {"xytext": (8, -15), "textcoords": "offset points", "fontsize": 9, "weight": "bold"}
    ax.annotate(f"{distance:.1f} mm", (x, y), zorder=7, path_effects=halo, **at)


def rank_agreement(df: pd.DataFrame, *, note: str = SIMULATED) -> Figure:
    """Whether measures that need no truth order the methods as the true error does: a row a measure, a dot a pair.

    Args:
        df: rows of `study.evaluation.rank_agreement`: ``dataset``, ``measure`` and ``truth`` (names in ``METRICS``, in
            the order to show) and ``rho`` (-1 to 1).
        note: where the patients are from.

    Raises:
        StudyError: no row.
    """
    require_columns(df, ("dataset", "measure", "truth", "rho"), "rows of study.evaluation.rank_agreement")
    datasets, measures, truths = (list(dict.fromkeys(df[name])) for name in ("dataset", "measure", "truth"))
    title = f"Do measures without truth order the methods as the true error does? ({note})"
    figure = new_figure(1.6 + 0.36 * len(measures) + 0.1 * len(datasets), title)
    panels = np.atleast_1d(figure.subplots(1, len(truths), sharex=True, sharey=True))
    low = min(-0.05, float(df["rho"].min()) - 0.05)
    for ax, truth in zip(panels, truths, strict=True):
        stripe_rows(ax, len(measures))
        for k, dataset in enumerate(datasets):
            mine = df[(df["truth"] == truth) & (df["dataset"] == dataset)]
            aside = 0.66 * ((k + 0.5) / len(datasets) - 0.5)
            _draw_agreement(ax, measures, mine, aside, *DATASET_STYLE[k % len(DATASET_STYLE)])
        ax.axvline(0, color=DARK, lw=0.8)
        ax.set_xlim(low, 1.05)
        ax.grid(axis="x", alpha=0.3)
        plain(ax, fill(f"{METRICS[truth].title} (mm)", 30))
        ax.set_xlabel("rank correlation over the methods", fontsize=8)
    name_rows(panels[0], [_part_last(METRICS[measure].title) for measure in measures])
    marks: list[Any] = [
        Line2D([], [], ls="", marker=marker, color=colour, mec="black", label=f"{dataset}: mean; dot: a pair")
        for dataset, (colour, marker) in zip(datasets, DATASET_STYLE * len(datasets), strict=False)
    ]
    below(figure, marks, 4)
    return figure


def _part_last(title: str) -> str:
    """``Waypoint error of the visible part in depth`` with its part at the end, where the eye compares rows."""
    part = " of the visible part"
    return title.replace(part, "") + (part.replace(" of the", ",") if part in title else "")


def _draw_agreement(
    ax: Axes, measures: Sequence[str], rows: pd.DataFrame, aside: float, colour: str, marker: str
) -> None:
    """Every pair's rank correlation with a measure as a dot, their range as a line, their mean as a marker."""
    for y, measure in enumerate(measures):
        values = rows.loc[rows["measure"] == measure, "rho"].dropna().to_numpy()
        if len(values):
            ax.plot([values.min(), values.max()], [y + aside] * 2, color=colour, lw=1.2, alpha=0.6)
            ax.scatter(values, np.full(len(values), y + aside), s=12, c=colour, lw=0, alpha=0.7)
            ax.plot(values.mean(), y + aside, marker=marker, ms=6, color=colour, mec="black", zorder=4)
