"""The visible half is the front of the tubes, and hidden points ride along rigidly."""

import numpy as np
import pytest

from study import registration
from study.alignment.chest import align
from study.alignment.frame import chest_frame
from study.errors import StudyError
from study.methods.icp import Icp
from study.methods.visible_surface import VisibleSurface, faces_front
from study.registration import carry
from study.types import PointCloud, RigidTransform


def test_a_sphere_shows_its_front(ct_clouds):
    frame = chest_frame(ct_clouds["ct1"])
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(4000, 3))
    sphere = 10.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    seen = faces_front(frame.T_cloud_chest.apply(sphere), frame)
    assert not seen[sphere[:, 2] < -3.0].any()
    assert seen[sphere[:, 2] > 8.0].all()


def test_hidden_points_follow_a_rigid_motion_exactly():
    rng = np.random.default_rng(1)
    source, hidden = rng.normal(scale=20.0, size=(300, 3)), rng.normal(scale=20.0, size=(40, 3))
    motion = RigidTransform.random(rng)
    np.testing.assert_allclose(carry(hidden, source, motion.apply(source), 12), motion.apply(hidden), atol=1e-9)


def test_points_carried_in_pieces_are_those_carried_at_once(monkeypatch):
    rng = np.random.default_rng(2)
    source, warped, hidden = (rng.normal(scale=20.0, size=(n, 3)) for n in (300, 300, 45))
    at_once = carry(hidden, source, warped, 8)
    monkeypatch.setattr(registration, "CARRIED_AT_ONCE", 20)
    assert np.array_equal(carry(hidden, source, warped, 8), at_once)


def test_a_rigid_method_stays_rigid_on_every_point(ct_clouds, us_cloud):
    alignment = align(
        PointCloud(ct_clouds["ct1"].points, "ct"), PointCloud(us_cloud.points, "us", front=us_cloud.front)
    )
    source = alignment.source.cloud.moved(alignment.T_us_ct)
    result = VisibleSurface(Icp()).register(source, alignment.target.cloud, np.random.default_rng(0))
    assert result.warped.shape == source.points.shape
    np.testing.assert_allclose(result.warped, result.T_us_ct.apply(source.points), atol=1e-6)


def test_a_cloud_with_too_few_visible_points_is_refused(ct_clouds):
    source = ct_clouds["ct1"]
    with pytest.raises(StudyError, match=r"expected 5000 visible points or more, got \d+; pass a denser cloud"):
        VisibleSurface(Icp(), neighbours=5000).register(source, source, np.random.default_rng(0))


def test_bad_parameters_are_refused_by_name():
    with pytest.raises(StudyError, match="visible_surface: expected neighbours >= 3, got 2; "):
        VisibleSurface(Icp(), neighbours=2)
    with pytest.raises(StudyError, match="visible_surface: expected a registration method, got 'icp'; "):
        VisibleSurface("icp")
