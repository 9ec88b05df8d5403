"""Clouds of a subject: as asked, uniform, repeatable; a probe sees the front sheet."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from study.phantom.clouds import anterior_cloud, reference_cloud
from study.phantom.subject import SUBJECTS, SyntheticSubject, draw_subject
from study.types import CARTILAGES, Part, PointCloud

SEED = 0


def subject(name: str) -> SyntheticSubject:
    return draw_subject(name, SEED)


@pytest.fixture(scope="module")
def clouds() -> dict[str, PointCloud]:
    return {name: reference_cloud(subject(name), 4000, np.random.default_rng(0)) for name in SUBJECTS}


def test_the_reference_cloud_is_as_asked_and_uniform(clouds):
    cloud = clouds["ct1"]
    assert len(cloud) == 4000
    assert set(np.unique(cloud.parts)) == {int(part) for part in (Part.STERNUM, *CARTILAGES)}
    spacing = KDTree(cloud.points).query(cloud.points, k=8)[0][:, -1]
    assert np.quantile(spacing, 0.99) < 2.5 * np.median(spacing)


def test_the_anterior_cloud_is_the_front_sheet():
    person = subject("patient")
    front = anterior_cloud(person, 3000, 0.0, 0, np.random.default_rng(0))
    depth = person.phi.inverse(front.points)[:, 1]
    assert depth.min() > 0.5  # in front of the middle of the wall
    noisy = anterior_cloud(person, 3000, 0.5, 0, np.random.default_rng(0))
    assert np.std(noisy.points - front.points) == pytest.approx(0.5, rel=0.05)
    torn = anterior_cloud(person, 3000, 0.0, 8, np.random.default_rng(0))
    hole = KDTree(torn.points).query(front.points)[0]
    assert (hole > 1.5).mean() > (KDTree(front.points).query(torn.points)[0] > 1.5).mean() + 0.02
    assert len(torn) == 3000


def test_clouds_repeat_with_their_rng():
    one, same = (anterior_cloud(subject("patient"), 500, 0.5, 4, np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(one.points, same.points)
