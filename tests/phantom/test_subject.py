"""Drawn people: invertible everywhere, repeatable, and as different as people are."""

import numpy as np
import pytest

from study.errors import StudyError
from study.params import PHANTOM_SEED
from study.phantom.clouds import reference_cloud
from study.phantom.planted import residual_mm
from study.phantom.subject import ROI_HIGH, ROI_LOW, SUBJECTS, SyntheticSubject, draw_subject
from study.phantom.truth import truth_map
from study.phantom.truth import waypoints as waypoints_of

SEED = 0


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
