"""A Gaussian-process prior on the displacement, fitted one way to what the probe saw, its breathing and its ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_factor, cho_solve

from study.alignment.frame import chest_frame
from study.errors import StudyError
from study.geometry.points import farthest_points
from study.methods.branch_ends import BranchEnds, branch_ends
from study.methods.breathing import AXES, BreathingPrior
from study.methods.displacement_field import DisplacementField, DisplacementPrior
from study.methods.one_way_shares import OneWayShares
from study.registration import FieldRegistration, as_waypoints
from study.types import Floats, PointCloud, RigidTransform

# Calibrated by tools/bounds.py on a population and on half of the development people of three kinds; the other half
# checked. Of 27 more patients, who are less unlike each other, they cover more than 95 % (bounds_by_kind.csv).
BOUND_MM = 3.2
BOUND_UNTIMED_MM = 3.4  # where the US points carry no times

_COARSE_MM = 4.0  # a mixture wider than this needs a third of the points
_AT_REST_MM = 0.1  # mean motion of the CT points in the last iteration


@dataclass(frozen=True, kw_only=True)
class GaussianProcessRegistration(FieldRegistration):
    """A registration by a field that says how far it can be trusted.

    Attributes:
        breath_mm: (m, 3) mm, US frame, how far breathing had moved each US point when it was seen; None without times.
        bound_mm: what `bounds` gives.
    """

    breath_mm: Floats | None
    bound_mm: float

    def bounds(self, waypoints: ArrayLike) -> Floats:
        """The 95 % bound (k,) mm of each waypoint's error: one size for all.

        Nothing that a registration knows of itself told a good waypoint from a bad one. The size was calibrated on
        phantoms and on deformations planted into real CTs, swept with every error on (``tools/bounds.py``); on people
        of another kind, or under other errors, it may not hold, and beside a warning it does not.

        Raises:
            StudyError: waypoints that are none.
        """
        return np.full(len(as_waypoints(waypoints)), self.bound_mm)


@dataclass(frozen=True)
class GaussianProcess:
    """Gaussian-process registration: a prior of how people differ, an EM fit to the US points, ends and breathing.

    The CT points are the centres of a mixture of which the US points are draws, as in coherent point drift. What
    differs: shares go one way; a prior with several lengths, in chest coordinates; the ends of the cartilages; and,
    where the US points carry the times at which they were seen, how the wall moved meanwhile, which is taken off the
    US points and does not bend the answer. The result is a field, which waypoints follow themselves.

    Ultrasound sees fronts only: give it the visible surface, as its entry of ``METHODS`` does.

    Attributes:
        prior: of the displacement.
        n_nodes: places that carry the field.
        shares: of CT points in US points.
        ends: equations of the branches' ends; None goes without.
        breathing: prior of the wall's motion; None takes it for shape, as where the US points carry no times.
        widths_mm: of the mixture: first and last of the coarse steps, and that of the fine ones.
        steps: coarse ones, in which breathing counts as shape, and fine ones.
        independent_points: as many US points say as much as all of them do, since neighbours err alike.
        max_points: of each cloud, spread evenly.
    """

    name: ClassVar[str] = "gaussian_process"

    prior: DisplacementPrior = field(default_factory=DisplacementPrior)
    n_nodes: int = 150
    shares: OneWayShares = field(default_factory=OneWayShares)
    ends: BranchEnds | None = field(default_factory=BranchEnds)
    breathing: BreathingPrior | None = field(default_factory=BreathingPrior)
    widths_mm: tuple[float, float, float] = (10.0, 2.0, 1.5)
    steps: tuple[int, int] = (8, 16)
    independent_points: float = 200.0
    max_points: int = 1000

    def __post_init__(self) -> None:
        if not (len(self.widths_mm) == 3 and self.widths_mm[0] >= self.widths_mm[1] >= self.widths_mm[2] > 0):
            raise StudyError(
                f"gaussian_process: expected three widths_mm > 0 that do not rise, got {self.widths_mm}; "
                "GaussianProcess() has 10, 2 and 1.5"
            )
        if not (len(self.steps) == 2 and min(self.steps) >= 1):
            raise StudyError(f"gaussian_process: expected two steps >= 1, coarse and fine, got {self.steps}")
        if not (self.n_nodes >= 4 and self.max_points >= 100 and self.independent_points > 0):
            raise StudyError(
                "gaussian_process: expected n_nodes >= 4, max_points >= 100 and independent_points > 0, "
                f"got {self.n_nodes}, {self.max_points} and {self.independent_points}; a chest needs 150, 1000 and 200"
            )

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> GaussianProcessRegistration:
        """Register labelled, coarsely aligned clouds; nothing is drawn from ``rng``.

        ``history`` is the mean motion of the CT points in each step, mm; converged means less than 0.1 in the last.

        Raises:
            StudyError: a part of either cloud is missing.
        """
        T_target_chest = chest_frame(target).T_cloud_chest
        ct, us = (cloud.moved(T_target_chest.inverse) for cloud in (source, target))
        fit = _Fit(self, ct, us)
        history = [fit.step(width_mm) for width_mm in np.geomspace(*self.widths_mm[:2], self.steps[0])]
        history += [fit.step(self.widths_mm[2], breathing=True) for _ in range(self.steps[1])]
        found = DisplacementField(T_target_chest, fit.basis, fit.weights)
        timed, at_rest = fit.breathing is not None, history[-1] < _AT_REST_MM
        end = "at rest" if at_rest else f"still moving by {history[-1]:.2f} mm a step"
        breath = "breathing is taken " + ("off" if timed else "for shape")
        if target.times is None:
            breath += ", since the US points carry no times"
        return GaussianProcessRegistration(
            source=source.points,
            warped=found.apply(source.points),
            T_us_ct=RigidTransform(),
            converged=at_rest,
            n_iterations=len(history),
            stop_reason=f"schedule done, points {end}; {breath}",
            history=tuple(history),
            field=found,
            breath_mm=fit.breath_mm(us) @ T_target_chest.rotation.T if timed else None,
            bound_mm=BOUND_MM if timed else BOUND_UNTIMED_MM,
        )


class _Fit:
    """The EM iteration, in the target's chest coordinates: US point = CT point + displacement + breathing + noise."""

    def __init__(self, method: GaussianProcess, source: PointCloud, target: PointCloud) -> None:
        self.method = method
        self.ct, self.us = _thinned(source, method.max_points), _thinned(target, method.max_points)
        self.basis = method.prior.basis(self.ct.points, method.n_nodes)
        self.functions = self.basis.at(self.ct.points)
        self.weights = np.zeros((self.functions.shape[1], 3))
        self.ct_ends, self.us_ends = branch_ends(source), branch_ends(target)
        self.end_functions = self.basis.at(self.ct_ends)
        self.breathing = None
        if method.breathing is not None and self.us.times is not None:
            self.breathing = method.breathing.basis(self.us.times)
        self.breaths = self._breaths(self.us)
        self.breath_weights = np.zeros((self.breaths.shape[1], 3))

    def _breaths(self, cloud: PointCloud) -> Floats:
        """Functions of time (n, k) at a cloud's points; none without times."""
        if self.breathing is None or cloud.times is None:
            return np.zeros((len(cloud), 0))
        return self.breathing.at(cloud.times)

    def breath_mm(self, cloud: PointCloud) -> Floats:
        """How far (n, 3) mm breathing had moved each point of a cloud when it was seen."""
        return self._breaths(cloud) @ self.breath_weights

    def step(self, width_mm: float, *, breathing: bool = False) -> float:
        """One E-step and one M-step; how far the CT points moved on average, mm."""
        few = slice(None if width_mm <= _COARSE_MM else self.method.max_points // 3)
        ct, us, functions, breaths = self.ct.points[few], self.us.points[few], self.functions[few], self.breaths[few]
        parts = self.ct.parts[few], self.us.parts[few]  # type: ignore[index]  # labelled: `chest_frame` has seen to it
        before = functions @ self.weights
        shares = self.method.shares.between(ct + before, us - breaths @ self.breath_weights, width_mm, *parts)
        noise_mm2 = width_mm**2 * len(us) / self.method.independent_points

        # Unknown are the weights of the displacement's functions, a, and while breathing is fitted of those of time, b:
        # least squares of us - ct - F a - B b under the shares and both priors.
        unknown = breaths if breathing else breaths[:, :0]
        mixed = np.asarray(shares @ functions)  # (n, k)
        per_ct, per_us = np.asarray(shares.sum(axis=0)), np.asarray(shares.sum(axis=1))
        k = functions.shape[1]
        matrix = np.block(
            [
                [functions.T @ (per_ct[:, None] * functions), mixed.T @ unknown],
                [unknown.T @ mixed, unknown.T @ (per_us[:, None] * unknown)],
            ]
        )
        right = np.vstack(
            [
                mixed.T @ us - functions.T @ (per_ct[:, None] * ct),
                unknown.T @ (per_us[:, None] * us - np.asarray(shares @ ct)),
            ]
        )
        found = self._solve(matrix, right @ AXES.T, noise_mm2) @ AXES
        self.weights = found[:k]
        if breathing:
            self.breath_weights = found[k:]
        return float(np.linalg.norm(functions @ self.weights - before, axis=1).mean())

    def _solve(self, matrix: Floats, right: Floats, noise_mm2: float) -> Floats:
        """Weights (u, 3) along `AXES`, one component after the other: each has its prior, the first has the ends too.

        Args:
            matrix: (u, u) of all components.
            right: (u, 3) along `AXES`.
            noise_mm2: variance of a US point, by which priors and ends weigh.
        """
        k = len(self.weights)
        found = np.empty_like(right)
        variances = np.ones(3) if self.breathing is None else self.breathing.prior.variances
        for axis, variance in enumerate(variances):
            system, side = matrix.copy(), right[:, axis].copy()
            diagonal = system.reshape(-1)[:: len(system) + 1]
            diagonal[:k] += noise_mm2
            diagonal[k:] += noise_mm2 / variance
            if axis == 0 and self.method.ends is not None:
                out = self.ct_ends[:, 0] + self.end_functions @ self.weights[:, 0]
                pull = (self.us_ends[:, 0] - out) * np.sign(self.us_ends[:, 0])
                precision = noise_mm2 * self.method.ends.precisions(pull)
                system[:k, :k] += self.end_functions.T @ (precision[:, None] * self.end_functions)
                side[:k] += self.end_functions.T @ (precision * (self.us_ends - self.ct_ends)[:, 0])
            found[:, axis] = cho_solve(cho_factor(system, lower=True, overwrite_a=True), side)
        return found


def _thinned(cloud: PointCloud, n: int) -> PointCloud:
    """At most ``n`` of the points whose part is known; the first of them are spread as evenly as all."""
    assert cloud.parts is not None  # `chest_frame` has refused a cloud without
    known = np.flatnonzero(cloud.parts >= 0)
    return cloud.subset(known[farthest_points(cloud.points[known], n)])
