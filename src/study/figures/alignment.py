"""Pictures of the coarse alignment: sternum, edges, seeds, labelled branches, the clouds overlaid (sec. III-A)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import ArrayLike

from study.figures.canvas import (
    WIDTH_IN,
    View,
    below,
    bounds,
    dots,
    look,
    name_parts,
    new_figure,
    part_legend,
    plain,
    project,
    require,
)
from study.figures.style import CT_COLOUR, DARK, US_COLOUR, part_colours, steps
from study.types import Floats, Ints, RigidTransform

__all__ = ["CoarseView", "ScoreView", "coarse_overlay", "coarse_steps", "score_maps"]

_EDGE_COLOUR, _SEED_COLOUR = "#882255", "#F0E442"
_SCALE_STYLE = (("#555555", 3.5), ("#56B4E9", 2.2), ("#D55E00", 1.6))  # colour and line width, coarse to fine


@dataclass(frozen=True)
class CoarseView:
    """What the coarse alignment saw of one cloud (sec. III-A).

    Attributes:
        plane: (n, 2) mm, the cloud in its feature plane.
        rectangles: scale (mm a pixel), centre (2,) in the plane and angle (degrees, counter-clockwise from y) of the
            sternum rectangle found at each scale.
        local: (n, 2) mm, the cloud in sternum coordinates.
        edges_mm: distance of the sternum's edges from its axis, at x < 0 and at x > 0.
        seeds: (k, 2) mm in sternum coordinates.
        chest: (n, 2) mm, the cloud in chest coordinates, x to the patient's left and y up.
        parts: (n,) of `Part`.
        size_mm: width and height of the rectangle.
    """

    plane: Floats
    rectangles: Sequence[tuple[float, Floats, float]]
    local: Floats
    edges_mm: tuple[float, float]
    seeds: Floats
    chest: Floats
    parts: Ints
    size_mm: tuple[float, float] = (30.0, 90.0)


def coarse_steps(views: Mapping[str, CoarseView]) -> Figure:
    """The paper's Fig. 2: the sternum at three scales, its edges and the seeds, the labelled branches; a row a cloud.

    Args:
        views: by the cloud's name.

    Raises:
        StudyError: no view, or one without points.
    """
    require(views, "views")
    figure = new_figure(0.9 + 3.1 * len(views), "Coarse alignment: sternum, branches, labels")
    scales: dict[float, Polygon] = {}
    for row, (name, view) in zip(figure.subplots(len(views), 3, squeeze=False), views.items(), strict=True):
        require(view.plane, f"points of {name}")
        plane, local, chest = (
            np.column_stack([points, np.zeros(len(points))]) for points in (view.plane, view.local, view.chest)
        )
        titles = (f"{name}: feature plane, rectangle at each scale", "edges of the sternum, seeds", "labelled branches")
        for ax, points, title in zip(row, (plane, local, chest), titles, strict=True):
            coloured = ax is row[2]
            dots(ax, points, part_colours(view.parts, len(points)) if coloured else "#9db2c4", size=3)
            look(ax, "front" if coloured else "side", bounds(points, margin_mm=16.0 if coloured else 8.0), title)
        scales |= _draw_rectangles(row[0], view)
        _draw_edges_and_seeds(row[1], view)
        name_parts(row[2], chest, view.parts)
    edge = Line2D([], [], color=_EDGE_COLOUR, lw=1.6, label="edge of the sternum")
    seed = Line2D([], [], ls="", marker="*", ms=9, color=_SEED_COLOUR, mec="black", mew=0.7, label="seed of a branch")
    part_legend(figure, [*(scales[scale] for scale in sorted(scales, reverse=True)), edge, seed])
    return figure


@dataclass(frozen=True)
class ScoreView:
    """The template match of Eq. 1 for one cloud, as a picture.

    Attributes:
        values: (w, h) F_k over the rectangle's area, 0-1, with the template's centre at each pixel.
        origin: (2,) mm, the centre of the first pixel.
        pixel_mm: edge of a pixel.
        angles_deg: (a,) rotations tried.
        best: (a,) the largest F_k at each.
        plane: (n, 2) mm, the cloud in its feature plane.
        centre: (2,) mm, of the rectangle found.
        angle_deg: its rotation, counter-clockwise from y.
        size_mm: width and height of the rectangle.
    """

    values: Floats
    origin: Floats
    pixel_mm: float
    angles_deg: Floats
    best: Floats
    plane: Floats
    centre: Floats
    angle_deg: float
    size_mm: tuple[float, float] = (30.0, 90.0)


def score_maps(views: Mapping[str, ScoreView]) -> Figure:
    """The map of F_k in the paper's Fig. 2: where the sternum's template covers the cloud, and at which rotation.

    Args:
        views: by the cloud's name.

    Raises:
        StudyError: no view.
    """
    require(views, "views")
    figure = new_figure(0.9 + 3.0 * len(views), "Template match: $F_k$ of Eq. 1 over the area of the rectangle")
    drawn: Any = None
    grid = figure.subplots(len(views), 3, squeeze=False, width_ratios=[1, 1, 1.1])
    for row, (name, view) in zip(grid, views.items(), strict=True):
        low = view.origin - view.pixel_mm / 2
        high = low + view.pixel_mm * np.array(view.values.shape)
        extent = (low[0], high[0], low[1], high[1])
        row[0].scatter(*view.plane.T, s=1.5, c="#9db2c4", lw=0, rasterized=True)
        drawn = row[1].imshow(
            view.values.T, origin="lower", extent=extent, cmap=steps("viridis"), vmin=0, vmax=1, interpolation="nearest"
        )
        titles = (f"{name}: the cloud in its plane", f"$F_k$ at {view.angle_deg:.0f}°, {view.pixel_mm:g} mm a pixel")
        for ax, colour, title in zip(row, (DARK, "white"), titles, strict=False):
            c, s = np.cos(np.radians(view.angle_deg)), np.sin(np.radians(view.angle_deg))
            half = np.array(view.size_mm) / 2 * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
            ax.add_patch(Polygon(half @ np.array([[c, s], [-s, c]]) + view.centre, fill=False, ec=colour, lw=1.8))
            ax.plot(*view.centre, marker="+", ms=10, mew=2, color=colour)
            ax.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
            plain(ax, title)
            ax.set_xlabel("x in the plane (mm)", fontsize=8)
        row[0].set_ylabel("y in the plane (mm)", fontsize=8)
        row[2].plot(view.angles_deg, view.best, marker="o", ms=4, color=US_COLOUR)
        row[2].axvline(view.angle_deg, color=_EDGE_COLOUR, lw=1.2)
        row[2].set_ylim(0, 1.02)
        row[2].set_xlabel("rotation of the template (°)", fontsize=8)
        row[2].grid(alpha=0.25)
        plain(row[2], "largest $F_k$ at each rotation")
    bar = figure.colorbar(drawn, ax=grid[:, 1], shrink=min(0.9, 3.0 / figure.get_figheight()), aspect=20, pad=0.02)
    bar.set_label("share of the rectangle that is covered", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return figure


def _draw_rectangles(ax: Axes, view: CoarseView) -> dict[float, Polygon]:
    """The sternum rectangles in the feature plane, by their scale."""
    ax.set_xlabel("x in the plane (mm)", fontsize=8)
    ax.set_ylabel("y in the plane (mm)", fontsize=8)
    half = np.array(view.size_mm) / 2 * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    drawn = {}
    for (scale, centre, angle), (colour, width) in zip(view.rectangles, _SCALE_STYLE, strict=False):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        corners = half @ np.array([[c, s], [-s, c]]) + centre
        label = f"sternum at {scale:g} mm a pixel"
        drawn[scale] = Polygon(corners, fill=False, ec=colour, lw=width, label=label)
        ax.add_patch(drawn[scale])
    return drawn


def _draw_edges_and_seeds(ax: Axes, view: CoarseView) -> None:
    """The sternum's axis and edges, and where the branches start, in sternum coordinates."""
    ax.set_xlabel("across the sternum (mm)", fontsize=8)
    ax.set_ylabel("along the sternum (mm)", fontsize=8)
    ax.axvline(0, color=DARK, lw=0.8, ls=":")
    for x in (-view.edges_mm[0], view.edges_mm[1]):
        ax.axvline(x, color=_EDGE_COLOUR, lw=1.6)
    across, along = np.asarray(view.seeds).T
    ax.scatter(across, along, s=70, marker="*", c=_SEED_COLOUR, ec="black", lw=0.7, zorder=5)


def coarse_overlay(
    ct: ArrayLike, us: ArrayLike, ct_aligned: ArrayLike, *, T_us_chest: RigidTransform | None = None
) -> Figure:
    """Both clouds before and after the coarse alignment (the paper's Fig. 2, right).

    Args:
        ct, us: (n, 3) and (m, 3) mm, each in the frame it came in.
        ct_aligned: (n, 3) mm, the CT cloud in the US frame.
        T_us_chest: chest coordinates to the US frame; None for RAS+.

    Raises:
        StudyError: a cloud without points.
    """
    views: tuple[View, ...] = ("front", "front", "side")
    pairs = [
        (project(c, v, T_us_chest), project(us, v, T_us_chest))
        for c, v in zip((ct, ct_aligned, ct_aligned), views, strict=True)
    ]
    extents = [bounds(*pair) for pair in pairs]
    ratios = [np.divide(*np.ptp(extent, axis=0)) for extent in extents]
    tall = float(np.clip((WIDTH_IN - 2.0) / sum(ratios) + 1.2, 3.2, 6.0))
    figure = new_figure(tall, "CT and US clouds before and after the coarse alignment")
    titles = ("before, as given", "after: sternums overlaid, from the front", "from the right")
    panels = figure.subplots(1, 3, width_ratios=ratios)
    for ax, pair, view, extent, title in zip(panels, pairs, views, extents, titles, strict=True):
        for points, colour in zip(pair, (CT_COLOUR, US_COLOUR), strict=True):
            dots(ax, points, colour, size=3, alpha=0.55)
        if ax is not panels[0]:
            look(ax, view, extent, title)
    # Before, the CT has no left or up that holds in this frame.
    look(panels[0], "side", extents[0], titles[0])
    panels[0].set_xlabel("US patient's axes: left (mm)", fontsize=8)
    panels[0].set_ylabel("US patient's axes: up (mm)", fontsize=8)
    handles = [Line2D([], [], ls="", marker="o", color=c, label=n) for c, n in ((CT_COLOUR, "CT"), (US_COLOUR, "US"))]
    below(figure, handles, 2)
    return figure
