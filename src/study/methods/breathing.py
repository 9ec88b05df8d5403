"""Breathing during a sweep: how the whole chest wall moved, as a function of time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from study.errors import StudyError
from study.types import Floats

# Rows: outwards, cranio-ventral and across both, in chest coordinates (left, up, front).
AXES: Floats = np.array([[1.0, 0.0, 0.0], [0.0, np.sqrt(0.5), np.sqrt(0.5)], [0.0, -np.sqrt(0.5), np.sqrt(0.5)]])
_KNOTS_PER_PERIOD = 8
_MAX_KNOTS = 300


@dataclass(frozen=True)
class BreathingPrior:
    """A displacement of the whole wall in time: a Gaussian process about 0 that swings as quiet breathing does.

    Quiet breathing moves the wall 3-5 mm upwards and forwards, 12 to 20 times a minute. The process remembers its phase
    for less than a breath, so that breaths may differ in length, depth and shape. It has next to nothing of a period
    of a line of the sweep or longer: that would be shape.

    Attributes:
        along_mm: standard deviation along the cranio-ventral direction.
        aside_mm: in each direction across that.
        period_s: of a typical breath.
        memory_s: after which a breath may come early or late.
    """

    along_mm: float = 1.4
    aside_mm: float = 0.5
    period_s: float = 4.0
    memory_s: float = 1.5

    def __post_init__(self) -> None:
        if not min(self.along_mm, self.aside_mm, self.period_s, self.memory_s) > 0:
            raise StudyError(
                "breathing: expected along_mm, aside_mm, period_s and memory_s > 0, got "
                f"{self.along_mm}, {self.aside_mm}, {self.period_s} and {self.memory_s}; BreathingPrior() is quiet "
                "breathing"
            )

    @property
    def variances(self) -> Floats:
        """(3,) mm² along `AXES`."""
        return np.array([self.aside_mm, self.along_mm, self.aside_mm]) ** 2

    def basis(self, times_s: Floats) -> BreathingBasis:
        """What the process can do during a sweep with points at times (n,) s."""
        first, last = float(times_s.min()), float(times_s.max())
        count = int(np.ceil((last - first) / self.period_s * _KNOTS_PER_PERIOD)) + 1
        knots = np.linspace(first, last, min(count, _MAX_KNOTS))
        covariance = self.correlation(knots, knots) + 1e-6 * np.eye(len(knots))
        return BreathingBasis(self, knots, cholesky(covariance, lower=True))

    def correlation(self, one: Floats, other: Floats) -> Floats:
        """Between times (n,) and (m,) s."""
        apart = one[:, None] - other
        values: Floats = np.exp(-((apart / self.memory_s) ** 2) / 2) * np.cos(2 * np.pi * apart / self.period_s)
        return values


@dataclass(frozen=True)
class BreathingBasis:
    """Functions of time whose sum with independent standard normal weights is the process at a size of 1 mm.

    Attributes:
        prior: the prior.
        knots: (k,) s.
        factor: (k, k) lower Cholesky factor of the knots' correlation.
    """

    prior: BreathingPrior
    knots: Floats
    factor: Floats

    def at(self, times_s: Floats) -> Floats:
        """Their values (n, k) at times (n,) s."""
        values: Floats = solve_triangular(self.factor, self.prior.correlation(self.knots, times_s), lower=True).T
        return values
