"""Pictures to place the landmarks of a CT by, and to judge what grew from them (sec. II-C.1).

Axes show the CT's own millimetres, so that a place can be read off; the patient's right is at the left.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import MultipleLocator

from study.ct.landmarks import Landmarks
from study.ct.wall import WallImage
from study.errors import StudyError
from study.figures.canvas import WIDTH_IN, look, new_figure, part_legend, require
from study.figures.style import PART_COLOUR
from study.types import CARTILAGES, Floats, Part, Volume

__all__ = ["axial_slices", "chest_front", "landmark_panels"]

_HALF_WIDTH_MM = 130.0  # of the front view
_PANEL_MM = 44.0  # shown around a landmark: 3 mm are 15 pixels
_COLUMNS = 4
_WINDOW_HU = (-120.0, 280.0)
_HALO: list[AbstractPathEffect] = [withStroke(linewidth=2.5, foreground="black")]
_DRAWN = {part: PART_COLOUR[part] for part in (Part.STERNUM, *CARTILAGES)}


def chest_front(wall: WallImage, landmarks: Landmarks | None = None, mask: Volume | None = None) -> Figure:
    """The flattened front of the chest with a grid to read x and z from.

    Args:
        wall: of the CT.
        landmarks: crosses with their names.
        mask: `Part` volume that grew from them, as outlines of what lies anywhere behind a place.
    """
    centre = float(wall.x_mm.mean())
    wide = min(2 * _HALF_WIDTH_MM, float(np.ptp(wall.x_mm)))
    figure = new_figure((WIDTH_IN - 1.0) * float(np.ptp(wall.z_mm)) / wide + 1.5, f"{wall.ct.name}: front of the chest")
    ax = figure.subplots()
    extent = (wall.x_mm[0], wall.x_mm[-1], wall.z_mm[0], wall.z_mm[-1])
    ax.imshow(wall.image, cmap="gray", origin="lower", extent=extent, vmin=-20, vmax=150)
    if mask is not None:
        _outlines(ax, mask, axis=1)
    if landmarks is not None:
        for name, point in _named(landmarks):
            _cross(ax, point[0], point[2], name)
    _millimetres(ax, (centre + wide / 2, centre - wide / 2), extent[2:], "z (mm, to the head)")
    if mask is not None:
        part_legend(figure, shown=set(_DRAWN))
    return figure


def axial_slices(ct: Volume, heights_mm: Sequence[float]) -> Figure:
    """Axial slices of the front of the chest with a grid to read x and y from.

    Raises:
        StudyError: no height, or one outside the image.
    """
    require(heights_mm, "heights of slices")
    low, high = ct.to_mm(np.array([(1, 1, 1), ct.shape]) - 1)[:, 2]
    for z in heights_mm:
        if not low <= z <= high:
            raise StudyError(
                f"{ct.name}: expected slices at {low:.1f} to {high:.1f} mm, got {z:g}; read z off the front"
            )
    figure = new_figure(5.2 * len(heights_mm) + 0.5, f"{ct.name}: axial slices")
    for ax, z in zip(figure.subplots(len(heights_mm), 1, squeeze=False).flat, heights_mm, strict=True):
        values, x, y, _ = _axial(ct, z)
        body = np.flatnonzero((values > -300).sum(axis=0) * ct.spacing_mm[0] > 40.0)
        front = y[body.max()] if len(body) else y[-1]
        _image(ax, values, x, y)
        middle = float(x.mean())
        ax.set_title(f"z = {z:g} mm", loc="left", fontsize=9)
        _millimetres(
            ax, (middle + _HALF_WIDTH_MM, middle - _HALF_WIDTH_MM), (front - 100, front + 5), "y (mm, forwards)"
        )
    return figure


def landmark_panels(ct: Volume, landmarks: Landmarks, mask: Volume) -> Figure:
    """An axial panel for each landmark: its cross, and the outlines of what grew.

    Args:
        ct: Hounsfield units.
        landmarks: of the CT.
        mask: `Part` volume that grew from them.
    """
    named = list(_named(landmarks))
    rows = -(-len(named) // _COLUMNS)
    side = WIDTH_IN / _COLUMNS
    title = f"{ct.name}: crosses belong in the middle of an end, outlines on the edge of cartilage and bone"
    figure = new_figure((side + 0.35) * rows + 1.0, title)
    for ax, (name, point) in zip(figure.subplots(rows, _COLUMNS, squeeze=False).flat, named, strict=False):
        values, x, y, _ = _axial(ct, point[2])
        _image(ax, values, x, y)
        _outlines(ax, mask, axis=2, at_mm=float(point[2]))
        _cross(ax, point[0], point[1])
        half = _PANEL_MM / 2
        ax.set(xlim=(point[0] + half, point[0] - half), ylim=(point[1] - half, point[1] + half), aspect="equal")
        left, low = point[0] + half - 3, point[1] - half + 3
        ax.plot([left, left - 3], [low, low], color="white", lw=3, path_effects=_HALO)
        ax.text(left - 4, low, "3 mm", color="white", fontsize=8, va="center", path_effects=_HALO)
        ax.set_title(f"{name}, z = {point[2]:.0f} mm", loc="left", fontsize=8)
        ax.set(xticks=[], yticks=[])
    for ax in figure.axes[len(named) :]:
        ax.set_axis_off()
    part_legend(figure, shown=set(_DRAWN))
    return figure


def _named(landmarks: Landmarks) -> Iterator[tuple[str, Floats]]:
    """Every landmark, with the name of its file's keys."""
    for what, points in (("junction", landmarks.junctions), ("attachment", landmarks.attachments)):
        for part in CARTILAGES:
            yield f"{what} {part.side} {part.level}", points[part]
    for k, point in enumerate(landmarks.sternum, start=1):
        yield f"sternum {k}", point


def _axial(volume: Volume, z_mm: float) -> tuple[Floats, Floats, Floats, int]:
    """The slice ``values[i, j]`` nearest to a height, with x and y of its voxels, mm, and its number."""
    k = int(np.clip(np.rint(volume.to_index([[0.0, 0.0, z_mm]])[0, 2]), 0, volume.shape[2] - 1))
    ends = volume.to_mm([[0, 0, k], [volume.shape[0] - 1, volume.shape[1] - 1, k]])
    x, y = (np.linspace(ends[0, axis], ends[1, axis], volume.shape[axis]) for axis in (0, 1))
    return np.asarray(volume.values[:, :, k]), x, y, k


def _image(ax: Axes, values: Floats, x: Floats, y: Floats) -> None:
    ax.imshow(
        values.T,
        cmap="gray",
        origin="lower",
        extent=(x[0], x[-1], y[0], y[-1]),
        vmin=_WINDOW_HU[0],
        vmax=_WINDOW_HU[1],
        interpolation="nearest",
    )


def _outlines(ax: Axes, mask: Volume, axis: int, at_mm: float | None = None) -> None:
    """Each part's outline: seen along an axis, or in the axial slice at a height where the mask has one."""
    ends = mask.to_mm(np.array([(1, 1, 1), mask.shape]) - 1)
    grids = [np.linspace(ends[0, one], ends[1, one], mask.shape[one]) for one in range(3)]
    k = None if at_mm is None else int(np.rint(mask.to_index([[0.0, 0.0, at_mm]])[0, axis]))
    if k is not None and not 0 <= k < mask.shape[axis]:
        return
    across, up = (grids[one] for one in range(3) if one != axis)
    for part, colour in _DRAWN.items():
        inside = mask.values == part
        flat = inside.any(axis=axis) if k is None else np.take(inside, k, axis)
        if flat.any():
            drawn = ax.contour(across, up, flat.T.astype(float), levels=[0.5], colors=[colour], linewidths=1.3)
            drawn.set_path_effects(_HALO)


def _cross(ax: Axes, x: float, y: float, name: str = "") -> None:
    ax.plot([x], [y], "+", color="#7CFC00", markersize=12, markeredgewidth=1.6, path_effects=_HALO)
    if name:
        ax.annotate(
            name.replace("junction ", "J ").replace("attachment ", "A "),
            (x, y),
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=7,
            color="white",
            path_effects=_HALO,
        )


def _millimetres(ax: Axes, xlim: tuple[float, float], ylim: Sequence[float], ylabel: str) -> None:
    look(ax, "front", np.array([[xlim[0], ylim[0]], [xlim[1], ylim[1]]]), ax.get_title(loc="left"), on_dark=True)
    ax.set(xlabel="x (mm, to the patient's right)", ylabel=ylabel)
    for one in (ax.xaxis, ax.yaxis):
        one.set_major_locator(MultipleLocator(10))
    ax.tick_params(labelsize=7)
    ax.tick_params(axis="x", labelrotation=60)
    ax.grid(alpha=0.35)
