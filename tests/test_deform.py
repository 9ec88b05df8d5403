"""Every planted deformation undoes itself, folds nowhere and has the size it promises."""

import numpy as np
import pytest

from study.deform import (
    Affine,
    Bumps,
    Deformation,
    Ramp,
    Roll,
    breathing,
    planted_deformation,
    residual_mm,
    rib_bending,
)
from study.errors import StudyError
from study.types import RigidTransform

CENTRE = np.array([10.0, -5.0, 30.0])
STEPS = {
    "stretch": Affine.stretch(np.array([1.1, 0.9, 1.2]), CENTRE),
    "motion": Affine.motion(np.array([10.0, -20.0, 30.0]), np.array([5.0, 6.0, 7.0]), CENTRE),
    "roll": Roll(120.0, 2e-3),
    "knee": Ramp(1, 2, -0.3, 0.0, 3.0),
    "half stretch": Ramp(0, 0, 0.4, 15.0, 4.0),
    "half squeeze below": Ramp(0, 0, 0.5, -15.0, 4.0, direction=-1),
    "bump along itself": Bumps.one(2, (50, 0, 0), (30, np.inf, 15), 10.0),
    "wall": Bumps.one(1, (0, 0, 0), (45, np.inf, np.inf), 20.0),
}


def box(n: int = 3000, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-150, -70, -160), (150, 30, 70), (n, 3))


@pytest.fixture(scope="module")
def chest() -> np.ndarray:
    """A plate with four arms a side, bulging: enough of a chest to deform."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-80, 80, 4000), rng.uniform(-5, 5, 4000)
    z = rng.choice([0.0, -30.0, -57.0, -90.0], 4000) + rng.uniform(-7, 7, 4000)
    return np.column_stack([x + 20.0, y - x**2 / 250 + 140.0, z + 1500.0])  # where a scanner may put it


@pytest.mark.parametrize("name", STEPS)
def test_a_step_is_undone_and_keeps_orientation(name):
    points = box()
    deformation = Deformation((STEPS[name],))
    moved = deformation.apply(points)
    assert np.abs(moved - points).max() > 1.0
    assert np.abs(deformation.inverse(moved) - points).max() < 1e-8
    assert np.abs(deformation.apply(deformation.inverse(points)) - points).max() < 1e-8
    assert deformation.jacobian_determinant(points).min() > 0


def test_inputs_stay_as_they_are():
    points = box(100)
    points.flags.writeable = False
    for step in STEPS.values():
        step.apply(points)
        step.inverse(points)
    assert np.array_equal(points, box(100))


def test_a_chain_is_the_steps_in_order():
    first, second = STEPS["knee"], STEPS["roll"]
    chain = Deformation((first,)).then(second)
    assert np.allclose(chain.apply(box()), second.apply(first.apply(box())))


def test_the_jacobian_of_a_stretch_is_its_volume_change():
    assert np.allclose(Deformation((STEPS["stretch"],)).jacobian_determinant(box()), 1.1 * 0.9 * 1.2)


def test_a_motion_is_rigid():
    assert residual_mm(box(), STEPS["motion"].apply(box())) < 1e-9
    assert np.allclose(STEPS["motion"].apply(CENTRE[None]), CENTRE + np.array([5.0, 6.0, 7.0]))


def test_the_roll_keeps_arc_length_and_the_midline():
    arc = np.column_stack([np.linspace(-80, 80, 2001), np.zeros(2001), np.full(2001, -40.0)])
    rolled = Roll(120.0, 2e-3).apply(arc)
    assert np.linalg.norm(np.diff(rolled, axis=0), axis=1).sum() == pytest.approx(160.0, abs=1e-3)
    assert np.allclose(rolled[1000], arc[1000])
    assert (rolled[[0, -1], 1] < -20).all()  # the chest falls back to both sides


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


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Bumps.one(2, (0, 0, 0), (np.inf, np.inf, 5.0), 10.0), "fold"),
        (lambda: Ramp(0, 0, -1.0, 0.0, 3.0), "fold"),
        (lambda: Affine.stretch(np.array([-1.0, 1.0, 1.0]), CENTRE), "mirrored"),
        (lambda: Roll(50.0, 0.0).apply(np.array([[0.0, -60.0, 0.0]])), "axis of the chest"),
    ],
)
def test_what_would_fold_or_mirror_is_refused(make, words):
    with pytest.raises(StudyError, match=words):
        make()


@pytest.mark.parametrize("size_mm", [0.0, -1.0, np.nan, 0.2, 80.0])
def test_a_size_no_chest_can_have_is_refused(chest, size_mm):
    with pytest.raises(StudyError, match=r"expected .* got"):
        planted_deformation(chest, size_mm, np.random.default_rng(0))
