"""Pictures of CTs, surfaces and clouds (sec. II-C.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from study.errors import StudyError
from study.figures.canvas import (
    WIDTH_IN,
    below,
    bounds,
    dots,
    draw_surface,
    look,
    name_parts,
    new_figure,
    part_legend,
    plain,
    project,
    require,
)
from study.figures.style import PART_COLOUR, part_colours
from study.types import CARTILAGES, Bools, Floats, Ints, Mesh, Part, PointCloud, RigidTransform, Volume

__all__ = ["FrontWall", "anatomy_overview", "biomarker", "ct_slice", "front_wall", "mesh_and_cloud"]

_STERNUM, _CARTILAGE = "#56B4E9", "#E69F00"  # Okabe and Ito
_DRAWN: Mapping[Part, Any] = {part: colour for part, colour in PART_COLOUR.items() if part != Part.UNKNOWN}


def ct_slice(
    volume: Volume,
    mask: Volume,
    *,
    reference: Volume | None = None,
    at_mm: ArrayLike | None = None,
    window_hu: tuple[float, float] = (-160.0, 350.0),
    margin_mm: float = 25.0,
) -> Figure:
    """An axial slice and, below it, a coronal one at the same scale, with the contour of each part.

    Args:
        volume: Hounsfield units, axes along R, A, S.
        mask: `Part` values on the same grid or a crop of it.
        reference: other parts on the grid of ``mask``, dashed.
        at_mm: (3,) RAS+ place the slices go through, ringed; without it, they go where most parts are seen.
        window_hu: darkest and brightest value.
        margin_mm: shown around the mask.

    Raises:
        StudyError: an empty mask, one on another grid, or a place outside it.
    """
    first = _place(volume, mask)
    cut = [_best_slice(mask, axis) for axis in range(3)] if at_mm is None else _slice_at(mask, at_mm)
    slices = [_cut(volume, mask, first, cut, axis, margin_mm) for axis in (2, 1)]
    heights = [float(np.ptp(one.extent[:, 1])) for one in slices]
    scale = min((WIDTH_IN - 1.0) / float(np.ptp(slices[0].extent[:, 0])), 8.0 / sum(heights))  # inches a mm
    title = f"{volume.name}: parts on the CT, window {window_hu[0]:g} to {window_hu[1]:g} HU"
    figure = new_figure(scale * sum(heights) + 2.1, title)
    for ax, one in zip(figure.subplots(2, 1, height_ratios=heights), slices, strict=True):
        _grey_image(ax, np.take(volume.values, first[one.axis] + one.index, one.axis), one.x, one.y, window_hu)
        _part_contours(ax, one.xy_mask, one.parts, _DRAWN, linewidths=1.4)
        if reference is not None:
            white: Mapping[Part, Any] = dict.fromkeys(_DRAWN, "white")
            other = np.take(mask.with_values(reference.values).values, one.index, one.axis)
            _part_contours(ax, one.xy_mask, other, white, linewidths=0.9, linestyles="dashed")
        if at_mm is not None:
            place_mm = np.asarray(at_mm, dtype=np.float64).ravel()
            ax.scatter(-place_mm[0], place_mm[one.up], s=260, fc="none", ec="#F0E442", lw=1.6, zorder=5)
        name, letter = ("axial", "S") if one.axis == 2 else ("coronal", "A")
        depth_mm = _grid_mm(volume, one.axis)[first[one.axis] + one.index]
        look(ax, "front", one.extent, f"{name}, {letter} = {depth_mm:.1f} mm", on_dark=True)
        ax.set_ylabel("to the front (mm)" if one.up == 1 else "up (mm)", fontsize=8)
    part_legend(figure, shown={part for part in _DRAWN if any((one.parts == part).any() for one in slices)})
    return figure


@dataclass(frozen=True)
class _Slice:
    """An axial or coronal slice, the patient's left to the right of the page.

    Attributes:
        axis: the axis it cuts, 2 or 1.
        up: the axis up the page, 1 or 2.
        index: of the mask's grid, along ``axis``.
        x, y: voxel centres of the volume across and up the page, mm.
        xy_mask: the same of the mask.
        parts: (len of each of ``xy_mask``) of `Part`.
        extent: (2, 2) mm, corners of what is shown: the labelled box and its margin.
    """

    axis: int
    up: int
    index: int
    x: Floats
    y: Floats
    xy_mask: list[Floats]
    parts: Ints
    extent: Floats


def _cut(volume: Volume, mask: Volume, first: Ints, cut: Sequence[int], axis: int, margin_mm: float) -> _Slice:
    up = 3 - axis
    x, y = -_grid_mm(volume, 0), _grid_mm(volume, up)
    xy_mask = [grid[first[a] : first[a] + mask.shape[a]] for a, grid in ((0, x), (up, y))]
    boxes = [np.flatnonzero((mask.values >= 0).any(axis=tuple({0, 1, 2} - {a}))) for a in (0, up)]
    (xa, xb), (ya, yb) = ((grid[box[0]], grid[box[-1]]) for grid, box in zip(xy_mask, boxes, strict=True))
    extent = np.array([[min(xa, xb) - margin_mm, ya - margin_mm], [max(xa, xb) + margin_mm, yb + margin_mm]])
    return _Slice(axis, up, cut[axis], x, y, xy_mask, np.take(mask.values, cut[axis], axis), extent)


def _slice_at(mask: Volume, at_mm: ArrayLike) -> list[int]:
    """The voxel of the mask at a place, one index an axis."""
    cut: list[int] = np.round(mask.to_index(np.reshape(at_mm, (1, 3)))[0]).astype(int).tolist()
    if not all(0 <= index < n for index, n in zip(cut, mask.shape, strict=True)):
        raise StudyError(f"expected a place inside {mask.name}, got {np.asarray(at_mm)} mm; take a point of the mask")
    return cut


def _grid_mm(volume: Volume, axis: int) -> Floats:
    """Voxel centres along one axis of the grid, mm; RAS+ where the grid is not tilted."""
    centres = volume.T_ras_index.translation[axis] + np.arange(volume.shape[axis]) * volume.spacing_mm[axis]
    return np.asarray(centres, dtype=np.float64)


def _place(volume: Volume, mask: Volume) -> Ints:
    """The voxel of ``volume`` that is ``mask``'s first."""
    start = volume.to_index(mask.to_mm([[0, 0, 0]]))[0]
    first: Ints = np.round(start).astype(np.int64)
    same = np.allclose(volume.spacing_mm, mask.spacing_mm) and np.allclose(start, first, atol=0.05)
    if not same or (first < 0).any() or (first + mask.shape > volume.shape).any():
        raise StudyError(f"expected a mask on the grid of {volume.name}, got another grid; crop or resample, not both")
    require(np.flatnonzero(mask.values >= 0), f"labelled voxels of {mask.name}")
    return first


def _part_contours(ax: Axes, xy: Sequence[Floats], parts: Ints, colours: Mapping[Part, Any], **style: Any) -> None:
    """The outline of each part that is in ``parts[i, j]`` at x[i], y[j] of ``xy``, with a dark halo."""
    for part, colour in colours.items():
        inside = parts == part
        if inside.any():
            padded = np.pad(inside, 1).T.astype(float)
            wide = [np.concatenate([[2 * a[0] - a[1]], a, [2 * a[-1] - a[-2]]]) for a in xy]
            drawn = ax.contour(*wide, padded, levels=[0.5], colors=[colour], **style)
            drawn.set_path_effects([withStroke(linewidth=style["linewidths"] + 1.4, foreground="black")])


def _grey_image(ax: Axes, values: ArrayLike, x: Floats, y: Floats, window: tuple[float, float]) -> None:
    """``values[i, j]`` at x[i], y[j]; both rise or both axes are turned so that they do. 48 greys keep a PNG small."""
    dx, dy = abs(x[1] - x[0]) / 2, abs(y[1] - y[0]) / 2
    extent = (x.min() - dx, x.max() + dx, y.min() - dy, y.max() + dy)
    low, high = window
    image = np.clip((np.asarray(values)[np.argsort(x)][:, np.argsort(y)].T - low) / (high - low), 0.0, 1.0)
    _area(ax, np.round(image * 47) / 47, extent, cmap="gray", vmin=0.0, vmax=1.0)


def _area(ax: Axes, image: Floats, extent: tuple[float, float, float, float], **style: Any) -> None:
    ax.imshow(image, extent=extent, origin="lower", interpolation="nearest", **style)


def _best_slice(mask: Volume, axis: int) -> int:
    """The slice that shows most: many parts count as much as large ones, hence the root of each part's area."""
    planes = np.moveaxis(mask.values, axis, 0).reshape(mask.shape[axis], -1)
    return int(np.argmax(np.sum([np.sqrt((planes == part).sum(axis=1)) for part in _DRAWN], axis=0)))


@dataclass(frozen=True)
class FrontWall:
    """The front wall of a chest, flattened along front to back, so that a curved cartilage is seen whole.

    Attributes:
        image: (rows, columns) mean density of the sheet in front of the lungs, HU.
        x_mm: (columns,) R is positive.
        z_mm: (rows,) upwards.
        name: of the subject.
    """

    image: Floats
    x_mm: Floats
    z_mm: Floats
    name: str


def front_wall(
    wall: FrontWall, mask: Volume, *, reference: Volume | None = None, window_hu: tuple[float, float] = (-30.0, 110.0)
) -> Figure:
    """The unrolled front of a chest with the outline of each part: sternum, cartilages and ribs side by side.

    Args:
        wall: see `study.ct.wall.anterior_wall_image`.
        mask: `Part` values, axes along R, A, S.
        reference: other parts, dashed.
        window_hu: darkest and brightest value.

    Raises:
        StudyError: an empty mask.
    """
    extent = _seen_of(mask, 22.0)
    wide, tall = np.ptp(extent, axis=0)
    width_in = 8.0
    figure = new_figure(0.9 + width_in * tall / wide, f"{wall.name}: parts on the unrolled front of the chest")
    ax = figure.subplots()
    _draw_wall(ax, wall, extent, window_hu)
    _silhouettes(ax, mask, _DRAWN, linewidths=1.5)
    if reference is not None:
        white: Mapping[Part, Any] = dict.fromkeys(_DRAWN, "white")
        _silhouettes(ax, reference, white, linewidths=0.9, linestyles="dashed")
    look(ax, "front", extent, "mean density of the sheet in front of the lungs", on_dark=True)
    part_legend(figure)
    return figure


def biomarker(wall: FrontWall, mask: Volume, frames: Mapping[str, Floats], size_mm: tuple[float, float]) -> Figure:
    """The paper's Fig. 1: where bone becomes cartilage, the three types, and frames of cartilage and rib.

    Args:
        wall: of a CT.
        mask: its `Part` values, axes along R, A, S.
        frames: by what they show, grey values (rows, columns) 0-1, as `study.ultrasound.b_mode_like` gives them.
        size_mm: width and depth of a frame.

    Raises:
        StudyError: an empty mask or no frame.
    """
    require(frames, "frames")
    extent = _seen_of(mask, 34.0)
    figure = new_figure(7.6, f"{wall.name}: bone, cartilage and where they meet; the frames are simulated")
    grid = figure.add_gridspec(2, 2, height_ratios=[1.25, 1])
    top = [figure.add_subplot(grid[0, k]) for k in (0, 1)]
    for ax in top:
        _draw_wall(ax, wall, extent, (-30.0, 110.0))
    ends = _junctions(mask)
    top[0].scatter(ends[:, 0], ends[:, 1], s=130, fc="none", ec="#F0E442", lw=1.8)
    look(top[0], "front", extent, "a  front of the chest on CT; ringed: junctions of rib and cartilage", on_dark=True)
    _fill(top[1], mask)
    middle = float(ends[:, 0].mean())
    words: dict[str, Any] = {"color": "white", "fontsize": 9, "weight": "bold", "ha": "center", "va": "center"}
    for x, y in ends:
        halo = [withStroke(linewidth=2, foreground="black")]
        top[1].text(x + 16 * np.sign(x - middle), y + 4, "rib", path_effects=halo, **words)
    look(top[1], "front", extent, "b  the three types", on_dark=True)
    for k, (what, frame) in enumerate(frames.items()):
        ax = figure.add_subplot(grid[1, k])
        seen = np.round(np.asarray(frame) * 23) / 23  # few greys keep a PNG of speckle small
        ax.imshow(seen, cmap="gray", vmin=0, vmax=1, extent=(0, size_mm[0], size_mm[1], 0), interpolation="nearest")
        ax.set_xlabel("along the aperture (mm)", fontsize=8)
        ax.set_ylabel("depth (mm)", fontsize=8)
        plain(ax, f"{'cd'[k]}  {what}, B-mode-like, simulated from the CT")
    below(figure, [Patch(color=c, label=n) for n, c in (("sternum", _STERNUM), ("costal cartilage", _CARTILAGE))], 2)
    return figure


def _draw_wall(ax: Axes, wall: FrontWall, extent: Floats, window_hu: tuple[float, float]) -> None:
    """The wall's image, no more of it than is shown."""
    x = -wall.x_mm
    columns = np.flatnonzero((x >= extent[0, 0] - 2) & (x <= extent[1, 0] + 2))
    rows = np.flatnonzero((wall.z_mm >= extent[0, 1] - 2) & (wall.z_mm <= extent[1, 1] + 2))
    _grey_image(ax, wall.image[np.ix_(rows, columns)].T, x[columns], wall.z_mm[rows], window_hu)


def _seen_of(mask: Volume, margin_mm: float) -> Floats:
    """(2, 2) mm, corners of what is shown: across and up the page."""
    require(np.flatnonzero(mask.values >= 0), f"labelled voxels of {mask.name}")
    flat = np.asarray((mask.values >= 0).any(axis=1))
    seen = [(-1) ** (a == 0) * _grid_mm(mask, a)[flat.any(axis=b)] for a, b in ((0, 1), (2, 0))]
    return np.array([[one.min() - margin_mm for one in seen], [one.max() + margin_mm for one in seen]])


def _silhouette(mask: Volume, part: Part) -> Bools:
    return np.asarray((mask.values == part).any(axis=1))


def _silhouettes(ax: Axes, mask: Volume, colours: Mapping[Part, Any], **style: Any) -> None:
    """The outline of each part seen from the front."""
    xy = [-_grid_mm(mask, 0), _grid_mm(mask, 2)]
    for part, colour in colours.items():
        flat = np.where(_silhouette(mask, part), int(part), int(Part.UNKNOWN))
        _part_contours(ax, xy, flat, {part: colour}, **style)


def _fill(ax: Axes, mask: Volume) -> None:
    """Sternum and cartilages as areas."""
    x, z = -_grid_mm(mask, 0), _grid_mm(mask, 2)
    edges = (x.min(), x.max(), z.min(), z.max())
    cartilage = np.any([_silhouette(mask, part) for part in CARTILAGES], axis=0)
    for inside, colour in ((_silhouette(mask, Part.STERNUM), _STERNUM), (cartilage, _CARTILAGE)):
        area = np.where(inside, 1.0, np.nan)[np.argsort(x)].T
        _area(ax, area, edges, cmap=ListedColormap([colour]), alpha=0.8)


def _junctions(mask: Volume) -> Floats:
    """(8, 2) across and up the page: the end of each cartilage that is farthest from the sternum."""
    x, z = -_grid_mm(mask, 0), _grid_mm(mask, 2)
    middle = x[_silhouette(mask, Part.STERNUM).any(axis=1)].mean()
    ends = []
    for part in CARTILAGES:
        i, k = np.nonzero(_silhouette(mask, part))
        if len(i):
            outer = np.argsort(np.abs(x[i] - middle))[-max(1, len(i) // 50) :]
            ends.append([x[i[outer]].mean(), z[k[outer]].mean()])
    return np.array(ends)


def anatomy_overview(
    subjects: Mapping[str, tuple[Volume, Volume]], *, window_hu: tuple[float, float] = (-50.0, 600.0)
) -> Figure:
    """Each subject's cartilages over a coronal maximum projection of its CT.

    The projection runs over the slab in which the mask lies: the spine and the heart would cover it.

    Args:
        subjects: by name, Hounsfield units and `Part` values on the same grid or a crop of it.
        window_hu: darkest and brightest value.

    Raises:
        StudyError: no subject, an empty mask, or one on another grid.
    """
    require(subjects, "subjects")
    columns = min(3, len(subjects))
    rows = -(-len(subjects) // columns)
    figure = new_figure(0.7 + rows * 9.6 / columns, "Sternum and cartilages over the front of each CT")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, (name, (volume, mask)) in zip(grid, subjects.items(), strict=False):
        first = _place(volume, mask)
        depth = np.flatnonzero((mask.values >= 0).any(axis=(0, 2))) + first[1]
        projection = volume.values[:, depth[0] : depth[-1] + 1].max(axis=1)
        x, y = -_grid_mm(volume, 0), _grid_mm(volume, 2)
        _grey_image(ax, projection, x, y, window_hu)
        mine = [grid_mm[first[a] : first[a] + mask.shape[a]] for a, grid_mm in ((0, x), (2, y))]
        for part, colour in _DRAWN.items():
            silhouette = np.where((mask.values == part).any(axis=1), int(part), int(Part.UNKNOWN))
            _part_contours(ax, mine, silhouette, {part: colour}, linewidths=1.6)
        flat = (mask.values >= 0).any(axis=1)
        seen = np.column_stack([mine[0][np.nonzero(flat)[0]], mine[1][np.nonzero(flat)[1]]])
        spacing = " × ".join(f"{s:.2g}" for s in volume.spacing_mm)
        look(ax, "front", bounds(seen, margin_mm=30.0), f"{name} ({spacing} mm)", on_dark=True)
    for ax in grid[len(subjects) :]:
        ax.set_axis_off()
    part_legend(figure)
    return figure


def mesh_and_cloud(mesh: Mesh, cloud: PointCloud, *, T_cloud_chest: RigidTransform | None = None) -> Figure:
    """A surface and the cloud sampled from it, from the front, coloured by part (sec. II-C.1).

    Args:
        mesh, cloud: in one frame.
        T_cloud_chest: chest coordinates to that frame; None for RAS+.
    """
    vertices, points = (project(p, "front", T_cloud_chest) for p in (mesh.vertices, cloud.points))
    extent = bounds(vertices, points, margin_mm=16.0)
    figure = new_figure(4.6, f"{mesh.name}: surface and the cloud sampled from it")
    left, right = figure.subplots(1, 2)
    draw_surface(left, vertices, mesh.faces, part_colours(mesh.parts, len(vertices)))
    dots(right, points, part_colours(cloud.parts, len(points)), size=4)
    titles = (f"surface, {len(mesh.faces):,} triangles", f"cloud, {len(cloud):,} points")
    for ax, title in zip((left, right), titles, strict=True):
        look(ax, "front", extent, title)
    if cloud.parts is not None:
        name_parts(right, points, cloud.parts)
    part_legend(figure)
    return figure
