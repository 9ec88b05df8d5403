"""From any rigid pose: the right axes, sides and levels, or an error; never a mirrored or shifted anatomy."""

import numpy as np
import pytest

from study import phantom
from study.alignment.chest import Alignment, Chest, align, find_chest
from study.errors import StudyError
from study.types import CARTILAGES, Part, PointCloud, RigidTransform

# Chest axes left, up, front in RAS+.
CANONICAL = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]).T


def unlabelled(cloud: PointCloud, pose: RigidTransform) -> PointCloud:
    return PointCloud(pose.apply(cloud.points), cloud.name)


def assert_right(chest: Chest, cloud: PointCloud, pose: RigidTransform) -> None:
    axes = pose.rotation.T @ chest.T_cloud_chest.rotation
    assert np.linalg.det(axes) == pytest.approx(1)
    # The feature plane leans with the wall by up to 25°; any wrong front, foot or side is 90° or 180° off.
    assert (axes * CANONICAL).sum(axis=0).min() > np.cos(np.radians(35))
    found, true = chest.cloud.parts, cloud.parts
    assert np.mean(found == true) > 0.8  # the border between sternum and cartilage is a straight line here
    for part in CARTILAGES:  # what is called a cartilage is that one: its own side and level
        assert np.mean(np.isin(true[found == part], [part, Part.STERNUM])) > 0.95
        assert np.mean(found[true == part] == part) > 0.5


@pytest.mark.parametrize("name", [*phantom.SUBJECTS, "us"])
def test_every_subject_is_right_from_random_poses(name, ct_clouds, us_cloud):
    cloud = us_cloud if name == "us" else ct_clouds[name]
    rng = np.random.default_rng(phantom.SUBJECTS.index(name) if name != "us" else 99)
    for _ in range(2):
        pose = RigidTransform.random(rng)
        assert_right(find_chest(unlabelled(cloud, pose)), cloud, pose)


def test_the_answer_turns_with_the_cloud(ct_clouds):
    cloud = ct_clouds["ct4"]
    still = find_chest(unlabelled(cloud, RigidTransform()))
    for seed in range(4):
        pose = RigidTransform.random(np.random.default_rng(seed))
        moved = find_chest(unlabelled(cloud, pose))
        assert np.array_equal(moved.cloud.parts, still.cloud.parts)
        # Nothing but rounding differs: the axes' signs are the cloud's own.
        assert moved.T_cloud_chest.matrix == pytest.approx((pose @ still.T_cloud_chest).matrix, abs=1e-6)


def test_a_mirrored_anatomy_is_a_chest_of_its_own_and_aligns_without_a_reflection(ct_clouds, us_cloud):
    cloud = ct_clouds["ct1"]
    mirrored = PointCloud(cloud.points * [-1, 1, 1], "mirrored")
    swap = {int(p): int(Part.cartilage("left" if p.side == "right" else "right", p.level)) for p in CARTILAGES}
    parts = np.array([swap.get(int(part), int(part)) for part in cloud.parts])
    pose = RigidTransform.random(np.random.default_rng(0))
    chest = find_chest(unlabelled(mirrored, pose))
    assert_right(chest, PointCloud(mirrored.points, "mirrored", parts), pose)
    motion = align(unlabelled(mirrored, pose), unlabelled(us_cloud, RigidTransform())).T_us_ct
    assert np.linalg.det(motion.rotation) == pytest.approx(1)


def test_two_chests_are_overlaid(ct_clouds, us_cloud):
    rng = np.random.default_rng(3)
    g, h = RigidTransform.random(rng), RigidTransform.random(rng)
    cloud = ct_clouds["ct2"]
    alignment = align(unlabelled(cloud, g), unlabelled(us_cloud, h))
    assert isinstance(alignment, Alignment)
    overlay = h.inverse @ alignment.T_us_ct @ g  # both canonical poses are RAS+ with one origin
    assert overlay.angle_deg < 15.0
    truth = phantom.truth_map(phantom.draw_subject("ct2", 0), phantom.draw_subject("patient", 0), cloud.points)
    error = np.linalg.norm(overlay.apply(cloud.points) - truth, axis=1).mean()
    assert 2.0 < error < 15.0  # as after a coarse alignment of two people; a wrong level is 25 mm, a wrong side 100


@pytest.mark.parametrize(
    ("name", "part"),
    # ct2 without the 5th of the left once passed as a whole chest.
    [("us", Part.STERNUM), *[("us", part) for part in CARTILAGES], ("ct2", Part.LEFT_5)],
)
def test_a_missing_part_is_an_error(name, part, ct_clouds, us_cloud):
    cloud = us_cloud if name == "us" else ct_clouds[name]
    pose = RigidTransform.random(np.random.default_rng(int(part)))
    with pytest.raises(StudyError, match=r"expected (4 separate|four) cartilages|no sternum found") as info:
        find_chest(PointCloud(pose.apply(cloud.points[cloud.parts != part]), "torn"))
    assert "torn" in str(info.value)


def test_a_known_front_overrules_the_bulge(ct_clouds):
    cloud = ct_clouds["ct1"]
    pose = RigidTransform.random(np.random.default_rng(8))
    known = PointCloud(cloud.points, cloud.name, front=np.array([0, 1.0, 0])).moved(pose)
    assert_right(find_chest(known), cloud, pose)
