"""Non-rigid coherent point drift (Myronenko and Song), a baseline of sec. IV, by pycpd."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any, ClassVar

import numpy as np
from pycpd import DeformableRegistration
from scipy.spatial.distance import cdist
from threadpoolctl import threadpool_limits

from study.errors import StudyError
from study.geometry import farthest_points
from study.types import Floats, PointCloud, Registration, RigidTransform

_ROWS = 10_000  # rows of the extension at a time, to bound memory


@dataclass(frozen=True)
class Cpd:
    """Non-rigid CPD; the defaults are pycpd's, on coordinates in millimetres about the source's centroid.

    pycpd scales nothing, so its numbers are in the data's unit: ``beta_mm`` = 2 lets places 4 mm apart move on their
    own, and ``alpha`` weighs against squared millimetres.

    Attributes:
        alpha: weight of smoothness.
        beta_mm: width of the Gaussian kernel that couples neighbours.
        outlier_share: weight of the uniform component, 0 <= w < 1.
        max_iterations: limit of EM steps.
        tolerance: stop when the variance changes by less, mm^2.
        max_points: CPD's memory and time grow with the product of the clouds' sizes; of larger clouds it sees this many
            points, spread evenly. All points are then moved by the fitted kernel.
    """

    name: ClassVar[str] = "cpd"

    alpha: float = 2.0
    beta_mm: float = 2.0
    outlier_share: float = 0.0
    max_iterations: int = 100
    tolerance: float = 1e-3
    max_points: int = 1000

    def __post_init__(self) -> None:
        if min(self.alpha, self.beta_mm) <= 0 or not 0 <= self.outlier_share < 1:
            raise StudyError(
                "cpd: expected alpha > 0, beta_mm > 0 and 0 <= outlier_share < 1, "
                f"got {self.alpha}, {self.beta_mm} and {self.outlier_share}"
            )
        if self.max_iterations < 1 or self.max_points < 4:
            raise StudyError(
                "cpd: expected max_iterations >= 1 and max_points >= 4, "
                f"got {self.max_iterations} and {self.max_points}"
            )

    @classmethod
    def tuned(cls) -> Cpd:
        """The best row of ``results/tuning/cpd.csv``, found on development subjects by tools/tune.py."""
        return cls(alpha=0.2, beta_mm=30.0)

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """Drift ``source`` onto ``target``; nothing is drawn from ``rng``.

        ``history`` is the standard deviation of the mixture's Gaussians, mm.

        Raises:
            StudyError: the fit gave numbers that are not finite.
        """
        start = perf_counter()
        centre = source.points.mean(axis=0)
        moving, fixed = source.points - centre, target.points - centre
        control = moving[farthest_points(moving, self.max_points)]
        history: list[float] = []
        with threadpool_limits(limits=1):  # sums of a threaded BLAS depend on the number of threads
            drift = _Drift(
                X=fixed[farthest_points(fixed, self.max_points)],
                Y=control,
                alpha=self.alpha,
                beta=self.beta_mm,
                w=self.outlier_share,
                max_iterations=self.max_iterations,
                tolerance=self.tolerance,
            )
            drift.register(lambda **_: history.append(float(np.sqrt(drift.sigma2))))
            warped = centre + np.vstack(
                [
                    rows + np.exp(-cdist(rows, control, "sqeuclidean") / (2 * self.beta_mm**2)) @ drift.W
                    for rows in np.split(moving, range(_ROWS, len(moving), _ROWS))
                ]
            )
        if not np.isfinite(warped).all():
            raise StudyError(f"cpd: expected finite points from {source.name!r}, got NaN; raise alpha or outlier_share")
        converged = bool(drift.diff <= self.tolerance)
        return Registration(
            source=source.points,
            warped=warped,
            T_us_ct=RigidTransform(),
            converged=converged,
            n_iterations=len(history),
            stop_reason=(
                "variance stopped changing" if converged else f"iteration limit of {self.max_iterations} reached"
            ),
            history=tuple(history),
            seconds=perf_counter() - start,
            method=self.name,
            extras={"n_control": len(control)},
        )


class _Drift(DeformableRegistration):
    """pycpd's two costly steps without their (m, n, 3) and diagonal arrays: same numbers in a third of the time."""

    def expectation(self) -> None:
        p = np.exp(-cdist(self.TY, self.X, "sqeuclidean") / (2 * self.sigma2))
        uniform = (2 * np.pi * self.sigma2) ** (self.D / 2) * self.w / (1 - self.w) * self.M / self.N
        total = p.sum(axis=0)
        total[total == 0] = np.finfo(float).eps
        self.P = p / (total + uniform)
        self.Pt1, self.P1 = self.P.sum(axis=0), self.P.sum(axis=1)
        self.Np = self.P1.sum()

    def update_transform(self) -> None:
        system: Floats = self.P1[:, None] * self.G
        system.flat[:: self.M + 1] += self.alpha * self.sigma2
        self.W: Any = np.linalg.solve(system, self.P @ self.X - self.P1[:, None] * self.Y)
