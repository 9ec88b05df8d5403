"""Non-rigid coherent point drift (Myronenko and Song), a baseline of sec. IV, by pycpd."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy.spatial.distance import cdist

from study.errors import StudyError
from study.geometry.points import farthest_points
from study.registration import Registration
from study.types import Floats, PointCloud, RigidTransform

if TYPE_CHECKING:
    from study.methods.drift import Drift

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
        if not (self.alpha > 0 and self.beta_mm > 0 and 0 <= self.outlier_share < 1):
            raise StudyError(
                "cpd: expected alpha > 0, beta_mm > 0 and 0 <= outlier_share < 1, "
                f"got {self.alpha}, {self.beta_mm} and {self.outlier_share}; Cpd() has pycpd's own"
            )
        if not (self.max_iterations >= 1 and self.max_points >= 4 and self.tolerance >= 0):
            raise StudyError(
                "cpd: expected max_iterations >= 1, max_points >= 4 and tolerance >= 0, "
                f"got {self.max_iterations}, {self.max_points} and {self.tolerance}; a tolerance of 0 runs to the limit"
            )

    @classmethod
    def tuned(cls) -> Cpd:
        """The best row of ``results/tuning/cpd.csv``: the visible surface of development subjects, by tools/tune.py."""
        return cls(alpha=0.005, beta_mm=120.0)

    @classmethod
    def tuned_whole(cls) -> Cpd:
        """The best row of ``results/tuning/cpd_whole.csv``: the whole tube of the same subjects."""
        return cls(alpha=0.2, beta_mm=50.0)

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """Drift ``source`` onto ``target``; nothing is drawn from ``rng``.

        ``history`` is the standard deviation of the mixture's Gaussians, mm.
        """
        centre = source.points.mean(axis=0)
        moving, fixed = source.points - centre, target.points - centre
        control = moving[farthest_points(moving, self.max_points)]
        drift, history = self._drift(control, fixed[farthest_points(fixed, self.max_points)])
        converged = bool(drift.diff <= self.tolerance)
        limit = f"iteration limit of {self.max_iterations} reached"
        return Registration(
            source=source.points,
            warped=centre + self._extend(moving, control, drift.W),
            T_us_ct=RigidTransform(),
            converged=converged,
            n_iterations=len(history),
            stop_reason="variance stopped changing" if converged else limit,
            history=tuple(history),
        )

    def _drift(self, control: Floats, fixed: Floats) -> tuple[Drift, list[float]]:
        """The finished fit of ``control`` (m, 3) to ``fixed`` (n, 3), and its standard deviation by iteration."""
        from study.methods.drift import Drift  # brings pycpd, which takes seconds to import

        drift = Drift(
            X=fixed,
            Y=control,
            alpha=self.alpha,
            beta=self.beta_mm,
            w=self.outlier_share,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
        )
        history: list[float] = []
        drift.register(lambda **_: history.append(float(np.sqrt(drift.sigma2))))
        return drift, history

    def _extend(self, moving: Floats, control: Floats, weights: Floats) -> Floats:
        """All points (n, 3) moved by the kernel that was fitted at the control points."""
        return np.vstack(
            [
                rows + np.exp(-cdist(rows, control, "sqeuclidean") / (2 * self.beta_mm**2)) @ weights
                for rows in np.split(moving, range(_ROWS, len(moving), _ROWS))
            ]
        )
