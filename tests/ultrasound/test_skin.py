"""The skin over a chest, and the hand upon it."""

import numpy as np
import pytest
from small_sweeps import FRONT

from study.geometry.rays import first_hits
from study.ultrasound.skin import Skin


@pytest.fixture(scope="module")
def skin(chest):
    return Skin(chest, FRONT, (0.0, 0.3, 1.0), 11.0)


def test_axes_are_right_handed_and_the_front_is_kept(skin):
    np.testing.assert_allclose(skin.axes, [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-12)
    assert np.linalg.det(skin.axes) == pytest.approx(1)


def test_tissue_covers_every_bone_and_normals_point_out(chest, skin):
    rng = np.random.default_rng(0)
    points, normals = skin.points(rng.uniform(skin.low[:2], skin.high[:2], (500, 2)))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert (normals @ FRONT > 0.7).all()
    depth, _ = first_hits(chest, points, np.broadcast_to(-np.array(FRONT), points.shape))
    assert np.isfinite(depth).sum() > 200
    assert depth.min() > 8  # the skin is as far from the most prominent bone around, smoothed
    assert np.median(depth[np.isfinite(depth)]) < 16
