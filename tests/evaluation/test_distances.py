import numpy as np
import pytest
from oracles import hausdorff_literal
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.evaluation.distances import (
    CloudDistances,
    directed_distances_mm,
    hausdorff_mm,
    point_errors_mm,
    sampling_floor_mm,
    waypoint_errors_mm,
)
from study.types import RigidTransform

MEASURES = ("hausdorff_mm", "hd95_mm", "mean_mm")


def measures(a, b):
    return [getattr(CloudDistances.between(a, b), name) for name in MEASURES]


@pytest.fixture
def clouds():
    rng = np.random.default_rng(0)
    return rng.normal(scale=40, size=(300, 3)), rng.normal(scale=45, size=(170, 3))


def test_hausdorff_is_equation_5(clouds):
    a, b = clouds
    assert hausdorff_mm(a, b) == pytest.approx(hausdorff_literal(a, b), abs=1e-9)
    assert hausdorff_mm(a, b) == hausdorff_mm(b, a) == CloudDistances.between(a, b).hausdorff_mm
    assert hausdorff_mm(a, a[::-1]) == 0


def test_every_measure_follows_from_the_two_directions(clouds):
    a, b = clouds
    apart = np.linalg.norm(a[:, None] - b[None], axis=2)
    found = CloudDistances.between(a, b)
    assert found.forth == pytest.approx(apart.min(axis=1), abs=1e-9)
    assert found.back == pytest.approx(apart.min(axis=0), abs=1e-9)
    assert found.hd95_mm == max(np.percentile(found.forth, 95), np.percentile(found.back, 95))
    assert found.mean_mm == (found.forth.mean() + found.back.mean()) / 2


def test_one_stray_point_decides_hd_and_leaves_hd95():
    grid = np.stack(np.meshgrid(*[np.arange(10.0)] * 3), axis=-1).reshape(-1, 3)
    stray = np.vstack([grid, [[9.0, 9.0, 49.0]]])
    # Directed distances: 0 from the grid, one 40 of 1,001 from the other.
    assert measures(grid, stray) == pytest.approx([40, 0, 40 / 1001 / 2])


def test_distances_do_not_change_under_a_common_motion(clouds):
    a, b = clouds
    motion = RigidTransform.random(np.random.default_rng(1))
    assert measures(motion.apply(a), motion.apply(b)) == pytest.approx(measures(a, b), abs=1e-9)
    assert directed_distances_mm(a, b).shape == (300,)


def test_a_shifted_plane_is_as_far_as_it_was_shifted():
    plane = np.stack([*np.meshgrid(np.arange(50.0), np.arange(50.0)), np.zeros((50, 50))], axis=-1).reshape(-1, 3)
    assert measures(plane, plane + np.array([0, 0, 3.0])) == [3, 3, 3]


@pytest.mark.parametrize("measure", [hausdorff_mm, directed_distances_mm, CloudDistances.between])
def test_an_empty_cloud_has_no_distance(measure):
    full = np.zeros((4, 3))
    for pair in ((np.empty((0, 3)), full), (full, np.empty((0, 3)))):
        with pytest.raises(StudyError, match="at least 1 points, got 0"):
            measure(*pair)


def test_the_sampling_floor_falls_with_more_points_and_is_seeded():
    rng = np.random.default_rng(2)
    sphere = rng.normal(size=(8000, 3))
    sphere *= 80 / np.linalg.norm(sphere, axis=1, keepdims=True)
    few, many = (sampling_floor_mm(sphere, n, np.random.default_rng(3)) for n in (400, 4000))
    assert few > 2 * many > 0
    assert many == sampling_floor_mm(sphere, 4000, np.random.default_rng(3))
    with pytest.raises(StudyError, match="without a shared one, got 8000 points"):
        sampling_floor_mm(sphere, 4001, rng)


def test_inplane_errors_leave_out_the_normal_part():
    reference = np.random.default_rng(4).normal(scale=50, size=(20, 3))
    turn = Rotation.from_euler("xyz", [20, 30, 40], degrees=True)
    normal, inside = turn.apply([0, 0, 7.0]), turn.apply([3.0, 4.0, 0])  # a normal of any length
    moved = reference + inside + normal
    assert waypoint_errors_mm(moved, reference, normal) == pytest.approx(np.full(20, 5.0))
    assert waypoint_errors_mm(moved, reference) == pytest.approx(np.full(20, np.sqrt(25 + 49)))
    assert waypoint_errors_mm(moved, reference, normal, depth=True) == pytest.approx(np.full(20, 7.0))
    assert waypoint_errors_mm(moved, reference, -normal, depth=True) == pytest.approx(np.full(20, 7.0))
    with pytest.raises(StudyError, match="a plane normal to measure depth along, got none"):
        waypoint_errors_mm(moved, reference, depth=True)


@pytest.mark.parametrize(
    ("points", "reference", "normal", "message"),
    [
        (np.zeros((3, 3)), np.zeros((2, 3)), None, "one reference per point"),
        (np.full((3, 3), np.nan), np.zeros((3, 3)), None, "finite"),
        (np.zeros((3, 3)), np.zeros((3, 3)), [0, 0, 0], "plane normal"),
        (np.zeros((3, 2)), np.zeros((3, 2)), None, r"shape \(n, 3\)"),
    ],
)
def test_bad_points_are_refused(points, reference, normal, message):
    with pytest.raises(StudyError, match=message):
        point_errors_mm(points, reference, normal)
