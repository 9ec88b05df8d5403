"""Pictures of the tracked sweep (sec. II-A to II-C.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from study.errors import StudyError
from study.figures.canvas import (
    WIDTH_IN,
    View,
    below,
    bounds,
    dots,
    draw_surface,
    look,
    new_figure,
    plain,
    project,
    require,
    thin,
)
from study.figures.style import CT_COLOUR, DARK, LEVEL_COLOUR, US_COLOUR, steps
from study.types import Bools, Floats, Mesh, PointCloud, RigidTransform

__all__ = ["frame_with_mask", "latency_fit", "sweep_in_space", "sweep_overview"]


def sweep_in_space(
    positions: ArrayLike,
    cloud: PointCloud,
    mesh: Mesh | None = None,
    *,
    times_s: ArrayLike | None = None,
    footprints: ArrayLike | None = None,
    T_cloud_chest: RigidTransform | None = None,
) -> Figure:
    """The probe's path over the cloud it gave and the surface it scanned, front and side.

    Args:
        positions: (p, 3) mm, of the probe, NaN where it was not tracked.
        cloud: what the sweep gave, same frame.
        mesh: the true surface, same frame, or None.
        times_s: (p,) s; colours the path. The number of the pose when None.
        footprints: (k, 2, 3) mm, both ends of the transducer in some frames, or None.
        T_cloud_chest: chest coordinates to that frame; None for RAS+.
    """
    path = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    tracked = np.isfinite(path).all(axis=1)
    require(np.flatnonzero(tracked), "tracked positions")
    clock = np.arange(len(path)) if times_s is None else np.asarray(times_s) - np.min(np.asarray(times_s))
    views: tuple[View, View] = ("front", "side")
    ends = np.zeros((0, 2, 3)) if footprints is None else np.asarray(footprints, dtype=np.float64)
    every = np.concatenate([path[tracked], cloud.points, ends.reshape(-1, 3)])
    extents = [bounds(project(every, view, T_cloud_chest)) for view in views]
    ratios = [float(np.divide(*np.ptp(extent, axis=0))) for extent in extents]
    tall = float(np.clip((WIDTH_IN - 2.4) / sum(ratios) + 1.3, 3.4, 7.5))
    figure = new_figure(tall, f"Virtual sweep of {cloud.name.rpartition(':')[2]}")
    panels = figure.subplots(1, 2, width_ratios=ratios)
    drawn: Any = None
    for ax, view, extent, title in zip(panels, views, extents, ("from the front", "from the right"), strict=True):
        if mesh is not None:
            vertices = project(mesh.vertices, view, T_cloud_chest)
            draw_surface(ax, vertices, mesh.faces, np.full((len(vertices), 3), 0.86))
        dots(ax, project(cloud.points, view, T_cloud_chest), US_COLOUR, size=3, alpha=0.7)
        if len(ends):
            pages = project(ends.reshape(-1, 3), view, T_cloud_chest)[:, :2].reshape(-1, 2, 2)
            ax.add_collection(LineCollection(list(pages), colors=DARK, linewidths=0.5, alpha=0.35))
        rows = np.flatnonzero(tracked)[thin(int(tracked.sum()), 3000)]
        line = project(path[rows], view, T_cloud_chest)
        drawn = ax.scatter(line[:, 0], line[:, 1], c=clock[rows], s=4, cmap=steps("plasma"), lw=0, rasterized=True)
        look(ax, view, extent, title)
    bar = figure.colorbar(drawn, ax=panels, shrink=0.7, pad=0.01)
    bar.set_label("pose number" if times_s is None else "time of the sweep (s)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    blue = Line2D([], [], ls="", marker="o", ms=4, color=US_COLOUR, label=f"cloud, {len(cloud):,} points")
    marks: list[Any] = [blue, Line2D([], [], color="#cc4778", lw=2.5, label="path of the probe")]
    marks += [Patch(color="#dbdbdb", label="true surface")] if mesh is not None else []
    marks += [Line2D([], [], color=DARK, lw=0.8, label="transducer, some frames")] if len(ends) else []
    below(figure, marks, 4)
    return figure


def sweep_overview(
    cloud: PointCloud,
    beam: Floats,
    shots: Sequence[tuple[str, NDArray[Any] | None, Bools]],
    pixel_spacing_mm: tuple[float, float],
    *,
    title: str,
) -> Figure:
    """What a sweep of one's own gave: its cloud as the probe saw it, and some frames with the edge that was used.

    Args:
        cloud: (n, 3) mm, any frame; coloured by its times where it has them.
        beam: (3,) unit vector, the mean direction of the beams, same frame.
        shots: of some frames a title, the image (h, w) or None, and the mask (h, w).
        pixel_spacing_mm: (sx, sy), lateral and along the beam.
        title: above it.

    Raises:
        StudyError: no frames to show.
    """
    require(shots, "frames")
    centred = cloud.points - cloud.points.mean(axis=0)
    flat = centred - np.outer(centred @ beam, beam)
    long = np.linalg.svd(flat, full_matrices=False)[2][0]
    across = np.cross(beam, long)  # long is up the page, the beam away from the viewer
    figure = new_figure(5.2, title)
    parts: Any = figure.subfigures(1, 2, width_ratios=[1, 1.15])
    left, right = parts
    ax = left.subplots()
    clock = centred @ beam if cloud.times is None else cloud.times - cloud.times.min()
    drawn = ax.scatter(centred @ across, centred @ long, c=clock, s=3, cmap=steps("plasma"), lw=0, rasterized=True)
    ax.set_aspect("equal")
    plain(ax, f"cloud, {len(cloud):,} points, seen from the probe")
    ax.set_xlabel("across the sweep's longest way (mm)", fontsize=8)
    ax.set_ylabel("along it (mm)", fontsize=8)
    bar = left.colorbar(drawn, ax=ax, shrink=0.7, pad=0.01)
    bar.set_label("depth (mm)" if cloud.times is None else "time of the sweep (s)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    panels = right.subplots(2, (len(shots) + 1) // 2, squeeze=False).ravel()
    sx, sy = pixel_spacing_mm
    for ax, (text, image, mask) in zip(panels, shots, strict=False):
        rows, columns = mask.shape
        behind = np.zeros(mask.shape) if image is None else image
        ax.imshow(behind, cmap="gray", extent=(-sx / 2, (columns - 0.5) * sx, (rows - 0.5) * sy, -sy / 2))
        seen = np.flatnonzero(mask.any(axis=0))
        ax.scatter(seen * sx, (mask.argmax(axis=0)[seen] - 0.5) * sy, s=1.5, c=LEVEL_COLOUR[3], lw=0)
        plain(ax, text)
    for ax in panels[len(shots) :]:
        ax.set_axis_off()
    return figure


def frame_with_mask(
    mask: ArrayLike,
    pixel_spacing_mm: tuple[float, float],
    image: ArrayLike | None = None,
    title: str = "Ultrasound frame and its mask",
) -> Figure:
    """A frame in mm with its mask; the transducer is at the top.

    Args:
        mask: (h, w) bool.
        pixel_spacing_mm: (sx, sy), lateral and along the beam.
        image: (h, w) grey, shown beside it, or None.
        title: above it.

    Raises:
        StudyError: a mask that is no image, or an image of another size.
    """
    shown = np.asarray(mask, dtype=bool)
    behind = np.zeros(shown.shape) if image is None else np.asarray(image)
    if shown.ndim != 2 or 0 in shown.shape or behind.shape != shown.shape:
        raise StudyError(f"expected a mask (rows, columns) and an image as large, got {shown.shape}, {behind.shape}")
    (rows, columns), (sx, sy) = shown.shape, pixel_spacing_mm
    extent = (-sx / 2, (columns - 0.5) * sx, (rows - 0.5) * sy, -sy / 2)
    overlay = np.zeros((*shown.shape, 4))
    overlay[shown] = (*to_rgb(LEVEL_COLOUR[3]), 1.0 if image is None else 0.75)
    titles = ["mask"] if image is None else ["frame", "frame and mask"]
    figure = new_figure(4.6, title)
    panels = figure.subplots(1, len(titles), sharey=True, squeeze=False)[0]
    for ax, text in zip(panels, titles, strict=True):
        ax.imshow(behind, cmap="gray", extent=extent)
        ax.set_xlabel("lateral (mm)", fontsize=8)
        plain(ax, text)
    panels[-1].imshow(overlay, extent=extent)
    panels[0].set_ylabel("depth (mm)", fontsize=8)
    return figure


def latency_fit(
    depths: ArrayLike, image_times: ArrayLike, heights: ArrayLike, robot_times: ArrayLike, latency_s: float
) -> Figure:
    """Landmark depth and tool height before and after the latency is taken out (sec. II-B).

    Args:
        depths: (f,) depth of the landmark in each image, pixels or mm, NaN where it was not seen.
        image_times: (f,) s.
        heights: (p,) mm.
        robot_times: (p,) s.
        latency_s: the latency found.

    Raises:
        StudyError: no depth inside the robot's recording.
    """
    depth, t_image, height, t_robot = (
        np.asarray(a, dtype=np.float64) for a in (depths, image_times, heights, robot_times)
    )
    require(t_robot, "heights")
    # Only frames that the robot's recording covers with and without the latency can be judged.
    late, early = max(0.0, latency_s), min(0.0, latency_s)
    seen = np.isfinite(depth) & (t_image - late >= t_robot[0]) & (t_image - early <= t_robot[-1])
    require(np.flatnonzero(seen), "depths inside the robot's recording")
    # Depths are brought to the height's scale by the fit at the latency found; the clock changes only the place.
    moved = np.interp(t_image[seen] - latency_s, t_robot, height)
    slope, offset = np.polyfit(depth[seen], moved, 1)
    figure = new_figure(4.4, f"Temporal calibration: latency {1000 * latency_s:.0f} ms")
    begin = float(t_robot[0])
    for ax, lag in zip(figure.subplots(2, 1, sharex=True), (0.0, latency_s), strict=True):
        ax.plot(t_robot - begin, height, color=DARK, lw=1.2, label="tool height, robot")
        times = t_image[seen] - lag
        misfit = slope * depth[seen] + offset - np.interp(times, t_robot, height)
        rms = float(np.sqrt(np.mean(misfit**2)))
        ax.scatter(
            times - begin, slope * depth[seen] + offset, s=8, c=CT_COLOUR, lw=0, label="landmark depth, images, scaled"
        )
        text = "as stamped" if lag == 0 else f"images moved back by {1000 * lag:.0f} ms"
        plain(ax, f"{text}: root mean square misfit {rms:.2f} mm")
        ax.set_ylabel("height (mm)", fontsize=8)
        ax.grid(alpha=0.25)
    ax.set_xlabel("time (s)", fontsize=8)
    ax.set_xlim(0, min(float(t_robot[-1]) - begin, 12.0))
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return figure
