"""The truth between two people is exact, and waypoints lie where the paper's do."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from study.phantom.clouds import reference_cloud
from study.phantom.subject import SUBJECTS, SyntheticSubject, draw_subject
from study.phantom.truth import truth_map, waypoints
from study.types import CARTILAGES, Part, PointCloud

SEED = 0


def subject(name: str) -> SyntheticSubject:
    return draw_subject(name, SEED)


@pytest.fixture(scope="module")
def clouds() -> dict[str, PointCloud]:
    return {name: reference_cloud(subject(name), 4000, np.random.default_rng(0)) for name in SUBJECTS}


def test_the_truth_map_goes_there_and_back(clouds):
    points = clouds["ct2"].points
    there = truth_map(subject("ct2"), subject("patient"), points)
    assert np.abs(there - points).mean() > 2.0
    assert np.abs(truth_map(subject("patient"), subject("ct2"), there) - points).max() < 1e-6
    via = truth_map(subject("ct2"), subject("ct4"), points)
    assert np.abs(truth_map(subject("ct4"), subject("patient"), via) - there).max() < 1e-6


def test_the_truth_map_takes_surface_to_surface_part_by_part(clouds):
    mapped = truth_map(subject("ct3"), subject("patient"), clouds["ct3"].points)
    dense = reference_cloud(subject("patient"), 40_000, np.random.default_rng(1))
    for part in (Part.STERNUM, *CARTILAGES):
        distance, _ = KDTree(dense.only(part)).query(mapped[clouds["ct3"].parts == part])
        assert distance.max() < 3.5  # 40,000 points on such a surface leave holes of up to that
        assert distance.mean() < 0.8


def test_the_truth_map_takes_waypoints_to_waypoints():
    one, other = waypoints(subject("ct1")), waypoints(subject("patient"))
    mapped = truth_map(subject("ct1"), subject("patient"), one.points)
    assert np.abs(mapped - other.points).max() < 1e-6
    assert one.labels == other.labels


@pytest.mark.parametrize("name", SUBJECTS)
def test_there_are_20_waypoints_in_the_gaps(clouds, name):
    places = waypoints(subject(name))
    assert len(places) == len(set(places.labels)) == 20
    counts = {key: sum(label.startswith(key) for label in places.labels) for key in ("R2-3", "L3-4", "R4-5")}
    assert counts == {"R2-3": 3, "L3-4": 3, "R4-5": 4}
    for label, place in zip(places.labels, places.points, strict=True):
        side, upper = {"R": "right", "L": "left"}[label[0]], int(label[1])
        near = [KDTree(clouds[name].only(Part.cartilage(side, level))).query(place)[0] for level in (upper, upper + 1)]
        others = [
            KDTree(clouds[name].only(part)).query(place)[0]
            for part in CARTILAGES
            if part not in (Part.cartilage(side, upper), Part.cartilage(side, upper + 1))
        ]
        assert min(near) > 2
        assert max(near) < min(others)
        assert max(near) < 25
    medial = [
        np.abs(places.points[places.labels.index(f"L2-3.{k}"), 0] - clouds[name].only(Part.STERNUM)[:, 0].mean())
        for k in (1, 2, 3)
    ]
    assert medial == sorted(medial)
