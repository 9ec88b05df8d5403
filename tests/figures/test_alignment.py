"""The coarse alignment is drawn as it was seen: rectangles, edges, seeds, clouds before and after."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from figure_data import PARTS, POINTS
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from study import figures

VIEW = figures.CoarseView(
    plane=POINTS[:, [0, 2]],
    rectangles=[(5.0, np.zeros(2), 10.0), (3.0, np.ones(2), 4.0), (2.0, np.ones(2), 3.0)],
    local=POINTS[:, [0, 2]],
    edges_mm=(15.0, 14.0),
    seeds=np.array([[s * 20.0, y] for s in (-1, 1) for y in (-40.0, -20, 0, 20)]),
    chest=POINTS[:, [0, 2]] * [-1, 1],
    parts=PARTS,
)
SCORES = figures.ScoreView(
    values=np.linspace(0, 1, 600).reshape(20, 30),
    origin=np.array([-50.0, -70.0]),
    pixel_mm=5.0,
    angles_deg=np.arange(-90.0, 90.0, 10.0),
    best=np.linspace(0.3, 0.9, 18),
    plane=POINTS[:, [0, 2]],
    centre=np.array([0.0, 10.0]),
    angle_deg=20.0,
)
EXAMPLES: dict[str, Callable[[], Figure]] = {
    "coarse_steps": lambda: figures.coarse_steps({"CT": VIEW, "US": VIEW}),
    "score_maps": lambda: figures.score_maps({"CT": SCORES, "US": SCORES}),
    "coarse_overlay": lambda: figures.coarse_overlay(POINTS + 300.0, POINTS, POINTS + 1.0),
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "no scores": lambda: figures.score_maps({}),
    "no views": lambda: figures.coarse_steps({}),
    "a view without points": lambda: figures.coarse_steps({"CT": replace(VIEW, plane=np.zeros((0, 2)))}),
    "no points": lambda: figures.coarse_overlay(np.zeros((0, 3)), POINTS, POINTS),
}


def test_the_score_map_lies_at_its_millimetres() -> None:
    figure = figures.score_maps({"CT": SCORES})
    image = figure.axes[1].get_images()[0]
    np.testing.assert_allclose(image.get_extent(), [-52.5, 47.5, -72.5, 77.5])
    np.testing.assert_allclose(image.get_array(), SCORES.values.T)
    assert "$F_k$ at 20°, 5 mm a pixel" in figure.axes[1].get_title(loc="left")


def test_coarse_steps_shows_three_rectangles_and_eight_seeds_a_cloud() -> None:
    figure = EXAMPLES["coarse_steps"]()
    assert len(figure.axes) == 6
    rectangles = [p for p in figure.axes[0].patches if isinstance(p, Polygon)]
    assert len(rectangles) == 3
    corners = rectangles[0].get_xy()[:4]
    np.testing.assert_allclose(np.sort(np.linalg.norm(np.diff(corners, axis=0), axis=1)), [30, 30, 90])
    long = corners[2] - corners[1]
    np.testing.assert_allclose(np.degrees(np.arctan2(-long[0], long[1])), 10.0)  # counter-clockwise from y
    assert len(figure.axes[1].collections[1].get_offsets()) == 8


def test_before_the_alignment_only_the_patients_axes_are_named() -> None:
    before, after, _ = EXAMPLES["coarse_overlay"]().axes
    assert "US patient's axes" in before.get_xlabel()
    assert not before.texts
    assert {text.get_text() for text in after.texts} == {"R", "L"}
