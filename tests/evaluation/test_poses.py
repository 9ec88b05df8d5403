"""The verdict on a found chest: right only with the body's own axes, sides and levels."""

from dataclasses import replace

import numpy as np
import pytest

from study.alignment.chest import Chest, find_chest
from study.errors import StudyError
from study.evaluation import poses
from study.evaluation.poses import (
    MAX_AXES_OFF_DEG,
    MIN_RIGHT_PARTS,
    PoseCheck,
    check_pose,
    random_pose,
    try_poses,
)
from study.seeds import named_rng
from study.types import Part, PointCloud, RigidTransform

POSE = RigidTransform.random(np.random.default_rng(3))
HALF_TURNS = {"sides and front": (-1, 1, -1), "sides and head": (-1, -1, 1), "head and front": (1, -1, -1)}


@pytest.fixture(scope="module")
def found(ct_clouds: dict[str, PointCloud]) -> Chest:
    cloud = ct_clouds["ct1"]
    return find_chest(PointCloud(POSE.apply(cloud.points), "ct1"))


def test_a_chest_found_in_a_random_pose_is_right(found, ct_clouds):
    check = check_pose(found, ct_clouds["ct1"].parts, POSE)
    assert check.is_right
    assert check.axes_off_deg < 20
    assert check.worst_part <= check.right_parts <= 1


def test_axes_are_compared_in_the_body_not_in_the_cloud(found, ct_clouds):
    parts = ct_clouds["ct1"].parts
    more = RigidTransform.random(np.random.default_rng(4))
    moved = replace(found, T_cloud_chest=more @ found.T_cloud_chest)
    assert check_pose(moved, parts, more @ POSE).axes_off_deg == pytest.approx(
        check_pose(found, parts, POSE).axes_off_deg, abs=1e-6
    )
    assert not check_pose(found, parts, more @ POSE).is_right


@pytest.mark.parametrize("signs", HALF_TURNS.values(), ids=HALF_TURNS)
def test_swapped_axes_are_wrong_even_with_the_right_parts(found, ct_clouds, signs):
    turned = replace(found, T_cloud_chest=found.T_cloud_chest @ RigidTransform(np.diag(np.array(signs, dtype=float))))
    check = check_pose(turned, ct_clouds["ct1"].parts, POSE)
    assert check.axes_off_deg > 140
    assert not check.is_right


def test_swapped_sides_and_shifted_levels_are_wrong_even_with_the_right_axes(found, ct_clouds):
    true = ct_clouds["ct1"].parts
    sides = np.where(true > 0, (true + 3) % 8 + 1, true)
    levels = np.where(true > 0, (true - 1) // 4 * 4 + true % 4 + 1, true)
    for parts in (sides, levels):
        assert set(parts) == set(true)
        check = check_pose(found, parts, POSE)
        assert check.worst_part < 0.2
        assert not check.is_right


def test_the_worst_part_is_named_by_its_share_and_unknown_points_do_not_count(found):
    mine = found.cloud.parts
    true = mine.copy()
    own = np.flatnonzero(true == Part.LEFT_4)
    true[own[: len(own) // 4]] = Part.LEFT_5
    lost = np.flatnonzero(true == Part.STERNUM)[:50]
    true[lost] = Part.UNKNOWN
    check = check_pose(found, true, POSE)
    wrong, right = len(own) // 4, (mine == Part.LEFT_5).sum()
    assert check.worst_part == pytest.approx(right / (right + wrong))
    assert check.right_parts == pytest.approx(1 - wrong / (len(true) - len(lost)))


def test_the_limits_themselves():
    assert PoseCheck(MAX_AXES_OFF_DEG - 0.1, MIN_RIGHT_PARTS, 0.0).is_right
    assert not PoseCheck(MAX_AXES_OFF_DEG, 1.0, 1.0).is_right
    assert not PoseCheck(0.0, MIN_RIGHT_PARTS - 0.01, 0.5).is_right


def test_parts_of_another_cloud_or_none_of_a_part_are_refused(found):
    with pytest.raises(StudyError, match="expected a true part for each of"):
        check_pose(found, found.cloud.parts[1:], POSE)
    parts = np.where(found.cloud.parts == Part.RIGHT_2, Part.STERNUM, found.cloud.parts)
    with pytest.raises(StudyError, match="got none of right_2"):
        check_pose(found, parts, POSE)


def test_trials_see_the_points_alone_in_poses_drawn_by_seed_and_number(ct_clouds, monkeypatch):
    given = []

    def find(cloud):
        given.append(cloud)
        return find_chest(cloud)

    monkeypatch.setattr(poses, "find_chest", find)
    cloud = ct_clouds["ct2"]
    clouds = {"CT": cloud, "US": replace(cloud, front=np.array([0.0, 1.0, 0.0]))}
    trials = try_poses(clouds, 1, seed=7)
    assert [trial.cloud for trial in trials] == ["CT", "US"]
    assert all(trial.check.is_right for trial in trials)
    assert all(cloud.parts is None and cloud.front is None for cloud in given)
    rng = named_rng(7, "coarse/pose0")
    for trial, cloud in zip(trials, given, strict=True):
        pose = RigidTransform.random(rng)
        np.testing.assert_array_equal(trial.pose.matrix, pose.matrix)
        np.testing.assert_array_equal(cloud.points, pose.apply(ct_clouds["ct2"].points))
    with pytest.raises(StudyError, match="expected a cloud with its true parts"):
        try_poses({"CT": PointCloud(cloud.points)}, 1, seed=7)


def test_a_random_pose_is_drawn_by_seed_and_name():
    one, same, other = (random_pose(0, name, 80.0) for name in ("a", "a", "b"))
    np.testing.assert_array_equal(one.matrix, same.matrix)
    assert not np.allclose(one.matrix, other.matrix)
