"""Landmarks and outlines are drawn where they lie, with axes of the CT's own millimetres."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from drawn_chest import draw, drawn_landmarks
from matplotlib.figure import Figure

from study import figures
from study.ct.wall import WallImage, anterior_wall_image
from study.errors import StudyError
from study.types import Part, Volume


@cache
def chest() -> tuple[Volume, WallImage, Volume]:
    """A drawn CT, without its noise, which makes large files; its flattened front and its true parts."""
    ct, labels, parts = draw()
    ct = ct.with_values(np.round(ct.values / 60.0) * 60.0)
    return ct, anterior_wall_image(ct), labels.with_values(parts.astype(np.int8))


EXAMPLES: dict[str, Callable[[], Figure]] = {
    "chest_front": lambda: figures.chest_front(chest()[1], drawn_landmarks(), chest()[2]),
    "axial_slices": lambda: figures.axial_slices(chest()[0], [20.0, -5.0]),
    "landmark_panels": lambda: figures.landmark_panels(chest()[0], drawn_landmarks(), chest()[2]),
}
REFUSED: dict[str, Callable[[], Figure]] = {"axial_slices": lambda: figures.axial_slices(chest()[0], [])}


def test_crosses_lie_at_the_landmarks_and_the_patients_right_is_at_the_left() -> None:
    (ax,) = EXAMPLES["chest_front"]().axes
    crosses = np.array([line.get_xydata()[0] for line in ax.lines])
    marks = drawn_landmarks()
    points = np.vstack([*marks.junctions.values(), *marks.attachments.values(), marks.sternum])
    assert sorted(map(tuple, crosses)) == sorted(map(tuple, points[:, [0, 2]]))
    assert ax.get_xlim()[0] > ax.get_xlim()[1]


def test_each_landmark_has_a_panel_in_which_3_mm_can_be_judged() -> None:
    figure = EXAMPLES["landmark_panels"]()
    panels = [ax for ax in figure.axes if ax.axison]
    assert len(panels) == 18
    assert sum(ax.get_title(loc="left").startswith("junction right 2,") for ax in panels) == 1
    figure.draw_without_rendering()
    ax = panels[0]
    a, b = ax.transData.transform([[0.0, 0.0], [3.0, 0.0]])
    assert abs(a[0] - b[0]) >= 12


def test_an_outline_lies_on_the_part_that_grew() -> None:
    _, wall, parts = chest()
    alone = parts.with_values(np.where(parts.values == Part.LEFT_3, parts.values, int(Part.UNKNOWN)).astype(np.int8))
    (ax,) = figures.chest_front(wall, None, alone).axes
    (outline,) = [path for drawn in ax.collections for path in drawn.get_paths() if len(path.vertices)]
    inside = parts.to_mm(np.argwhere(alone.values == Part.LEFT_3))[:, [0, 2]]
    assert np.abs(outline.vertices.min(axis=0) - inside.min(axis=0)).max() < 2.0
    assert np.abs(outline.vertices.max(axis=0) - inside.max(axis=0)).max() < 2.0


def test_a_slice_outside_the_image_is_refused() -> None:
    with pytest.raises(StudyError, match="expected slices at"):
        figures.axial_slices(chest()[0], [900.0])
