"""Drawn people: invertible everywhere, repeatable, and as different as people are."""

from hashlib import sha256

import numpy as np
import pytest

from study.errors import StudyError
from study.params import PHANTOM_SEED, POPULATION_SEED
from study.phantom import subject as drawing
from study.phantom.clouds import reference_cloud
from study.phantom.deformation import Affine, Bumps, Deformation
from study.phantom.planted import residual_mm
from study.phantom.sizes import CARTILAGE_MM, MANUBRIUM_MM, MAX_SD
from study.phantom.subject import (
    POPULATION,
    ROI_HIGH,
    ROI_LOW,
    SUBJECTS,
    SyntheticSubject,
    draw_subject,
    is_invertible,
)
from study.phantom.truth import measures, truth_map
from study.phantom.truth import waypoints as waypoints_of

SEED = 0
AS_EVER = "e68b1175c52bd4749d4b5e784095b325a4d5be74e676b85517904d33f1044148"


def subject(name: str) -> SyntheticSubject:
    return draw_subject(name, SEED)


@pytest.mark.parametrize("name", SUBJECTS)
def test_phi_is_invertible_and_folds_nowhere(name):
    person = subject(name)
    points = np.random.default_rng(0).uniform(ROI_LOW, ROI_HIGH, (20_000, 3))
    assert np.abs(person.phi.inverse(person.phi.apply(points)) - points).max() < 1e-6
    assert person.phi.jacobian_determinant(points).min() > 0.05


def test_the_same_name_and_seed_draw_the_same_person():
    points = np.random.default_rng(0).uniform(-50, 50, (100, 3))
    first, again = (draw_subject("ct3", 7).phi.apply(points) for _ in range(2))
    assert np.array_equal(first, again)
    assert np.abs(first - draw_subject("ct3", 8).phi.apply(points)).max() > 1
    assert np.abs(first - draw_subject("ct4", 7).phi.apply(points)).max() > 1


def test_the_reported_subjects_differ_as_people_do():
    """5-10 mm after rigid alignment is what the coarse alignment leaves; the mean over the cohort must lie there."""
    people = {name: draw_subject(name, PHANTOM_SEED) for name in SUBJECTS}
    patient = people.pop("patient")
    surface, waypoints = [], []
    for person in people.values():
        points = reference_cloud(person, 2000, np.random.default_rng(0)).points
        places = waypoints_of(person).points
        surface.append(residual_mm(points, truth_map(person, patient, points)))
        waypoints.append(residual_mm(places, waypoints_of(patient).points))
    assert len(surface) == 5
    assert 5 < np.mean(surface) < 10
    assert 5 < np.mean(waypoints) < 10
    assert min(surface) > 2


@pytest.mark.parametrize("name", ["ct6", "", "Patient"])
def test_an_unknown_subject_is_refused(name):
    with pytest.raises(StudyError, match=r"ct1, ct2.*patient"):
        draw_subject(name, 0)


# --- people of the whole spread --------------------------------------------------------------------------------------


def test_reported_and_tuning_people_are_drawn_as_ever():
    """Bytes of where the people of every seed used so far put a few points; all results hang on them."""
    points = np.array([[x, y, z] for x in (-60.0, 5.0, 45.0) for y in (-10.0, 6.0) for z in (-110.0, -30.0, 35.0)])
    seeds = (0, PHANTOM_SEED, *range(101, 107), *range(201, 209), *range(301, 307), *range(401, 411))
    drawn = [draw_subject(name, seed) for seed in seeds for name in SUBJECTS]
    places = np.round([person.phi.apply(points) for person in drawn], 6) + 0.0  # no -0; libm differs in the last bits
    rest = np.round([[person.fat_mm, person.cartilage_hu] for person in drawn], 6)
    assert sha256(places.tobytes() + rest.tobytes()).hexdigest() == AS_EVER


def test_the_population_differs_is_invertible_and_goes_beyond_the_reported_spread():
    # Twelve people alone may all have a usual manubrium: those of the seed before are draws of the same spread.
    people = [draw_subject(name, seed, np.inf) for seed in (POPULATION_SEED, 501) for name in POPULATION]
    assert len(people) >= 24
    points = np.random.default_rng(0).uniform(ROI_LOW, ROI_HIGH, (4000, 3))
    for person in people:
        assert np.abs(person.phi.inverse(person.phi.apply(points)) - points).max() < 1e-6
        assert person.phi.jacobian_determinant(points).min() > 0.05
    places = [person.phi.apply(points[:200]) for person in people]
    apart = [np.abs(a - b).mean() for k, a in enumerate(places) for b in places[:k]]
    assert min(apart) > 1.0
    sizes = [measures(person) for person in people]
    beyond = [abs(size["cartilage_left_5_mm"] - CARTILAGE_MM[5][0]) / CARTILAGE_MM[5][1] > MAX_SD for size in sizes]
    low, high = (f(m + s * MAX_SD * sd for m, sd in MANUBRIUM_MM) for f, s in ((min, -1), (max, 1)))
    assert sum(beyond) >= 1
    assert any(not low < size["manubrium_mm"] < high for size in sizes)


def test_a_wider_spread_draws_other_people_and_a_narrow_one_people_alike():
    points = np.random.default_rng(0).uniform(-50, 50, (100, 3))
    cut, whole, narrow = (draw_subject("ct1", 5, spread).phi.apply(points) for spread in (MAX_SD, np.inf, 1e-6))
    other = draw_subject("ct2", 5, 1e-6).phi.apply(points)
    assert np.abs(cut - whole).max() > 1
    assert np.array_equal(whole, draw_subject("ct1", 5, np.inf).phi.apply(points))
    assert np.abs(narrow - other).max() < np.abs(cut - draw_subject("ct2", 5).phi.apply(points)).max()
    with pytest.raises(StudyError, match="expected max_sd > 0"):
        draw_subject("ct1", 5, 0.0)


def test_a_draw_that_cannot_be_inverted_is_drawn_again_and_not_for_ever(monkeypatch):
    whole, drawn = drawing._draw, []

    def fold_twice(name, seed, max_sd, rng):
        drawn.append(rng.normal())
        if len(drawn) == 1:
            raise StudyError("a step that folds")
        person = whole(name, seed, max_sd, rng)
        flat = Deformation((Affine.stretch(np.array([1, 1, 1e-3]), np.zeros(3)),))
        return SyntheticSubject(name, seed, flat, 10.0, 100.0) if len(drawn) == 2 else person

    monkeypatch.setattr(drawing, "_draw", fold_twice)
    assert is_invertible(draw_subject("p01", 1, np.inf).phi)
    assert len(drawn) == len(set(drawn)) == 3

    def always_fold(*_):
        raise StudyError("a step that folds")

    monkeypatch.setattr(drawing, "_draw", always_fold)
    with pytest.raises(StudyError, match="p01: expected an invertible person in 50 draws"):
        draw_subject("p01", 1, np.inf)


def test_what_cannot_be_undone_or_folds_is_not_invertible():
    assert is_invertible(Deformation())
    assert not is_invertible(Deformation((Affine.stretch(np.array([1, 1, 0.01]), np.zeros(3)),)))

    class Folded(Bumps):
        def __post_init__(self):
            """Any slope."""

    steep = Folded(0, np.zeros((1, 3)), np.full((1, 3), 20.0), np.array([80.0]))
    assert not is_invertible(Deformation((steep,)))
