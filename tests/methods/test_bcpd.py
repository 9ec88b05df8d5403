"""BCPD: the paper's equations as written, what the paper says of its limits, and what it recovers."""

import numpy as np
import pytest
from oracles import check_contract, check_tuned, contract_pair, toy_chest
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.geometry.points import fit_rigid
from study.methods.bcpd import Bcpd, _drift
from study.registration import FieldRegistration, Method
from study.types import PointCloud

RNG = np.random.default_rng(0)
SMOOTH = Bcpd(lam=200.0, beta=1.2, max_points=300)


@pytest.mark.parametrize("method", [SMOOTH, Bcpd(lam=60.0, outlier_share=0.1, normalise="source", max_points=200)])
def test_contract(method):
    assert isinstance(method, Method)
    # 1e-5 mm: a linear system of some 100 unknowns, solved 30 times and more, carries rounding along.
    check_contract(method, identity_mm=1.0, pose_mm=1e-5)


def literal(params: Bcpd, y, x, steps):
    """Fig. 2 of the paper with its own full matrices, point by point where it sums; M and N in the tens."""
    m, n, d = len(y), len(x), 3
    G = np.array([[np.exp(-((a - b) ** 2).sum() / (2 * params.beta**2)) for b in y] for a in y])
    s, R, t, sigma_m, alpha = 1.0, np.eye(d), np.zeros(d), np.zeros(m), np.full(m, 1 / m)
    y_hat = y.copy()
    sigma2 = params.gamma**2 * sum(((a - b) ** 2).sum() for a in y for b in x) / (n * m * d)
    p_out, w = 1 / np.prod(x.max(axis=0) - x.min(axis=0)), params.outlier_share
    history = []
    for _ in range(steps):
        P = np.zeros((m, n))
        for j in range(n):
            phi = np.exp(-((x[j] - y_hat) ** 2).sum(axis=1) / (2 * sigma2)) / (2 * np.pi * sigma2) ** (d / 2)
            phi *= np.exp(-(s**2) / (2 * sigma2) * d * sigma_m)
            P[:, j] = (1 - w) * alpha * phi / (w * p_out + (1 - w) * (alpha * phi).sum())
        nu, nu_x = P.sum(axis=1), P.sum(axis=0)
        n_hat, x_hat = nu.sum(), (P @ x) / nu[:, None]
        Sigma = np.linalg.inv(params.lam * np.linalg.inv(G) + s**2 / sigma2 * np.diag(nu))
        v = s**2 / sigma2 * Sigma @ np.diag(nu) @ ((x_hat - t) @ np.linalg.inv(s * R).T - y)
        sigma_m, u = np.diag(Sigma), y + v
        x_bar, u_bar, bar = nu @ x_hat / n_hat, nu @ u / n_hat, nu @ sigma_m / n_hat
        S_xu = sum(nu[k] * np.outer(x_hat[k] - x_bar, u[k] - u_bar) for k in range(m)) / n_hat
        S_uu = sum(nu[k] * np.outer(u[k] - u_bar, u[k] - u_bar) for k in range(m)) / n_hat + bar * np.eye(d)
        phi, _, psi_t = np.linalg.svd(S_xu)
        R = phi @ np.diag([1, 1, np.linalg.det(phi @ psi_t)]) @ psi_t
        s = np.trace(R.T @ S_xu) / np.trace(S_uu)
        t = x_bar - s * R @ u_bar
        y_hat = np.array([s * R @ u[k] + t for k in range(m)])
        total = sum(nu_x[j] * x[j] @ x[j] for j in range(n)) + sum(nu[k] * y_hat[k] @ y_hat[k] for k in range(m))
        sigma2 = (total - 2 * np.trace(x.T @ P.T @ y_hat)) / (n_hat * d) + s**2 * bar
        history.append(np.sqrt(sigma2))
    return y_hat, history


@pytest.mark.parametrize("extra", [{}, {"outlier_share": 0.2, "gamma": 0.5}])
def test_it_is_the_papers_fig_2(extra):
    rng = np.random.default_rng(3)
    y = rng.normal(size=(40, 3))
    x = y[:30] + 0.2 * np.sin(y[:30, ::-1]) + 0.05 * rng.normal(size=(30, 3))
    params = Bcpd(lam=5.0, beta=0.5, max_iterations=12, min_iterations=12, tolerance=0.0, **extra)
    fit = _drift(params, y, x)
    slow, history = literal(params, y, x, 12)
    kernel = np.exp(-((y[:, None] - y[None]) ** 2).sum(axis=2) / (2 * 0.5**2))
    ours = fit.scale * (y + kernel @ fit.weights) @ fit.rotation.T + fit.shift
    # What the eigenvectors left out weigh: 1e-6 of the largest.
    assert ours == pytest.approx(slow, abs=1e-4)
    assert fit.history == pytest.approx(history, abs=1e-4)


def test_the_defaults_are_those_of_its_authors_program():
    ours = Bcpd()
    assert (ours.lam, ours.beta, ours.gamma, ours.outlier_share) == (2.0, 2.0, 1.0, 0.0)
    assert (ours.max_iterations, ours.min_iterations, ours.tolerance, ours.normalise) == (500, 30, 1e-4, "each")


def test_with_a_huge_lambda_it_is_a_similarity_transform_and_finds_a_planted_one():
    source = toy_chest(np.random.default_rng(2), 400)
    rotation = Rotation.from_rotvec([0.06, -0.08, 0.1]).as_matrix()
    planted = 1.05 * source.points @ rotation.T + [4.0, -3.0, 6.0]
    result = Bcpd(lam=1e9, max_points=400).register(source, PointCloud(planted), RNG)
    spread = np.linalg.norm(result.warped - result.warped.mean(axis=0), axis=1)
    scale = spread / np.linalg.norm(source.points - source.points.mean(axis=0), axis=1)
    assert np.ptp(scale) < 1e-6
    shape = fit_rigid(source.points * scale[0], result.warped)
    assert result.warped == pytest.approx(shape.apply(source.points * scale[0]), abs=1e-6)
    assert np.linalg.norm(source.points - planted, axis=1).mean() > 5.0
    assert np.linalg.norm(result.warped - planted, axis=1).mean() < 0.5


def test_a_planted_deformation_is_recovered_at_points_it_never_saw():
    source = toy_chest(np.random.default_rng(2), 4000)
    x, y, z = source.points.T
    planted = np.column_stack([x * 1.04, y + 3 * np.cos(x / 60), z + 5 * np.sin(x / 50)])
    result = SMOOTH.register(source, PointCloud(planted), RNG)
    before, after = (np.linalg.norm(points - planted, axis=1).mean() for points in (source.points, result.warped))
    assert before > 4
    assert after < 0.4 * before
    # Stiff, it only scales and turns: better than nothing, worse than bending.
    stiff = Bcpd(lam=1e9, max_points=300).register(source, PointCloud(planted), RNG).warped
    assert after < 0.8 * np.linalg.norm(stiff - planted, axis=1).mean()


def test_far_outliers_do_not_pull_where_a_share_is_left_for_them():
    source = toy_chest(np.random.default_rng(2), 600)
    clutter = source.points.mean(axis=0) + np.random.default_rng(4).uniform(-40, 40, (150, 3))
    shift = np.array([3.0, 0, 0])
    target = PointCloud(np.vstack([source.points + shift, clutter]))
    errors = [
        np.linalg.norm(
            Bcpd(lam=60.0, beta=1.2, outlier_share=share, normalise="source", max_points=800)
            .register(source, target, RNG)
            .warped
            - source.points
            - shift,
            axis=1,
        ).mean()
        for share in (0.0, 0.3)
    ]
    assert errors[1] < 0.8 * errors[0]


def test_the_field_is_the_answer_anywhere():
    source, target, _ = contract_pair()
    result = SMOOTH.register(source, target, RNG)
    assert isinstance(result, FieldRegistration)
    assert np.array_equal(result.carry(source.points), result.warped)
    assert result.transfer(source.points[:20]) == pytest.approx(result.warped[:20], abs=1e-9)


def test_running_out_of_iterations_is_reported():
    source, target, _ = contract_pair()
    short = Bcpd(max_iterations=3, min_iterations=1, max_points=200).register(source, target, RNG)
    assert (short.converged, short.n_iterations) == (False, 3)
    assert "limit of 3" in short.stop_reason


@pytest.mark.parametrize(
    "bad",
    [
        {"lam": 0.0},
        {"beta": -1.0},
        {"gamma": np.nan},
        {"outlier_share": 1.0},
        {"normalise": "target"},
        {"min_iterations": 501},
        {"max_points": 3},
        {"tolerance": np.nan},
    ],
)
def test_bad_parameters_are_refused(bad):
    with pytest.raises(StudyError, match="bcpd: expected"):
        Bcpd(**bad)


def test_the_tuned_settings_are_the_best_of_the_recorded_grid():
    check_tuned(Bcpd.tuned())
