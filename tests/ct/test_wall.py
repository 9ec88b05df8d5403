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


def test_a_pick_lies_in_bone_where_no_lung_is_behind_and_off_bone_is_refused(
    drawn: tuple[Volume, Volume, np.ndarray],
) -> None:
    ct, _, _ = drawn
    grid = ct.to_mm(np.moveaxis(np.indices(ct.shape), 0, -1).reshape(-1, 3)).reshape(*ct.shape, 3)
    solid = (grid[..., 2] > 30.0) & (np.abs(grid[..., 0]) < 70.0) & (grid[..., 1] < -15.0)
    deep = anterior_wall_image(ct.with_values(np.where(solid, 40.0, ct.values).astype(np.float32)))
    assert abs(deep.pick(0.0, 60.0)[1] - 10.0) < 2.0  # the sternum's middle; the sheet behind it runs too deep
    with pytest.raises(StudyError, match="expected bone or cartilage"):
        deep.pick(40.0, 33.0)


def test_an_abdomen_is_said_to_be_one(drawn: tuple[Volume, Volume, np.ndarray]) -> None:
    ct, _, _ = drawn
    values = ct.values.copy()
    below = (
        ct.to_mm(np.stack([np.zeros(ct.shape[2]), np.zeros(ct.shape[2]), np.arange(ct.shape[2])], axis=1))[:, 2] < 40.0
    )
    values[:, :, below] = np.where(
        values[:, :, below] < -500, np.where(values[:, :, below] < -900, -1000, 40), values[:, :, below]
    )
    with pytest.raises(StudyError, match="abdomen"):
        anterior_wall_image(ct.with_values(values))
