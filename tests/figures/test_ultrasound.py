"""Sweeps, frames and latencies are drawn in their own units, the transducer at the top."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from figure_data import CLOUD, FRONT, POINTS, TETRAHEDRON, texts
from matplotlib.figure import Figure

from study import figures

TIMES = np.arange(0, 10, 0.05)
EXAMPLES: dict[str, Callable[[], Figure]] = {
    "sweep_in_space": lambda: figures.sweep_in_space(POINTS + 30.0 * FRONT, CLOUD, TETRAHEDRON),
    "frame_with_mask": lambda: figures.frame_with_mask(np.eye(20, 30, dtype=bool), (0.2, 0.1), np.ones((20, 30))),
    "sweep_overview": lambda: figures.sweep_overview(
        CLOUD, -FRONT, [("frame 1", np.eye(20, 30), np.eye(20, 30, dtype=bool))] * 2, (0.2, 0.1), title="a sweep"
    ),
    "latency_fit": lambda: figures.latency_fit(100 + 5 * np.sin(TIMES - 0.268), TIMES, np.sin(TIMES), TIMES, 0.268),
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "untracked": lambda: figures.sweep_in_space(np.full((5, 3), np.nan), CLOUD),
    "no frame": lambda: figures.frame_with_mask(np.zeros((0, 4)), (0.2, 0.2)),
    "frame of another size": lambda: figures.frame_with_mask(np.ones((4, 4)), (0.2, 0.2), np.ones((4, 5))),
    "no shots": lambda: figures.sweep_overview(CLOUD, -FRONT, [], (0.2, 0.1), title="a sweep"),
    "no depths": lambda: figures.latency_fit([np.nan] * 3, [0, 1, 2], [0, 1], [0, 1], 0.1),
}


def test_frame_has_its_size_in_millimetres_and_depth_points_down() -> None:
    figure = EXAMPLES["frame_with_mask"]()
    assert len(figure.axes) == 2
    image = figure.axes[0].get_images()[0]
    np.testing.assert_allclose(image.get_extent(), (-0.1, 5.9, 1.95, -0.05))
    bottom, top = figure.axes[0].get_ylim()
    assert bottom > top


def test_latency_fit_prints_a_smaller_misfit_after_the_shift() -> None:
    figure = EXAMPLES["latency_fit"]()
    before, after = (float(ax.get_title(loc="left").split("misfit ")[1].split()[0]) for ax in figure.axes)
    assert after < 0.01 < 0.15 < before
    assert "268 ms" in texts(figure)


def test_the_legend_of_a_sweep_names_only_what_is_drawn() -> None:
    assert "true surface" in texts(EXAMPLES["sweep_in_space"]())
    alone = texts(figures.sweep_in_space(POINTS, CLOUD, footprints=np.stack([POINTS[:5], POINTS[5:10]], axis=1)))
    assert "true surface" not in alone
    assert "transducer, some frames" in alone
