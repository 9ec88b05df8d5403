"""A cloud becomes a surface without bridges, and every point rides on its place there."""

import numpy as np
import pytest
from oracles import toy_chest

from study.methods.mesh import carry, piece_of_each, surface_through
from study.types import Part


@pytest.mark.parametrize("anterior", [False, True])
def test_tubes_and_open_sheets_become_one_surface_without_bridges(anterior):
    cloud = toy_chest(np.random.default_rng(3), 6000, anterior=anterior)
    vertices, faces = surface_through(cloud.points, 1500, 20, "toy")
    assert len(vertices) > 0.95 * 1500
    parts = cloud.parts[np.linalg.norm(vertices[:, None] - cloud.points, axis=2).argmin(axis=1)][faces]
    low, high = parts.min(axis=1), parts.max(axis=1)
    # A triangle from one cartilage to another would let a rib pull its neighbour along.
    assert ((low > Part.STERNUM) & (low != high)).mean() < 0.01
    assert np.array_equal(np.unique(faces), np.arange(len(vertices)))


def test_every_point_takes_the_displacement_of_its_place_on_the_mesh():
    vertices = np.array([[0, 0, 0], [10.0, 0, 0], [0, 10, 0]])
    displacements = np.array([[0, 0, 0], [3.0, 0, 0], [0, 0, 6]])
    faces = np.array([[0, 1, 2]])
    points = np.array([[10.0, 0, 0], [5, 0, 0], [0, 5, 2.0], [20, 0, 0]])
    expected = [[3, 0, 0], [1.5, 0, 0], [0, 0, 3], [3, 0, 0]]
    assert carry(displacements, vertices, faces, points) == pytest.approx(np.array(expected))


def test_pieces_are_those_that_share_a_vertex():
    piece = piece_of_each(np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6]]), 7)
    assert len(set(piece[:4])) == len(set(piece[4:])) == 1
    assert piece[0] != piece[4]
