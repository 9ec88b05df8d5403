import numpy as np
import pytest
from oracles import check_contract, check_tuned, contract_pair, toy_chest
from pycpd import DeformableRegistration
from threadpoolctl import threadpool_limits

from study.errors import StudyError
from study.geometry.points import farthest_points
from study.methods.cpd import Cpd
from study.registration import Method
from study.types import PointCloud

RNG = np.random.default_rng(0)
SMOOTH = Cpd(beta_mm=30.0, max_points=400)


@pytest.mark.parametrize("method", [Cpd(max_points=200), Cpd(beta_mm=30.0, outlier_share=0.1, max_points=200)])
def test_contract(method):
    assert isinstance(method, Method)
    # Source and target are one draw, yet EM starts from a wide Gaussian, which pulls points together and stops when
    # the variance does: within a small part of the 10 mm between the points that it sees.
    # 1e-5 mm: a linear system of 300 unknowns, solved up to 100 times, carries rounding along.
    check_contract(method, identity_mm=1.0, pose_mm=1e-5)


def test_it_is_pycpds_own_result_where_every_point_is_used():
    source, target, _ = contract_pair(200, 150)
    centre = source.points.mean(axis=0)
    order = farthest_points(source.points - centre, len(source))
    theirs = DeformableRegistration(
        X=(target.points - centre)[farthest_points(target.points - centre, len(target))],
        Y=(source.points - centre)[order],
        beta=30.0,
        w=0.1,
    )
    with threadpool_limits(limits=1):
        moved, _ = theirs.register()
    ours = Cpd(beta_mm=30.0, outlier_share=0.1).register(source, target, RNG)
    assert np.array_equal(np.sort(order), np.arange(len(source)))
    assert ours.warped[order] == pytest.approx(moved + centre, abs=1e-8)
    assert ours.n_iterations == theirs.iteration
    assert ours.history[-1] == pytest.approx(np.sqrt(theirs.sigma2))


def test_the_defaults_are_pycpds():
    theirs = DeformableRegistration(X=np.eye(3), Y=np.eye(3) + 0.5)
    ours = Cpd()
    assert (ours.alpha, ours.beta_mm, ours.outlier_share) == (theirs.alpha, theirs.beta, theirs.w)
    assert (ours.max_iterations, ours.tolerance) == (theirs.max_iterations, theirs.tolerance)


def test_a_planted_deformation_is_recovered_at_points_it_never_saw():
    rng = np.random.default_rng(2)
    source = toy_chest(rng, 4000)
    x, y, z = source.points.T
    planted = np.column_stack([x * 1.04, y + 3 * np.cos(x / 60), z + 5 * np.sin(x / 50)])
    result = SMOOTH.register(source, PointCloud(planted), RNG)
    before, after = (np.linalg.norm(points - planted, axis=1).mean() for points in (source.points, result.warped))
    assert before > 4
    # A tenth of the points is seen, some 10 mm apart and not the same ones of both clouds.
    assert after < 0.4 * before


def test_points_far_from_every_control_point_stay():
    source, target, _ = contract_pair()
    result = Cpd(beta_mm=0.01, max_points=200).register(source, target, RNG)
    unseen = np.setdiff1d(np.arange(len(source)), farthest_points(source.points - source.points.mean(axis=0), 200))
    moved = np.linalg.norm(result.warped - source.points, axis=1)
    assert np.median(moved[unseen]) < 1e-9
    assert np.sort(moved)[-100] > 0.01


def test_running_out_of_iterations_is_reported():
    source, target, _ = contract_pair()
    short = Cpd(max_iterations=3, max_points=200).register(source, target, RNG)
    assert (short.converged, short.n_iterations) == (False, 3)
    assert "limit of 3" in short.stop_reason


@pytest.mark.parametrize(
    "bad",
    [
        {"alpha": 0.0},
        {"alpha": np.nan},
        {"beta_mm": -1.0},
        {"beta_mm": np.nan},
        {"outlier_share": 1.0},
        {"outlier_share": -0.1},
        {"max_points": 3},
        {"max_iterations": 0},
        {"tolerance": -1e-3},
        {"tolerance": np.nan},
    ],
)
def test_bad_parameters_are_refused(bad):
    with pytest.raises(StudyError, match="cpd: expected"):
        Cpd(**bad)


def test_the_tuned_settings_are_the_best_of_the_recorded_grids():
    check_tuned(Cpd.tuned())
    check_tuned(Cpd.tuned_whole(), "_whole")
