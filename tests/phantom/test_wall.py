"""The canonical wall is a distance with known places on it, the same on both sides."""

import numpy as np
import pytest

from study.phantom.wall import (
    BODY_BOTTOM_MM,
    BONE,
    CARTILAGE,
    COURSES,
    HALF_WIDTH_MM,
    STERNUM_HALF_THICKNESS_MM,
    centrelines,
    sternum_distance,
    sternum_half_width,
    tube_distance,
    wall_distance,
)


def test_the_wall_is_the_same_on_both_sides():
    points = np.random.default_rng(0).uniform((-110, -8, -150), (110, 8, 60), (5000, 3))
    assert np.array_equal(sternum_distance(points), sternum_distance(points * [-1, 1, 1]))
    assert wall_distance(points) == pytest.approx(wall_distance(points * [-1, 1, 1]), abs=1e-9)


@pytest.mark.parametrize("level", [2, 3, 4, 5])
def test_a_cartilage_is_as_long_and_wide_as_its_course_says(level):
    lines = centrelines()
    for side in (1, -1):
        mine = (lines.level == level) & (lines.side == side)
        cartilage = mine & (lines.tissue == CARTILAGE)
        assert lines.arc[cartilage].max() == pytest.approx(COURSES[level][0], abs=0.3)  # samples are 0.25 mm apart
        assert lines.arc[mine & (lines.tissue == BONE)].min() == pytest.approx(COURSES[level][0], abs=0.3)
        middle = np.flatnonzero(mine)[np.searchsorted(lines.arc[mine], COURSES[level][0] / 2)]
        across = np.array([-lines.tangent[middle, 1], lines.tangent[middle, 0]])
        place = lines.xz[middle] + HALF_WIDTH_MM[level] * across
        on_the_edge = np.array([[place[0], 0.0, place[1]]])
        assert tube_distance(on_the_edge)[0] == pytest.approx(0.0, abs=0.05)


def test_the_sternum_is_a_plate_of_its_outline_and_thickness():
    for z in (-80.0, -45.0, 0.0, 30.0):
        half = float(sternum_half_width(np.array([z]))[0])
        on_the_edge = np.array([[half, 0.0, z], [0.0, STERNUM_HALF_THICKNESS_MM, z], [0.0, 0.0, z]])
        # The edge is the nearest of samples 0.25 mm apart.
        assert sternum_distance(on_the_edge)[:2] == pytest.approx([0.0, 0.0], abs=0.2)
        assert sternum_distance(on_the_edge)[2] < -4.0
    ends = sternum_half_width(np.array([BODY_BOTTOM_MM, -999.0, 999.0]))
    assert ends == pytest.approx([*sternum_half_width(np.array([BODY_BOTTOM_MM, -128.0, 49.0]))])
