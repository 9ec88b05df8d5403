"""The nouns check what they hold and cannot be changed."""

from dataclasses import replace

import numpy as np
import pytest

from study.errors import StudyError
from study.types import CARTILAGES, Mesh, Part, PointCloud, RigidTransform, Volume, Waypoints, as_points

BOX = np.random.default_rng(0).uniform(-100, 100, (200, 3))


def test_a_part_knows_its_side_and_level():
    for side in ("right", "left"):
        for level in (2, 3, 4, 5):
            part = Part.cartilage(side, level)
            assert (part.side, part.level) == (side, level)
            assert part.name == f"{side.upper()}_{level}"
    assert len(CARTILAGES) == len(set(CARTILAGES)) == 8
    assert [(part.side, part.level) for part in (Part.STERNUM, Part.UNKNOWN)] == [("", 0), ("", 0)]
    for side, level in (("up", 2), ("left", 1), ("left", 6)):
        with pytest.raises(StudyError, match=r"expected side right\|left and level 2-5, got"):
            Part.cartilage(side, level)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), "expected at least 1 points, got 0"),
        (np.zeros((9, 2)), r"expected shape \(n, 3\), got \(9, 2\)"),
        (np.zeros(3), r"expected shape \(n, 3\), got \(3,\)"),
        (None, r"expected shape \(n, 3\), got \(\)"),
        ([[1, 2, 3], [1, 2]], "expected numbers of shape"),
        ([["a", "b", "c"]], "expected numbers of shape"),
        ([[0, 0, 0], [0, np.nan, 0], [0, 0, -np.inf]], "expected finite numbers, got 2 rows"),
    ],
)
def test_what_is_not_points_is_refused(points, message):
    with pytest.raises(StudyError, match=message):
        as_points(points, "cloud")


def test_points_are_a_copy_that_nobody_can_write_to():
    mine = np.arange(9.0).reshape(3, 3)
    theirs = as_points(mine)
    mine[0, 0] = 99
    assert theirs[0, 0] == 0
    assert not theirs.flags.writeable
    assert as_points([[1, 2, 3]]).dtype == np.float64
    assert as_points(np.asfortranarray(BOX)).tolist() == BOX.tolist()


def test_a_cloud_refuses_other_units_few_points_and_wrong_labels():
    with pytest.raises(StudyError, match=r"box: expected a chest of 20-2000 mm across, got 0\.3\d* mm; metres\? mult"):
        PointCloud(BOX / 1000, "box")
    with pytest.raises(StudyError, match=r"expected a chest of 20-2000 mm across, got 3.*e\+05 mm; check the units"):
        PointCloud(BOX * 1000)
    with pytest.raises(StudyError, match="expected at least 50 points, got 49"):
        PointCloud(BOX[:49])
    with pytest.raises(StudyError, match=r"expected one part per point \(200,\), got \(199,\)"):
        PointCloud(BOX, parts=np.zeros(199, dtype=np.int64))
    with pytest.raises(StudyError, match="expected labelled parts, got none; label it"):
        PointCloud(BOX).only(Part.STERNUM)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (np.zeros(199), r"box: expected one time per point \(200,\), got \(199,\)"),
        (np.zeros((200, 1)), r"expected one time per point \(200,\), got \(200, 1\)"),
        (1.0, r"expected one time per point \(200,\), got \(\)"),
        (["soon"] * 200, "expected a time in seconds per point, got no numbers"),
        (np.where(np.arange(200) == 7, np.nan, 0.0), "expected finite times in seconds, got 1 .* the first 7"),
    ],
)
def test_a_cloud_refuses_times_that_are_none(times, message):
    with pytest.raises(StudyError, match=message):
        PointCloud(BOX, "box", times=times)


def test_times_are_a_copy_that_follows_the_points():
    mine = np.arange(200.0)
    cloud = PointCloud(BOX, times=mine, parts=np.arange(200) % 3)
    mine[0] = 99
    assert cloud.times[0] == 0
    assert not cloud.times.flags.writeable
    moved = cloud.moved(RigidTransform.random(np.random.default_rng(1)))
    assert np.array_equal(moved.times, cloud.times)
    for rows in (np.arange(100)[::-1], np.arange(200) > 60):
        some = cloud.subset(rows)
        assert np.array_equal(some.points, BOX[rows])
        assert np.array_equal(some.times, cloud.times[rows])
        assert np.array_equal(some.parts, cloud.parts[rows])
    assert PointCloud(BOX).subset(np.arange(60)).times is None


def test_points_without_their_times_are_refused():
    cloud = PointCloud(BOX, times=np.arange(200.0))
    with pytest.raises(StudyError, match=r"expected one time per point \(150,\), got \(200,\)"):
        replace(cloud, points=BOX[:150])


def test_a_cloud_hands_out_its_parts_and_moves():
    parts = np.arange(200) % 3
    cloud = PointCloud(BOX, parts=parts, front=np.array([0, 1.0, 0]))
    assert len(cloud) == 200
    assert np.array_equal(cloud.only(Part.RIGHT_2, Part.STERNUM), BOX[parts != 2])
    motion = RigidTransform.random(np.random.default_rng(1))
    moved = cloud.moved(motion)
    assert moved.points == pytest.approx(BOX @ motion.rotation.T + motion.translation, abs=1e-9)
    assert moved.front == pytest.approx(motion.rotation[:, 1])  # a direction turns and does not shift
    assert np.array_equal(moved.parts, parts)
    assert np.array_equal(cloud.points, BOX)


def test_a_mesh_refuses_what_is_no_surface():
    with pytest.raises(StudyError, match=r"expected triangles of shape \(f, 3\), got \(1, 4\)"):
        Mesh(BOX, np.array([[0, 1, 2, 3]]), np.zeros(200))
    with pytest.raises(StudyError, match=r"expected one part per vertex, got \(3,\)"):
        Mesh(BOX, np.array([[0, 1, 2]]), np.zeros(3))


def test_rigid_transforms_form_a_group():
    rng = np.random.default_rng(2)
    one, other = RigidTransform.random(rng), RigidTransform.random(rng)
    assert (one @ other).apply(BOX) == pytest.approx(one.apply(other.apply(BOX)), abs=1e-9)
    assert (one @ one.inverse).matrix == pytest.approx(np.eye(4), abs=1e-9)
    assert RigidTransform.from_matrix(one.matrix).apply(BOX) == pytest.approx(one.apply(BOX), abs=1e-12)
    homogeneous = np.column_stack([BOX, np.ones(len(BOX))]) @ one.matrix.T
    assert one.apply(BOX) == pytest.approx(homogeneous[:, :3], abs=1e-9)
    assert RigidTransform().angle_deg == 0
    assert RigidTransform(np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])).angle_deg == pytest.approx(90)


@pytest.mark.parametrize(
    ("rotation", "translation", "message"),
    [
        (np.diag([-1.0, 1, 1]), np.zeros(3), "expected a proper rotation"),
        (2 * np.eye(3), np.zeros(3), "expected a proper rotation"),
        (np.full((3, 3), np.nan), np.zeros(3), "expected a proper rotation"),
        (np.eye(3), np.array([0, np.inf, 0]), "finite translation"),
        (np.eye(4), np.zeros(3), r"expected a \(3, 3\) rotation"),
    ],
)
def test_a_reflection_is_no_rigid_transform(rotation, translation, message):
    with pytest.raises(StudyError, match=message):
        RigidTransform(rotation, translation)


def test_random_rotations_are_proper_and_spread_over_all_of_so3():
    rng = np.random.default_rng(0)
    rotations = np.array([RigidTransform.random(rng).rotation for _ in range(400)])
    assert np.linalg.det(rotations) == pytest.approx(np.ones(400))
    # The mean of uniform rotations is 0, each entry with SD sqrt(1/3/400) = 0.029: 0.12 is four of them.
    assert np.abs(rotations.mean(axis=0)).max() < 0.12


def test_a_volume_maps_indices_to_millimetres_and_back():
    pose = RigidTransform.random(np.random.default_rng(3))
    volume = Volume(np.arange(4 * 5 * 6).reshape(4, 5, 6), np.array([0.5, 1.0, 2.0]), pose)
    indices = np.random.default_rng(4).uniform(0, 3, (50, 3))
    assert volume.to_index(volume.to_mm(indices)) == pytest.approx(indices, abs=1e-9)
    homogeneous = np.column_stack([indices, np.ones(50)]) @ volume.affine.T
    assert volume.to_mm(indices) == pytest.approx(homogeneous[:, :3], abs=1e-9)
    cut = volume.crop([1, 2, 3], [9, 9, 9])
    assert cut.shape == (3, 3, 3)
    assert cut.values[0, 0, 0] == volume.values[1, 2, 3]
    assert cut.to_mm([[0, 0, 0]]) == pytest.approx(volume.to_mm([[1, 2, 3]]), abs=1e-9)
    with pytest.raises(StudyError, match="expected a box of at least 2 voxels a side, got"):
        volume.crop([3, 0, 0], [9, 9, 9])


def test_waypoints_have_one_label_each():
    assert len(Waypoints(BOX[:2], ("R2-3.1", "R2-3.2"))) == 2
    with pytest.raises(StudyError, match=r"expected one label per waypoint \(2\), got 1"):
        Waypoints(BOX[:2], ("R2-3.1",))
