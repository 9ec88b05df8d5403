"""A planted deformation has the size it promises, and breathing and bending ribs those of people."""

import numpy as np
import pytest

from study.errors import StudyError
from study.phantom.deformation import Deformation
from study.phantom.planted import breathing, planted_deformation, residual_mm, rib_bending
from study.types import RigidTransform

CENTRE = np.array([10.0, -5.0, 30.0])


@pytest.fixture(scope="module")
def chest() -> np.ndarray:
    """A plate with four arms a side, bulging: enough of a chest to deform."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-80, 80, 4000), rng.uniform(-5, 5, 4000)
    z = rng.choice([0.0, -30.0, -57.0, -90.0], 4000) + rng.uniform(-7, 7, 4000)
    return np.column_stack([x + 20.0, y - x**2 / 250 + 140.0, z + 1500.0])  # where a scanner may put it


def test_breathing_is_of_the_published_size():
    for seed in range(20):
        steps = breathing(CENTRE, np.random.default_rng(seed))
        at = CENTRE - (0, 0, 10)
        sides = at + np.array([[70.0, 0, 0], [-70.0, 0, 0]])
        moved = Deformation(steps).apply(np.concatenate([at[None], sides]))
        shift = moved - np.concatenate([at[None], sides])
        assert (shift[0, 1:] > 2.9).all()
        assert (shift[0, 1:] <= 5).all()
        assert 0.9 < shift[1, 0] <= 2  # the right side moves right
        assert -2 <= shift[2, 0] < -0.9


def test_ribs_bend_on_their_own():
    levels = np.array([0.0, -30.0, -60.0, -90.0])
    steps = rib_bending(np.zeros(3), levels, 2.5, 14.0, np.random.default_rng(0))
    ribs = np.array([[side * 55.0, 0.0, z] for z in levels for side in (1, -1)])
    shift = Deformation(steps).apply(ribs) - ribs
    assert (np.std(shift[:, 1:], axis=0) > 1.0).all()
    assert np.abs(shift[:, 0]).max() == 0


@pytest.mark.parametrize("size_mm", [3.0, 5.0, 7.5, 10.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_planted_deformation_has_its_size_and_inverse(chest, size_mm, seed):
    deformation = planted_deformation(chest, size_mm, np.random.default_rng(seed))
    moved = deformation.apply(chest)
    # The size is calibrated on a sample of the points, whose mean differs from all by a few per cent.
    assert residual_mm(chest, moved) == pytest.approx(size_mm, rel=0.05)
    assert np.abs(deformation.inverse(moved) - chest).max() < 1e-7
    around = chest + np.random.default_rng(3).normal(scale=20.0, size=chest.shape)
    assert deformation.jacobian_determinant(around).min() > 0.05


def test_the_same_rng_plants_the_same_deformation(chest):
    one, same, other = (planted_deformation(chest, 7.0, np.random.default_rng(s)).apply(chest) for s in (5, 5, 6))
    assert np.array_equal(one, same)
    assert np.abs(one - other).mean() > 2.0


def test_the_residual_ignores_rigid_motion(chest):
    motion = RigidTransform.random(np.random.default_rng(2))
    assert residual_mm(chest, motion.apply(chest)) < 1e-6
    bent = chest + np.column_stack([np.zeros(len(chest)), 10 * np.cos(chest[:, 2] / 20), np.zeros(len(chest))])
    assert residual_mm(chest, motion.apply(bent)) == pytest.approx(residual_mm(chest, bent), abs=1e-6)


@pytest.mark.parametrize("size_mm", [0.0, -1.0, np.nan, 0.2, 80.0])
def test_a_size_no_chest_can_have_is_refused(chest, size_mm):
    with pytest.raises(StudyError, match=r"expected .* got"):
        planted_deformation(chest, size_mm, np.random.default_rng(0))
