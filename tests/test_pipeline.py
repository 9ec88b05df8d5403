"""One pair from start to end, from any pose, and from the package's front door."""

import subprocess
import sys

import numpy as np
import pytest

import study
from study import METHODS, phantom, register_pair
from study.coarse import align
from study.errors import StudyError
from study.pipeline import find_method, named_rng, register_aligned
from study.types import PointCloud, RigidTransform


def test_the_front_door_holds_what_others_rely_on():
    assert register_pair is study.pipeline.register_pair
    assert METHODS is study.methods.METHODS
    assert study.StudyError is StudyError
    assert set(study.__all__) <= set(dir(study))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = study.nonsense


def test_importing_the_package_imports_no_method():
    code = "import sys, study; sys.exit('open3d' in sys.modules or 'sklearn' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_generators_come_from_names():
    draws = {
        (seed, name): named_rng(seed, name).integers(1 << 60) for seed in (0, 1) for name in ("a/us/icp", "b/us/icp")
    }
    assert len(set(draws.values())) == 4
    assert named_rng(0, "a/us/icp").integers(1 << 60) == draws[0, "a/us/icp"]
    with pytest.raises(StudyError, match="expected a seed of 0 or more, got -1"):
        named_rng(-1, "a")


def test_an_unknown_method_is_named_with_the_known_ones():
    with pytest.raises(StudyError, match=r"expected a method among .*skeleton_graph.*, got 'icpp'"):
        find_method("icpp")


@pytest.mark.parametrize("method", ["icp", "skeleton_graph"])
def test_moving_the_clouds_moves_the_answer_with_the_us_cloud(method, ct_clouds, us_cloud):
    ct, us = ct_clouds["ct3"].points, us_cloud.points
    still = register_pair(ct, us, method)
    rng = np.random.default_rng(5)
    g, h = RigidTransform.random(rng), RigidTransform.random(rng)
    moved = register_pair(g.apply(ct), h.apply(us), method)
    # Nothing but rounding differs: 1e-13 of coordinates, carried through a thousand updates. A pose-dependent pixel
    # grid would show as 0.2-3 mm.
    assert np.linalg.norm(moved.warped - h.apply(still.warped), axis=1).max() < 1e-4
    assert moved.T_us_ct.matrix == pytest.approx((h @ still.T_us_ct @ g.inverse).matrix, abs=1e-4)
    waypoints = phantom.waypoints(phantom.draw_subject("ct3", 0)).points
    there = moved.transfer(g.apply(waypoints), radius_mm=30.0)
    assert there == pytest.approx(h.apply(still.transfer(waypoints, radius_mm=30.0)), abs=1e-4)


def test_a_pair_holds_what_the_interface_promises(ct_clouds, us_cloud):
    ct = np.array(ct_clouds["ct4"].points)
    ct.flags.writeable = False
    pair = register_pair(ct, us_cloud.points, method="skeleton_graph", seed=0)
    assert np.array_equal(pair.source, ct)  # row i is ct_points[i], in its own frame
    assert pair.warped.shape == ct.shape
    assert np.linalg.det(pair.T_us_ct.rotation) == pytest.approx(1)
    assert (pair.converged, pair.method) == (True, "skeleton_graph")
    assert pair.n_iterations > 0
    assert pair.seconds > 0
    truth = phantom.truth_map(phantom.draw_subject("ct4", 0), phantom.draw_subject("patient", 0), ct)
    assert np.linalg.norm(pair.warped - truth, axis=1).mean() < 15.0  # a wrong level is 25 mm, a wrong side 100
    same = register_pair(ct.tolist(), us_cloud.points, method="skeleton_graph", seed=0)
    assert same.warped.tobytes() == pair.warped.tobytes()


def test_a_cloud_on_a_moved_copy_of_itself_finds_the_motion(ct_clouds):
    cloud = ct_clouds["patient"].points
    motion = RigidTransform.random(np.random.default_rng(6))
    for method in ("coarse", "icp"):
        pair = register_pair(cloud, motion.apply(cloud), method)
        assert np.linalg.norm(pair.warped - motion.apply(cloud), axis=1).max() < 1e-3


def test_the_result_is_expressed_from_the_ct_clouds_own_frame(ct_clouds, us_cloud):
    pose = RigidTransform.random(np.random.default_rng(7))
    source = PointCloud(pose.apply(ct_clouds["ct1"].points), "ct")
    alignment = align(source, PointCloud(us_cloud.points, "us"))
    result = register_aligned(alignment, METHODS["icp"], np.random.default_rng(0))
    assert np.array_equal(result.source, source.points)
    assert result.warped == pytest.approx(result.T_us_ct.apply(source.points), abs=1e-9)
