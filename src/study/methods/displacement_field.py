"""A Gaussian-process prior on how one chest wall differs from another, and the field that is drawn from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from study.errors import StudyError
from study.geometry.points import farthest_points
from study.types import Floats, RigidTransform

_ROWS = 10_000  # rows of the kernel at a time, to bound memory


@dataclass(frozen=True)
class DisplacementPrior:
    """How far places of a chest wall may be displaced, and how alike at two places: the kernel of a Gaussian process.

    Chest coordinates: left, up and front, origin at the middle of the sternum. Each component of the displacement has
    the same kernel and none knows of the others. Three sums: what is left of pose and size; a smooth bend; a bend of
    single cartilages, which knows no depth, since a front and a back bend together.

    Attributes:
        affine_mm: standard deviation of a shift, and of a shear or stretch at ``affine_length_mm`` from the origin.
        affine_length_mm: see ``affine_mm``.
        smooth_mm: standard deviation of the smooth bend.
        smooth_length_mm: its length.
        local_mm: standard deviation of a cartilage's own bend.
        local_left_mm, local_up_mm: its lengths along and across the cartilages.
    """

    affine_mm: float = 1.5
    affine_length_mm: float = 80.0
    smooth_mm: float = 10.0
    smooth_length_mm: float = 70.0
    local_mm: float = 1.6
    local_left_mm: float = 25.0
    local_up_mm: float = 18.0

    def __post_init__(self) -> None:
        lengths = (self.affine_length_mm, self.smooth_length_mm, self.local_left_mm, self.local_up_mm)
        if not (self.affine_mm > 0 and self.smooth_mm >= 0 and self.local_mm >= 0 and min(lengths) > 0):
            raise StudyError(
                "displacement prior: expected affine_mm > 0, other sizes >= 0 and lengths > 0, "
                f"got {self}; DisplacementPrior() has those chosen on development people"
            )

    def covariance(self, one: Floats, other: Floats) -> Floats:
        """Covariance (n, m) mm² of one component of the displacement between places (n, 3) and (m, 3) mm."""
        return (
            self.affine_mm**2 * (1 + one @ other.T / self.affine_length_mm**2)
            + self.smooth_mm**2 * _gaussian(one / self.smooth_length_mm, other / self.smooth_length_mm)
            + self.local_mm**2 * _gaussian(one[:, :2] / self._local, other[:, :2] / self._local)
        )

    @property
    def _local(self) -> Floats:
        return np.array([self.local_left_mm, self.local_up_mm])

    def basis(self, places: Floats, n: int) -> DisplacementBasis:
        """Displacements that ``n`` of the places (k, 3) mm can tell apart (Nyström), each as likely as the others."""
        nodes = places[farthest_points(places, n)]
        covariance = self.covariance(nodes, nodes)
        covariance.flat[:: len(nodes) + 1] += 1e-6 * np.trace(covariance) / len(nodes)  # nodes may nearly coincide
        return DisplacementBasis(self, nodes, cholesky(covariance, lower=True))


@dataclass(frozen=True)
class DisplacementBasis:
    """Functions of place whose sum with independent standard normal weights has the prior's covariance.

    Attributes:
        prior: the prior.
        nodes: (m, 3) mm, chest coordinates.
        factor: (m, m) lower Cholesky factor of the nodes' covariance.
    """

    prior: DisplacementPrior
    nodes: Floats
    factor: Floats

    def at(self, places: Floats) -> Floats:
        """Their values (n, m) mm at places (n, 3) mm in chest coordinates."""
        values: Floats = solve_triangular(self.factor, self.prior.covariance(self.nodes, places), lower=True).T
        return values


@dataclass(frozen=True)
class DisplacementField:
    """A smooth displacement of space, known anywhere.

    Attributes:
        T_target_chest: chest coordinates to the target's frame.
        basis: functions of place, chest coordinates.
        weights: (m, 3) of each function in each component.
    """

    T_target_chest: RigidTransform
    basis: DisplacementBasis
    weights: Floats

    def apply(self, points: Floats) -> Floats:
        """Where aligned points (n, 3) mm, target frame, come to lie."""
        local = self.T_target_chest.inverse.apply(points)
        rows = np.split(local, range(_ROWS, len(local), _ROWS))
        return self.T_target_chest.apply(np.vstack([part + self.basis.at(part) @ self.weights for part in rows]))


def _gaussian(one: Floats, other: Floats) -> Floats:
    squared = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2 * one @ other.T
    values: Floats = np.exp(-np.maximum(squared, 0.0) / 2)
    return values
