"""The frame of a chest is measured from its labelled parts."""

import numpy as np
import pytest

from study.alignment.frame import chest_frame
from study.errors import StudyError
from study.types import Part, PointCloud, RigidTransform


def test_the_template_frame_is_measured_from_the_parts(ct_clouds):
    for name in ("ct1", "patient"):
        cloud = ct_clouds[name]
        frame = chest_frame(cloud)
        assert frame.left == pytest.approx([-1, 0, 0], abs=0.35)
        assert np.cross(frame.left, frame.up) == pytest.approx(frame.front, abs=1e-9)
        assert 20 < frame.width_mm < 40
        for side in ("right", "left"):
            roots = [frame.root_mm[Part.cartilage(side, level)] for level in (2, 3, 4, 5)]
            assert roots == sorted(roots, reverse=True)
            reach = [frame.reach_mm[Part.cartilage(side, level)] for level in (2, 3, 4, 5)]
            assert min(reach) > 15
            assert reach[3] > reach[0]
        pose = RigidTransform.random(np.random.default_rng(9))
        moved = chest_frame(cloud.moved(pose))
        assert moved.T_cloud_chest.matrix == pytest.approx((pose @ frame.T_cloud_chest).matrix, abs=1e-6)
        assert list(moved.reach_mm.values()) == pytest.approx(list(frame.reach_mm.values()), abs=1e-6)


def test_the_template_frame_names_the_missing_part(ct_clouds):
    cloud = ct_clouds["ct1"]
    keep = cloud.parts != Part.LEFT_3
    with pytest.raises(StudyError, match="expected points on every part, got none on LEFT_3"):
        chest_frame(PointCloud(cloud.points[keep], "torn", cloud.parts[keep]))
    with pytest.raises(StudyError, match="expected labelled parts, got none"):
        chest_frame(PointCloud(cloud.points))


def test_a_chest_frame_is_right_handed(chest):
    assert np.cross(chest.left, chest.up) == pytest.approx(chest.front)
    chest_point = np.array([[10.0, 20.0, 30.0]])  # left, up, front
    assert chest.T_cloud_chest.apply(chest_point)[0] == pytest.approx([1 - 10, 2 + 30, 3 + 20])
