"""Every step of a deformation undoes itself and folds nowhere."""

import numpy as np
import pytest

from study.errors import StudyError
from study.phantom.deformation import Affine, Bumps, Deformation, Ramp, Roll
from study.phantom.planted import residual_mm

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
