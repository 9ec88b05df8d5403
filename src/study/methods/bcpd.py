"""Bayesian coherent point drift (Hirose 2021), a rival of sec. IV's baselines: our own reading of the paper.

O. Hirose, A Bayesian formulation of coherent point drift, IEEE TPAMI 43(7), 2021, 2269-2286: Fig. 2 as written, but for
the kernel matrix, which is cut to the eigenvectors that count. No library on the package index has it ready: the one
that does, probreg, comes as C++ source, and its last release, 0.3.8, lacks the corrections of its own pull request 122.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.spatial.distance import cdist

from study.errors import StudyError
from study.geometry.points import farthest_points, principal_axes
from study.registration import FieldRegistration
from study.types import Floats, PointCloud, RigidTransform

Normalise = Literal["each", "source"]

_D = 3
_ROWS = 10_000  # rows of the field at a time, to bound memory
_LEAST_EIGENVALUE = 1e-6  # of the kernel matrix, beside its largest; what is below moves no point by 1 µm


@dataclass(frozen=True)
class Bcpd:
    """Non-rigid BCPD; the defaults are those of the author's program. Lengths are in standard deviations of the cloud.

    Unlike CPD it has a similarity transform of its own beside the displacements, a prior on how large these are, and an
    outlier term in a volume; unlike pycpd it scales the data, so its numbers carry over between data sets.

    The paper's kappa is infinite, as by default in its author's program: all source points weigh alike.

    Attributes:
        lam: lambda of the paper, precision of the displacements: their expected length is sqrt(3 / lam).
        beta: width of the Gaussian kernel that couples neighbours.
        gamma: start of the mixture's standard deviation, beside the root mean square distance of the clouds per axis.
        outlier_share: omega, weight of the uniform component over the target's box, 0 <= omega < 1.
        normalise: ``"each"`` cloud by its own centre and size, so that the start forgets the coarse alignment's;
            ``"source"`` both by the source's.
        max_iterations, min_iterations: limits of the variational steps.
        tolerance: stop when the standard deviation changes by less.
        max_points: of larger clouds it sees this many points, spread evenly; all are moved by the fitted field.
    """

    name: ClassVar[str] = "bcpd"

    lam: float = 2.0
    beta: float = 2.0
    gamma: float = 1.0
    outlier_share: float = 0.0
    normalise: Normalise = "each"
    max_iterations: int = 500
    min_iterations: int = 30
    tolerance: float = 1e-4
    max_points: int = 1000

    def __post_init__(self) -> None:
        positive = all(value > 0 for value in (self.lam, self.beta, self.gamma))
        if not (positive and 0 <= self.outlier_share < 1):
            raise StudyError(
                "bcpd: expected lam, beta and gamma > 0 and 0 <= outlier_share < 1, "
                f"got {self.lam}, {self.beta}, {self.gamma} and {self.outlier_share}; Bcpd() has its author's own"
            )
        if self.normalise not in ("each", "source"):
            raise StudyError(f"bcpd: expected normalise each|source, got {self.normalise!r}; its author's is each")
        if not (1 <= self.min_iterations <= self.max_iterations and self.max_points >= 4 and self.tolerance >= 0):
            raise StudyError(
                "bcpd: expected 1 <= min_iterations <= max_iterations, max_points >= 4 and tolerance >= 0, "
                f"got {self.min_iterations}, {self.max_iterations}, {self.max_points} and {self.tolerance}; "
                "a tolerance of 0 runs to the limit"
            )

    @classmethod
    def tuned(cls) -> Bcpd:
        """The best row of ``results/tuning/bcpd.csv``: the visible surface of development subjects."""
        return cls(lam=20.0, beta=2.5)

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> FieldRegistration:
        """Drift ``source`` onto ``target``; nothing is drawn from ``rng``.

        ``history`` is the standard deviation of the mixture's Gaussians, mm.
        """
        # The box of the outliers lies along the axes; in the source's own axes it is the same in every pose.
        centre, axes = principal_axes(source.points)
        moving, fixed = ((cloud.points - centre) @ axes.T for cloud in (source, target))
        moving, fixed = moving[farthest_points(moving, self.max_points)], fixed[farthest_points(fixed, self.max_points)]
        size = _size(moving)
        middle, spread = (fixed.mean(axis=0), _size(fixed)) if self.normalise == "each" else (moving.mean(axis=0), size)
        drift = _drift(self, (moving - moving.mean(axis=0)) / size, (fixed - middle) / spread)
        field = BcpdField(
            T_local=RigidTransform(axes, -axes @ centre - moving.mean(axis=0)),
            T_back=RigidTransform(axes.T, axes.T @ middle + centre),
            unit_mm=(size, spread),
            drift=drift,
            beta=self.beta,
        )
        limit = f"iteration limit of {self.max_iterations} reached"
        return FieldRegistration(
            source=source.points,
            warped=field.apply(source.points),
            T_us_ct=RigidTransform(),
            converged=drift.converged,
            n_iterations=len(drift.history),
            stop_reason="standard deviation stopped changing" if drift.converged else limit,
            history=tuple(spread * deviation for deviation in drift.history),
            field=field,
        )


@dataclass(frozen=True)
class Drift:
    """The finished fit in normalised units: y goes to ``scale * rotation @ (y + v(y)) + shift``.

    Attributes:
        control: (m, 3) the source points that were seen.
        weights: (m, 3) of the kernel at each: v(y) is their sum.
        scale, rotation, shift: the similarity transform.
        history: standard deviation after each iteration.
        converged: it stopped changing before the limit.
    """

    control: Floats
    weights: Floats
    scale: float
    rotation: Floats
    shift: Floats
    history: tuple[float, ...]
    converged: bool


@dataclass(frozen=True)
class BcpdField:
    """A `study.registration.Field`.

    Attributes:
        T_local: from the clouds' frame into the source's axes, its seen points centred.
        T_back: from the target's centre in those axes to the clouds' frame.
        unit_mm: what is 1 in the source and in the target.
        drift: the fit.
        beta: width of its kernel.
    """

    T_local: RigidTransform
    T_back: RigidTransform
    unit_mm: tuple[float, float]
    drift: Drift
    beta: float

    def apply(self, points: Floats) -> Floats:
        """Where points (k, 3) mm come to lie."""
        rows = np.split(points, range(_ROWS, len(points), _ROWS))
        return np.vstack([self._apply(part) for part in rows])

    def _apply(self, points: Floats) -> Floats:
        local = self.T_local.apply(points) / self.unit_mm[0]
        displaced = local + _kernel(local, self.drift.control, self.beta) @ self.drift.weights
        moved = self.drift.scale * displaced @ self.drift.rotation.T + self.drift.shift
        return self.T_back.apply(moved * self.unit_mm[1])


def _size(points: Floats) -> float:
    """Standard deviation of points (n, 3) about their centre, per axis."""
    return float(np.sqrt(points.var(axis=0).mean()))


def _kernel(one: Floats, other: Floats, beta: float) -> Floats:
    kernel: Floats = np.exp(-cdist(one, other, "sqeuclidean") / (2 * beta**2))
    return kernel


def _drift(params: Bcpd, y: Floats, x: Floats) -> Drift:
    """The variational loop of the paper's Fig. 2, its names kept: source y (m, 3), target x (n, 3), normalised."""
    m = len(y)
    eigenvalues, q = eigh(_kernel(y, y, params.beta))
    kept = eigenvalues > _LEAST_EIGENVALUE * eigenvalues[-1]
    eigenvalues, q = eigenvalues[kept], q[:, kept]
    odds = m * params.outlier_share / (1 - params.outlier_share) / float(np.prod(np.ptp(x, axis=0)))
    s, R, t = 1.0, np.eye(_D), np.zeros(_D)
    y_hat, variance_m = y, np.zeros(m)
    sigma = params.gamma * float(np.sqrt(cdist(y, x, "sqeuclidean").mean() / _D))
    x_squared = (x**2).sum(axis=1)
    history: list[float] = []
    converged = False
    while not converged and len(history) < params.max_iterations:
        # Correspondences: P (m, n), its sums nu, and where each source point is drawn to.
        # Squared distances as products, and |x|² left to the end: it is the same for all source points.
        P = y_hat @ x.T / sigma**2
        P -= ((_D * s**2 * variance_m + (y_hat**2).sum(axis=1)) / (2 * sigma**2))[:, None]
        top = P.max(axis=0)
        P = np.exp(np.subtract(P, top, out=P), out=P)
        outliers = odds * (2 * np.pi * sigma**2) ** (_D / 2)
        P /= P.sum(axis=0) + outliers * np.exp(np.minimum(x_squared / (2 * sigma**2) - top, 700.0))
        nu = np.maximum(P.sum(axis=1), np.finfo(float).tiny)
        n_hat, px = nu.sum(), P @ x
        x_hat = px / nu[:, None]
        # Displacements: Gaussian-process regression of what the similarity transform leaves.
        left = (x_hat - t) @ R / s - y
        system = q.T @ (nu[:, None] * q)
        system.flat[:: len(system) + 1] += params.lam * sigma**2 / s**2 / eigenvalues
        factor = cho_factor(system, lower=True)
        coefficients = cho_solve(factor, q.T @ (nu[:, None] * left))
        variance_m = sigma**2 / s**2 * (q * cho_solve(factor, q.T).T).sum(axis=1)
        u = y + q @ coefficients
        # Similarity transform from u to x_hat.
        x_bar, u_bar, variance = nu @ x_hat / n_hat, nu @ u / n_hat, float(nu @ variance_m / n_hat)
        S_xu = (nu[:, None] * (x_hat - x_bar)).T @ (u - u_bar) / n_hat
        spread = float(nu @ ((u - u_bar) ** 2).sum(axis=1) / n_hat) + _D * variance
        left_axes, _, right_axes = np.linalg.svd(S_xu)
        R = left_axes @ np.diag([1.0, 1.0, np.linalg.det(left_axes @ right_axes)]) @ right_axes
        s = float((R * S_xu).sum() / spread)
        t = x_bar - s * R @ u_bar
        y_hat = s * u @ R.T + t
        # Variance of the mixture.
        residual = P.sum(axis=0) @ x_squared - 2 * (px * y_hat).sum() + nu @ (y_hat**2).sum(axis=1)
        before, sigma = sigma, float(np.sqrt(max(residual / (n_hat * _D), 0.0) + s**2 * variance))
        history.append(sigma)
        converged = len(history) >= params.min_iterations and abs(before - sigma) < params.tolerance
    return Drift(y, q @ (coefficients / eigenvalues[:, None]), s, R, t, tuple(history), converged)
