"""The surface is a chest's: in RAS+, with separate cartilages of which the 5th bends most."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from study.phantom.clouds import reference_cloud
from study.phantom.subject import SUBJECTS, SyntheticSubject, draw_subject
from study.phantom.surface import canonical_surface, onto_surface
from study.phantom.wall import wall_distance
from study.types import CARTILAGES, Part, PointCloud

SEED = 0


def subject(name: str) -> SyntheticSubject:
    return draw_subject(name, SEED)


@pytest.fixture(scope="module")
def clouds() -> dict[str, PointCloud]:
    return {name: reference_cloud(subject(name), 4000, np.random.default_rng(0)) for name in SUBJECTS}


@pytest.mark.parametrize("name", SUBJECTS)
def test_the_frame_is_ras(clouds, name):
    cloud = clouds[name]
    middle = {part: cloud.only(part).mean(axis=0) for part in (Part.STERNUM, *CARTILAGES)}
    for level in (2, 3, 4, 5):
        right, left = middle[Part.cartilage("right", level)], middle[Part.cartilage("left", level)]
        assert right[0] > middle[Part.STERNUM][0] > left[0]
        if level < 5:
            assert right[2] > middle[Part.cartilage("right", level + 1)][2]
            assert left[2] > middle[Part.cartilage("left", level + 1)][2]
    # Bulging to the front: the far end of a cartilage lies behind its root.
    falls = []
    for part in CARTILAGES:
        points = cloud.only(part)
        lateral = np.abs(points[:, 0] - middle[Part.STERNUM][0])
        near, far = np.quantile(lateral, [0.15, 0.85])
        falls.append(points[lateral < near, 1].mean() - points[lateral > far, 1].mean())
    assert np.mean(falls) > 2  # 5 ± 4 mm on the open cohort


@pytest.mark.parametrize("name", SUBJECTS)
def test_cartilages_are_separate(clouds, name):
    """Neighbours are apart by a real intercostal gap, wider towards the ribs."""
    for side in ("right", "left"):
        for level in (2, 3, 4):
            upper, lower = (clouds[name].only(Part.cartilage(side, n)) for n in (level, level + 1))
            assert KDTree(upper).query(lower)[0].min() > 3


def test_the_fifth_cartilage_bends_most(clouds):
    for cloud in clouds.values():
        for side in ("right", "left"):
            bends = []
            for level in (2, 3, 4, 5):
                points = cloud.only(Part.cartilage(side, level))[:, [0, 2]]
                fit = np.polyfit(points[:, 0], points[:, 1], 1)
                bends.append(abs(np.degrees(np.arctan(fit[0]))))
            assert np.argmax(bends) == 3


def test_the_canonical_surface_lies_where_the_distance_is_zero_and_faces_outwards():
    surface = canonical_surface()
    used = np.unique(surface.faces)
    off = np.abs(wall_distance(surface.vertices[used]))
    assert np.quantile(off, 0.99) < 1e-3
    assert off.max() < 0.2  # in the creases where two parts meet, the gradient points to neither
    middle = surface.vertices[surface.faces].mean(axis=1)
    outside = middle + surface.normals / np.linalg.norm(surface.normals, axis=1, keepdims=True)
    assert (wall_distance(outside) > wall_distance(middle)).mean() > 0.99
    moved = onto_surface(surface.vertices[used[:500]] + np.array([0.0, 0.3, 0.0]))
    assert np.quantile(np.abs(wall_distance(moved)), 0.95) < 1e-3
