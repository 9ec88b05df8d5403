import numpy as np
import pytest
import trimesh
from oracles import bend, check_contract, check_tuned, contract_pair, toy_chest

from study.errors import StudyError
from study.geometry.points import principal_axes
from study.methods.mesh import surface_through
from study.methods.nonrigid_icp import NonrigidIcp
from study.registration import Method
from study.types import PointCloud

RNG = np.random.default_rng(0)
SMALL = NonrigidIcp(max_vertices=400)


def test_contract():
    assert isinstance(SMALL, Method)
    # A vertex's partner is the vertex itself; the smoothness term then has nothing to do.
    # 1e-3 mm: the library stores its equations' data in single precision.
    check_contract(NonrigidIcp(max_vertices=250), identity_mm=0.05, pose_mm=1e-3)


def test_the_defaults_are_trimeshs():
    source, target, _ = contract_pair()
    ours = SMALL.register(source, target, RNG)
    centre, axes = principal_axes(source.points)
    moving, fixed = (source.points - centre) @ axes.T, (target.points - centre) @ axes.T
    vertices, faces = surface_through(moving, 400, 20, "toy")
    theirs = trimesh.registration.nricp_amberg(
        trimesh.Trimesh(vertices, faces, process=False), trimesh.PointCloud(fixed), use_faces=False
    )
    theirs = theirs @ axes + centre
    used = np.linalg.norm((vertices @ axes + centre)[:, None] - source.points, axis=2).argmin(axis=1)
    assert ours.warped[used] == pytest.approx(theirs, abs=1e-6)


def test_a_planted_deformation_is_recovered():
    rng = np.random.default_rng(4)
    source, other = toy_chest(rng, 3000), toy_chest(rng, 3000)
    truth, target = bend(source.points, 0.6), PointCloud(bend(other.points, 0.6))
    result = NonrigidIcp(max_vertices=1000).register(source, target, RNG)
    before, after = (np.linalg.norm(points - truth, axis=1).mean() for points in (source.points, result.warped))
    assert before > 2.5
    assert after < 0.75 * before


def test_running_out_of_iterations_is_reported():
    source, target, _ = contract_pair()
    short = NonrigidIcp(steps=((0.01, 0, 0.0, 2),), eps=1e-12, max_vertices=300).register(source, target, RNG)
    assert (short.converged, short.n_iterations) == (False, 2)
    assert "still falling" in short.stop_reason
    assert short.history[1] < short.history[0]


def test_points_that_are_no_surface_are_refused():
    line = np.random.default_rng(5).normal(scale=0.01, size=(60, 3)) + np.linspace(-50, 50, 60)[:, None]
    with pytest.raises(StudyError, match="'wire' to be points of a surface"):
        SMALL.register(PointCloud(line, "wire"), PointCloud(line), RNG)


def test_a_surface_out_of_reach_is_refused():
    source, target, _ = contract_pair()
    far = PointCloud(target.points + 5000.0)
    with pytest.raises(StudyError, match="raise distance_threshold"):
        SMALL.register(source, far, RNG)


@pytest.mark.parametrize(
    "bad",
    [
        {"steps": ()},
        {"steps": ((0.1, 0, 0.5, 5),)},
        {"steps": ((0.0, 0, 0, 5),)},
        {"steps": ((0.1, -1, 0, 5),)},
        {"steps": ((0.1, 0, -1, 5), (0.1, 0, 0, 5))},
        {"steps": ((0.1, 0, 0, 0),)},
        {"steps": ((0.1, 0, 0),)},
        {"max_vertices": 5},
        {"distance_threshold": 0.0},
        {"distance_threshold": np.nan},
        {"eps": -1e-4},
        {"gamma": 0.0},
        {"gamma": np.nan},
        {"neighbors_count": 2},
    ],
)
def test_bad_parameters_are_refused_by_name(bad):
    with pytest.raises(StudyError, match=f"nonrigid_icp: expected .*{next(iter(bad)).rstrip('s')}.*, got .*; "):
        NonrigidIcp(**bad)


def test_the_tuned_settings_are_the_best_of_the_recorded_grids():
    check_tuned(NonrigidIcp.tuned())
    check_tuned(NonrigidIcp.tuned_whole(), "_whole")
