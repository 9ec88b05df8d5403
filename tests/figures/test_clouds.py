"""Clouds side by side: each named, on one scale."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from figure_data import CLOUD, POINTS, TETRAHEDRON, texts
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from study import figures
from study.types import PointCloud

DISTANCES_MM = np.linspace(0, 2, len(POINTS))
EXAMPLES: dict[str, Callable[[], Figure]] = {
    "pose_gallery": lambda: figures.pose_gallery({"one": CLOUD, "other": CLOUD}),
    "cloud_errors": lambda: figures.cloud_errors(
        {"a": (POINTS, DISTANCES_MM), "b": (POINTS, 2 * DISTANCES_MM)}, TETRAHEDRON
    ),
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "no clouds": lambda: figures.pose_gallery({}),
    "a cloud without parts": lambda: figures.pose_gallery({"one": PointCloud(POINTS, "one")}),
    "no errors": lambda: figures.cloud_errors({}, TETRAHEDRON),
}


def test_every_cloud_is_named_and_its_branches_too() -> None:
    shown = texts(EXAMPLES["pose_gallery"]())
    assert all(shown.count(f"{side}{level}\n") == 2 for side in "RL" for level in (2, 3, 4, 5))
    assert "one" in shown
    assert "other" in shown


def test_distances_share_one_scale_and_each_mean_is_printed() -> None:
    figure = EXAMPLES["cloud_errors"]()
    drawn = [one for one in figure.findobj(PathCollection) if one.get_array() is not None]
    assert {one.get_clim() for one in drawn} == {(0, 4)}  # the 98th percentile of all distances, rounded up
    assert "a: mean 1.00 mm" in texts(figure)
    assert "b: mean 2.00 mm" in texts(figure)
