import numpy as np
import pytest
import trimesh
from oracles import bend, check_contract, check_tuned, contract_pair, toy_chest

from study.errors import StudyError
from study.methods import nonrigid_icp
from study.methods.nonrigid_icp import NonrigidIcp
from study.types import Method, Part, PointCloud

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
    centre, axes = nonrigid_icp.principal_axes(source.points)
    moving, fixed = (source.points - centre) @ axes.T, (target.points - centre) @ axes.T
    vertices, faces = nonrigid_icp._surface(moving, 400, "toy")
    theirs = trimesh.registration.nricp_amberg(
        trimesh.Trimesh(vertices, faces, process=False), trimesh.PointCloud(fixed), use_faces=False
    )
    theirs = theirs @ axes + centre
    used = np.linalg.norm((vertices @ axes + centre)[:, None] - source.points, axis=2).argmin(axis=1)
    assert ours.warped[used] == pytest.approx(theirs, abs=1e-6)


@pytest.mark.parametrize("anterior", [False, True])
def test_tubes_and_open_sheets_become_one_surface_without_bridges(anterior):
    cloud = toy_chest(np.random.default_rng(3), 6000, anterior=anterior)
    vertices, faces = nonrigid_icp._surface(cloud.points, 1500, "toy")
    assert len(vertices) > 0.95 * 1500
    parts = cloud.parts[np.linalg.norm(vertices[:, None] - cloud.points, axis=2).argmin(axis=1)][faces]
    low, high = parts.min(axis=1), parts.max(axis=1)
    # A triangle from one cartilage to another would let a rib pull its neighbour along.
    assert ((low > Part.STERNUM) & (low != high)).mean() < 0.01
    assert np.array_equal(np.unique(faces), np.arange(len(vertices)))


def test_a_planted_deformation_is_recovered():
    rng = np.random.default_rng(4)
    source, other = toy_chest(rng, 3000), toy_chest(rng, 3000)
    truth, target = bend(source.points, 0.6), PointCloud(bend(other.points, 0.6))
    result = NonrigidIcp(max_vertices=1000).register(source, target, RNG)
    before, after = (np.linalg.norm(points - truth, axis=1).mean() for points in (source.points, result.warped))
    assert before > 2.5
    assert after < 0.75 * before


def test_every_point_takes_the_displacement_of_its_place_on_the_mesh():
    vertices = np.array([[0, 0, 0], [10.0, 0, 0], [0, 10, 0]])
    displacements = np.array([[0, 0, 0], [3.0, 0, 0], [0, 0, 6]])
    faces = np.array([[0, 1, 2]])
    points = np.array([[10.0, 0, 0], [5, 0, 0], [0, 5, 2.0], [20, 0, 0]])
    expected = [[3, 0, 0], [1.5, 0, 0], [0, 0, 3], [3, 0, 0]]
    assert nonrigid_icp._carry(displacements, vertices, faces, points) == pytest.approx(np.array(expected))


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
    "bad", [{"steps": ()}, {"steps": ((0.1, 0, 0.5, 5),)}, {"max_vertices": 5}, {"distance_threshold": 0.0}]
)
def test_bad_parameters_are_refused(bad):
    with pytest.raises(StudyError, match="nonrigid_icp: expected"):
        NonrigidIcp(**bad)


def test_the_tuned_setting_is_the_best_of_the_recorded_grid():
    check_tuned(NonrigidIcp.tuned())
