"""What a probe can see: the fixture and the part of the surface."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import KDTree
from small_sweeps import FRONT, arch_mm

from study.errors import StudyError
from study.geometry.rays import surface_distance_mm
from study.types import Mesh
from study.ultrasound.visible import true_parts, visible_mesh, visible_surface


def test_the_fixture_is_even_first_hit_and_labelled(chest):
    cloud = visible_surface(chest, FRONT, 2.0, np.random.default_rng(1))
    assert surface_distance_mm(cloud.points, chest).max() < 0.01
    assert set(cloud.parts) == set(range(9))
    # Nothing of the posterior half of a tube: 5 mm in front of the axis to 0, none behind.
    arch = arch_mm(cloud.points[:, 0], cloud.points[:, 2])
    assert (cloud.points[:, 1] - arch).min() > -1.5
    spacing = KDTree(cloud.points).query(cloud.points, k=2)[0][:, 1]
    assert 0.8 < np.median(spacing) < 2.4
    with pytest.raises(StudyError, match="spacing"):
        visible_surface(chest, FRONT, 0.0, np.random.default_rng(1))


def test_the_visible_part_is_the_surface_in_front(chest, seen):
    assert 0.3 < len(seen.faces) / len(chest.faces) < 0.6
    assert set(map(tuple, seen.vertices)) < set(map(tuple, chest.vertices))
    assert (true_parts(seen.vertices, chest) == seen.parts).all()
    for mesh, faces in ((chest, (-5.0, 5.0)), (seen, (5.0, 5.0))):  # of the plate: back and front, then front alone
        x, y, z = mesh.vertices[(np.abs(mesh.vertices[:, 0]) < 10) & (np.abs(mesh.vertices[:, 2]) < 40)].T
        height = y - arch_mm(x, z)
        np.testing.assert_allclose([height.min(), height.max()], faces, atol=0.05)


def test_a_surface_too_deep_or_turned_away_is_refused(chest):
    with pytest.raises(StudyError, match="expected a surface that is visible"):
        visible_mesh(chest, FRONT, skin_mm=100.0, step_mm=4.0)
    back = Mesh(np.array([[0, 0, 0], [40, 0, 0], [0, 0, 40], [40, 0, 40.0]]), [[0, 1, 2], [1, 3, 2]], np.zeros(4))
    with pytest.raises(StudyError, match="faces the front"):
        visible_surface(back, FRONT, 2.0, np.random.default_rng(0))
    front = dataclasses.replace(back, faces=back.faces[:, ::-1])
    assert len(visible_surface(front, FRONT, 2.0, np.random.default_rng(0))) > 100
