import numpy as np
import pytest
from oracles import hausdorff_literal
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.metrics import (
    METRICS,
    directed_distances_mm,
    hausdorff_mm,
    hd95_mm,
    mean_surface_distance_mm,
    paired_wilcoxon,
    point_errors_mm,
    population_sd,
    sampling_floor_mm,
    waypoint_errors_mm,
)
from study.types import RigidTransform


@pytest.fixture
def clouds():
    rng = np.random.default_rng(0)
    return rng.normal(scale=40, size=(300, 3)), rng.normal(scale=45, size=(170, 3))


def test_hausdorff_is_equation_5(clouds):
    a, b = clouds
    assert hausdorff_mm(a, b) == pytest.approx(hausdorff_literal(a, b), abs=1e-9)
    assert hausdorff_mm(a, b) == hausdorff_mm(b, a)
    assert hausdorff_mm(a, a[::-1]) == 0


def test_one_stray_point_decides_hd_and_leaves_hd95():
    grid = np.stack(np.meshgrid(*[np.arange(10.0)] * 3), axis=-1).reshape(-1, 3)
    stray = np.vstack([grid, [[9.0, 9.0, 49.0]]])
    assert hausdorff_mm(grid, stray) == 40
    assert hd95_mm(grid, stray) == 0
    # Directed distances: 0 from the grid, one 40 of 1,001 from the other.
    assert mean_surface_distance_mm(grid, stray) == pytest.approx(40 / 1001 / 2)


def test_distances_do_not_change_under_a_common_motion(clouds):
    a, b = clouds
    motion = RigidTransform.random(np.random.default_rng(1))
    for metric in (hausdorff_mm, hd95_mm, mean_surface_distance_mm):
        assert metric(motion.apply(a), motion.apply(b)) == pytest.approx(metric(a, b), abs=1e-9)
    assert directed_distances_mm(a, b).shape == (300,)


def test_a_shifted_plane_is_as_far_as_it_was_shifted():
    plane = np.stack([*np.meshgrid(np.arange(50.0), np.arange(50.0)), np.zeros((50, 50))], axis=-1).reshape(-1, 3)
    up = plane + np.array([0, 0, 3.0])
    assert [f(plane, up) for f in (hausdorff_mm, hd95_mm, mean_surface_distance_mm)] == [3, 3, 3]


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


@pytest.mark.parametrize("metric", [hausdorff_mm, hd95_mm, mean_surface_distance_mm])
def test_an_empty_cloud_has_no_distance(metric):
    with pytest.raises(StudyError, match="at least 1 points, got 0"):
        metric(np.empty((0, 3)), np.zeros((4, 3)))


def test_population_sd_reproduces_the_papers_table():
    table = {
        3.54: [10.92, 20.67, 18.35, 16.50, 20.29],
        3.36: [14.45, 10.49, 12.43, 15.06, 20.48],
        3.27: [11.75, 15.96, 15.62, 10.56, 19.71],
        0.27: [9.81, 9.53, 9.06, 9.69, 9.29],
    }
    for sd, values in table.items():
        assert round(population_sd(values), 2) == sd
        assert round(float(np.std(values, ddof=1)), 2) != sd


def test_five_pairs_get_no_p_value_and_six_can():
    first = np.array([5.0, 6.0, 7.0, 8.0, 9.0, 10.0])
    second = first - [1, 2, 3, 4, 5, 6]
    five, six = paired_wilcoxon(first[:5], second[:5]), paired_wilcoxon(first, second)
    assert (five.n, five.p_value) == (5, None)
    assert "n = 5 < 6" in five.note
    assert six.p_value == pytest.approx(2 / 2**6)
    assert six.mean_difference == pytest.approx(3.5)
    assert paired_wilcoxon(first, first).p_value == 1
    with pytest.raises(StudyError, match="leave failures out"):
        paired_wilcoxon(first, [*second[:5], np.nan])


def test_every_metric_states_a_tolerance_below_half_a_millimetre_and_its_reason():
    assert len(METRICS) >= 8
    for metric in METRICS.values():
        assert 0 < metric.tolerance < 0.5
        assert metric.reason
        assert metric.unit == "mm"
