"""Several clouds side by side: in poses of their own, or by how far they lie off the truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from study.errors import StudyError
from study.figures.canvas import (
    WIDTH_IN,
    bounds,
    dots,
    draw_surface,
    look,
    new_figure,
    part_legend,
    plain,
    project,
    require,
)
from study.figures.style import part_colours
from study.types import CARTILAGES, Mesh, Part, PointCloud, RigidTransform

__all__ = ["cloud_errors", "pose_gallery"]


def pose_gallery(clouds: Mapping[str, PointCloud], title: str = "Seen along the third axis of its own frame") -> Figure:
    """Labelled clouds in the frames they came in, three a row: whatever the pose, the colours must agree.

    Args:
        clouds: by title, with parts.
        title: above them.

    Raises:
        StudyError: no cloud, or one without parts.
    """
    require(clouds, "clouds")
    rows = -(-len(clouds) // 3)
    figure = new_figure(0.7 + rows * 0.31 * WIDTH_IN, title)
    grid = figure.subplots(rows, 3, squeeze=False).ravel()
    reach = max(float(np.ptp(cloud.points[:, :2], axis=0).max()) for cloud in clouds.values()) / 2 + 20.0
    for ax, (name, cloud) in zip(grid, clouds.items(), strict=False):
        if cloud.parts is None:
            raise StudyError(f"{cloud.name}: expected labelled parts, got none; align the cloud first")
        seen = cloud.points - (cloud.points.max(axis=0) + cloud.points.min(axis=0)) / 2
        dots(ax, seen, part_colours(cloud.parts, len(cloud)))
        middle = seen[cloud.parts == Part.STERNUM].mean(axis=0)
        for part in CARTILAGES:
            branch = seen[cloud.parts == part]
            away = np.linalg.norm(branch - middle, axis=1)
            tip = branch[np.argsort(away)[-max(1, len(branch) // 20) :]].mean(axis=0)
            outwards = (tip - middle)[:2]
            x, y = tip[:2] + 9.0 * outwards / max(float(np.linalg.norm(outwards)), 1.0)
            halo = [withStroke(linewidth=2.5, foreground="white")]
            text = f"{part.side[0].upper()}{part.level}"
            ax.text(x, y, text, ha="center", va="center", fontsize=8, weight="bold", path_effects=halo)
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        plain(ax, name)
        ax.set_xlabel("first axis (mm)", fontsize=8)
        ax.set_ylabel("second axis (mm)", fontsize=8)
    for ax in grid[len(clouds) :]:
        ax.set_axis_off()
    part_legend(figure)
    return figure


def cloud_errors(
    clouds: Mapping[str, tuple[ArrayLike, ArrayLike]],
    mesh: Mesh,
    *,
    T_cloud_chest: RigidTransform | None = None,
    most_mm: float | None = None,
) -> Figure:
    """Clouds over the true surface from the front, coloured by their distance to it, on one scale.

    Args:
        clouds: by title, points (n, 3) mm and distances (n,) mm; three or so.
        mesh: the true surface, same frame.
        T_cloud_chest: chest coordinates to that frame; None for RAS+.
        most_mm: top of the scale; the 98th percentile of all distances when None.

    Raises:
        StudyError: no cloud.
    """
    require(clouds, "clouds")
    every = np.concatenate([np.asarray(distance, dtype=np.float64) for _, distance in clouds.values()])
    top = most_mm or max(1.0, float(np.ceil(np.percentile(every, 98))))
    vertices = project(mesh.vertices, "front", T_cloud_chest)
    extent = bounds(vertices, *(project(points, "front", T_cloud_chest) for points, _ in clouds.values()))
    wide, tall = np.ptp(extent, axis=0)
    figure = new_figure(0.9 + (WIDTH_IN - 1.6) / len(clouds) * tall / wide, "Distance of the cloud to the true surface")
    panels = figure.subplots(1, len(clouds), squeeze=False)[0]
    drawn: Any = None
    for ax, (name, (points, distance)) in zip(panels, clouds.items(), strict=True):
        draw_surface(ax, vertices, mesh.faces, np.full((len(vertices), 3), 0.93))
        values = np.asarray(distance, dtype=np.float64)
        drawn = dots(ax, project(points, "front", T_cloud_chest), values, cmap="viridis", vmin=0, vmax=top)
        look(ax, "front", extent, f"{name}: mean {values.mean():.2f} mm")
    bar = figure.colorbar(drawn, ax=panels, extend="max", shrink=0.8, pad=0.01)
    bar.set_label("distance (mm)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    return figure
