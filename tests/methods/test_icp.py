import numpy as np
import open3d as o3d
import pytest
from oracles import check_contract, check_tuned, contract_pair, toy_chest
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.geometry.points import principal_axes
from study.methods.icp import Icp
from study.registration import Method
from study.types import PointCloud, RigidTransform

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("method", [Icp(), Icp(max_distance_mm=15.0, point_to_plane=True)])
def test_contract(method):
    assert isinstance(method, Method)
    # 1e-6 mm: sums in another frame round differently, and 30 updates carry that along; no partner changes.
    check_contract(method, identity_mm=1e-9, pose_mm=1e-6)


def test_a_planted_motion_is_recovered_and_is_the_whole_answer():
    target = toy_chest(np.random.default_rng(1), 4000)
    planted = RigidTransform(Rotation.from_euler("xyz", [3, -2, 4], degrees=True).as_matrix(), np.array([4.0, -3, 5]))
    source = target.moved(planted.inverse)
    result = Icp(max_iterations=200).register(source, target, RNG)
    assert result.converged
    assert np.linalg.norm(result.warped - target.points, axis=1).max() < 0.01
    assert (result.T_us_ct @ planted.inverse).angle_deg < 0.01
    assert np.array_equal(result.warped, result.T_us_ct.apply(source.points))
    # Path transfer of a rigid method is its own motion, waypoints included.
    waypoints = source.points[::400] + 2.0
    assert result.transfer(waypoints) == pytest.approx(result.T_us_ct.apply(waypoints), abs=1e-9)


@pytest.mark.parametrize("point_to_plane", [False, True])
def test_one_update_a_call_is_open3ds_own_loop(point_to_plane):
    source, target, _ = contract_pair()
    ours = Icp(max_distance_mm=20.0, point_to_plane=point_to_plane).register(source, target, RNG)
    centre, axes = principal_axes(source.points)  # point-to-plane depends on the origin and the axes
    moving, fixed = ((cloud.points - centre) @ axes.T for cloud in (source, target))
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (moving, fixed)]
    clouds[1].estimate_normals()
    registration = o3d.pipelines.registration
    kind = "TransformationEstimationPointToPlane" if point_to_plane else "TransformationEstimationPointToPoint"
    theirs = registration.registration_icp(*clouds, 20.0, np.eye(4), getattr(registration, kind)())
    moved = RigidTransform.from_matrix(theirs.transformation).apply(moving) @ axes + centre
    assert ours.warped == pytest.approx(moved, abs=1e-9)
    assert ours.history[-1] == pytest.approx(theirs.inlier_rmse, abs=1e-9)


def test_the_defaults_are_open3ds():
    criteria, icp = o3d.pipelines.registration.ICPConvergenceCriteria(), Icp()
    assert icp.max_iterations == criteria.max_iteration
    assert (icp.relative_fitness, icp.relative_rmse) == (criteria.relative_fitness, criteria.relative_rmse)


def test_running_out_of_iterations_is_reported():
    source, target, _ = contract_pair()
    short = Icp(max_iterations=2).register(source, target, RNG)
    assert (short.converged, short.n_iterations) == (False, 2)
    assert short.stop_reason == "iteration limit of 2 reached"
    assert Icp(max_iterations=500).register(source, target, RNG).converged


def test_clouds_out_of_reach_are_refused():
    source, target, _ = contract_pair()
    far = PointCloud(target.points + 500.0)
    with pytest.raises(StudyError, match="raise max_distance_mm"):
        Icp(max_distance_mm=10.0).register(source, far, RNG)


@pytest.mark.parametrize(
    "bad",
    [
        {"max_distance_mm": 0.0},
        {"max_distance_mm": np.nan},
        {"max_iterations": 0},
        {"relative_fitness": -1e-6},
        {"relative_rmse": np.nan},
    ],
)
def test_bad_parameters_are_refused_by_name(bad):
    with pytest.raises(StudyError, match=f"icp: expected .*{next(iter(bad))} >.*, got .*; "):
        Icp(**bad)


def test_the_tuned_settings_are_the_best_of_the_recorded_grids():
    check_tuned(Icp.tuned())
    check_tuned(Icp.tuned_whole(), "_whole")
