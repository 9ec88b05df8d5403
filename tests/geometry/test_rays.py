"""Rays and distances against a box, whose answers are known."""

import subprocess
import sys

import numpy as np
import pytest
from trimesh.creation import box

from study.geometry.rays import first_hits, surface_distance_mm
from study.types import Mesh

CENTRE = np.array([500.0, -200.0, 80.0])  # far from the origin, where single precision is coarse


@pytest.fixture(scope="module")
def block() -> Mesh:
    """60 x 40 x 20 mm."""
    shape = box((60, 40, 20))
    return Mesh(shape.vertices + CENTRE, shape.faces, np.zeros(len(shape.vertices)))


def test_a_ray_stops_at_the_first_face_and_counts_lengths_of_its_direction(block):
    origins = CENTRE + np.array([[0, 0, 100], [10, 5, 100], [0, 50, 0], [0, 50, 0]])
    directions = np.array([[0, 0, -1], [0, 0, -2], [0, -1, 0], [0, 1, 0]], dtype=float)
    distance, face = first_hits(block, origins, directions)
    np.testing.assert_allclose(distance, [90, 45, 30, np.inf], atol=1e-4)
    assert face[3] == -1
    corners = block.vertices[block.faces[face[:3]]]
    np.testing.assert_allclose(corners[:2, :, 2], CENTRE[2] + 10, atol=1e-9)
    np.testing.assert_allclose(corners[2, :, 1], CENTRE[1] + 20, atol=1e-9)


def test_a_ray_from_inside_sees_nothing(block):
    distance, face = first_hits(block, CENTRE[None], np.array([[0.0, 0.0, 1.0]]))
    assert np.isinf(distance).all()
    assert (face == -1).all()


def test_distance_is_to_the_triangles_not_the_vertices(block):
    points = CENTRE + np.random.default_rng(0).uniform(-60, 60, (300, 3))
    offset = np.abs(points - CENTRE) - [30, 20, 10]
    expected = np.abs(np.linalg.norm(offset.clip(0), axis=1) + offset.max(axis=1).clip(max=0))
    np.testing.assert_allclose(surface_distance_mm(points, block), expected, atol=1e-4)


def test_sweeps_and_geometry_are_imported_without_open3d():
    code = "import study.ultrasound, study.geometry, sys; sys.exit('open3d' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
