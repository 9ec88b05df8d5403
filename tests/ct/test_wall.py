"""The picture in which a landmark is picked."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_chest import attachment, junction

from study.ct.wall import anterior_wall_image
from study.errors import StudyError
from study.types import CARTILAGES, Volume


def test_flattened_wall_gives_depth_under_a_pick(drawn: tuple[Volume, Volume, np.ndarray]) -> None:
    ct, _, _ = drawn
    wall = anterior_wall_image(ct)
    assert wall.image.shape == wall.depth_mm.shape == (len(wall.z_mm), len(wall.x_mm))
    for part in CARTILAGES:
        middle = (junction(part) + attachment(part)) / 2
        assert np.linalg.norm(wall.pick(middle[0], middle[2]) - middle) < 4.0
    bright = wall.image[np.abs(wall.z_mm - 45.0).argmin(), np.abs(wall.x_mm - 40.0).argmin()]
    gap = wall.image[np.abs(wall.z_mm - 33.0).argmin(), np.abs(wall.x_mm - 40.0).argmin()]
    assert bright > gap + 20.0
    with pytest.raises(StudyError, match="outside the picture"):
        wall.pick(900.0, 0.0)
    with pytest.raises(StudyError, match="expected lungs"):
        anterior_wall_image(ct.with_values(np.full(ct.shape, 50, np.int16)))
