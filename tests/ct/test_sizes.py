"""Sizes of drawn parts come back; density leaves calcifications out."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from study.ct.sizes import measure_anatomy
from study.errors import StudyError
from study.types import CARTILAGES, Part, RigidTransform, Volume

SHAPE = (200, 60, 160)
FRAME = RigidTransform(translation=np.array([-100.0, -20.0, -80.0]))
RADIUS_MM = 80.0  # of the arc that every cartilage is drawn on
ARC = 0.6  # radians of it


@pytest.fixture(scope="module")
def drawn() -> tuple[Volume, Volume]:
    mask = np.full(SHAPE, int(Part.UNKNOWN), np.int8)
    blank = Volume(mask, np.ones(3), FRAME)
    grid = blank.to_mm(np.moveaxis(np.indices(SHAPE), 0, -1).reshape(-1, 3)).reshape(*SHAPE, 3)
    for part in CARTILAGES:
        side, z = (1 if part.side == "right" else -1), 50.0 - 28.0 * (part.level - 2)
        x, y, up = grid[..., 0] * side - 20.0, grid[..., 1], grid[..., 2] - z + RADIUS_MM
        angle, out = np.arctan2(x, up), np.hypot(x, up) - RADIUS_MM  # an arc in the wall, bending downwards
        mask[(angle > 0) & (angle < ARC) & ((out / 7.0) ** 2 + (y / 4.5) ** 2 < 1)] = part
    mask[(np.abs(grid[..., 0]) < 15) & (np.abs(grid[..., 1]) < 6) & (np.abs(grid[..., 2] - 5) < 50)] = Part.STERNUM
    hu = np.where(mask > 0, 95.0, 40.0) + np.random.default_rng(0).normal(scale=10.0, size=SHAPE)
    hu[(mask > 0) & (np.random.default_rng(1).random(SHAPE) < 0.1)] = 500.0
    return blank.with_values(hu), blank.with_values(mask)


def table(frame: pd.DataFrame, quantity: str) -> pd.Series:
    return frame[frame.quantity == quantity].set_index("part").value


def test_drawn_sizes_are_measured(drawn: tuple[Volume, Volume]) -> None:
    frame = measure_anatomy(*drawn, "drawn")
    assert set(frame.part) == {*(part.name.lower() for part in Part if part >= 0), "cartilages"}
    assert (frame.subject == "drawn").all()
    names = [part.name.lower() for part in CARTILAGES]
    for quantity, value, tolerance in (
        ("length", RADIUS_MM * ARC, 2.0),
        ("width", 14.0, 0.7),
        ("thickness", 9.0, 0.7),
        ("bend", np.degrees(ARC) * 0.9, 5.0),  # less the loose twentieth at each end
        ("curvature", 1000 / RADIUS_MM, 2.5),
        ("volume", np.pi * 7.0 * 4.5 * RADIUS_MM * ARC, 150.0),
    ):
        assert np.abs(table(frame, quantity)[names] - value).max() < tolerance, quantity
    assert table(frame, "length")["sternum"] == pytest.approx(100.0, abs=2.0)
    assert table(frame, "width")["sternum"] == pytest.approx(30.0, abs=1.5)
    assert table(frame, "thickness")["sternum"] == pytest.approx(12.0, abs=1.2)


def test_density_is_that_of_uncalcified_cartilage(drawn: tuple[Volume, Volume]) -> None:
    frame = measure_anatomy(*drawn, "drawn")
    assert table(frame, "density_mean")["cartilages"] == pytest.approx(95.0, abs=0.5)
    assert table(frame, "density_sd")["cartilages"] == pytest.approx(10.0, abs=0.5)
    assert table(frame, "calcified_share")["cartilages"] == pytest.approx(0.1, abs=0.01)
    assert "sternum" not in table(frame, "density_mean")


def test_a_mask_without_a_part_is_refused(drawn: tuple[Volume, Volume]) -> None:
    ct, mask = drawn
    values = np.where(mask.values == Part.LEFT_3, int(Part.UNKNOWN), mask.values)
    with pytest.raises(StudyError, match="left_3"):
        measure_anatomy(ct, mask.with_values(values), "drawn")
    with pytest.raises(StudyError, match="expected uncalcified cartilage"):
        measure_anatomy(ct.with_values(np.full(ct.shape, 300.0)), mask, "drawn")
