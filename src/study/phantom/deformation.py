"""Smooth invertible deformations of the chest, so that the truth of a registration is known.

A `Deformation` is a chain of steps, each of which is invertible by construction: an affine map, a roll of the plane
onto the rib cage, or a displacement along one axis that never folds. Nothing is interpolated, so ``inverse`` undoes
``apply`` to rounding, and every Jacobian determinant is positive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import expit

from study.errors import StudyError
from study.types import Floats

INVERSE_TOLERANCE_MM = 1e-9
MAX_SLOPE = 0.9  # a displacement along an axis that changes by less than 1 mm per mm cannot fold


class DeformationStep(Protocol):
    """One invertible map of space."""

    def apply(self, points: Floats) -> Floats:
        """Map (n, 3) mm."""
        ...

    def inverse(self, points: Floats) -> Floats:
        """Undo `apply`."""
        ...


@dataclass(frozen=True)
class Affine:
    """``origin + matrix (p - origin) + shift``; the determinant must be positive."""

    matrix: Floats  # (3, 3)
    origin: Floats  # (3,) mm
    shift: Floats  # (3,) mm

    def __post_init__(self) -> None:
        if not np.linalg.det(self.matrix) > 0:
            raise StudyError(
                f"expected a matrix of positive determinant, got {np.linalg.det(self.matrix):.3g}; "
                "a mirrored anatomy is not a deformation"
            )

    @classmethod
    def stretch(cls, factors: Floats, origin: Floats) -> Affine:
        """Stretch by three positive factors about ``origin``."""
        return cls(np.diag(factors), np.asarray(origin, float), np.zeros(3))

    @classmethod
    def motion(cls, angles_deg: Floats, shift: Floats, origin: Floats) -> Affine:
        """A rigid motion: turns about x, y, z through ``origin``, then ``shift``."""
        matrix = Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix()
        return cls(matrix, np.asarray(origin, float), np.asarray(shift, float))

    def apply(self, points: Floats) -> Floats:
        """Map (n, 3) mm."""
        return (points - self.origin) @ self.matrix.T + self.origin + self.shift

    def inverse(self, points: Floats) -> Floats:
        """Undo `apply`."""
        return np.linalg.solve(self.matrix, (points - self.origin - self.shift).T).T + self.origin


@dataclass(frozen=True)
class Roll:
    """Roll the plane y = 0 onto a rib cage: x becomes arc length on a circle that widens towards the feet.

    The line x = 0 stays in place; the radius is ``radius_mm * exp(-taper * z)``.
    """

    radius_mm: float
    taper: float  # 1/mm

    def _radius(self, z: Floats) -> Floats:
        return self.radius_mm * np.exp(-self.taper * z)

    def apply(self, points: Floats) -> Floats:
        """Map (n, 3) mm.

        Raises:
            StudyError: points at or behind the axis of the circle, y <= -radius, where the roll is not one to one.
        """
        x, y, z = points.T
        radius = self._radius(z)
        if (radius + y).min(initial=1.0) <= 0:
            raise StudyError(f"expected points in front of the axis of the chest, got y = {y.min():.0f} mm; crop them")
        return np.column_stack([(radius + y) * np.sin(x / radius), (radius + y) * np.cos(x / radius) - radius, z])

    def inverse(self, points: Floats) -> Floats:
        """Undo `apply`."""
        x, y, z = points.T
        radius = self._radius(z)
        return np.column_stack([radius * np.arctan2(x, radius + y), np.hypot(x, radius + y) - radius, z])


def _undo_displacement(points: Floats, axis: int, displacement: Callable[[Floats], tuple[Floats, Floats]]) -> Floats:
    """Solve ``q + displacement(q) = points`` along one axis by Newton's method."""
    moved = points.copy()
    for _ in range(60):
        offset, slope = displacement(moved)
        residual = moved[:, axis] + offset - points[:, axis]
        moved[:, axis] -= residual / (1 + slope)
        if np.abs(residual).max(initial=0.0) < INVERSE_TOLERANCE_MM:
            return moved
    raise StudyError("expected an invertible displacement, got one that Newton's method cannot undo; lower its size")


@dataclass(frozen=True)
class Ramp:
    """Displace ``axis`` by ``slope`` mm per mm of ``along`` beyond ``start_mm``, starting over ``blend_mm``.

    Along its own axis it is a stretch of one half of space; along another it is a bend with a knee.
    ``direction`` -1 is the half below ``start_mm``.
    """

    axis: int
    along: int
    slope: float
    start_mm: float
    blend_mm: float
    direction: int = 1

    def __post_init__(self) -> None:
        # A stretch of one half has this derivative: 1 + direction * slope, which must stay well above 0.
        if self.axis == self.along and self.direction * self.slope < -MAX_SLOPE:
            raise StudyError(f"expected a slope that does not fold space, got {self.slope:g}; stay above -{MAX_SLOPE}")

    def _displacement(self, points: Floats) -> tuple[Floats, Floats]:
        t = self.direction * (points[:, self.along] - self.start_mm) / self.blend_mm
        own = self.direction * self.slope * expit(t) if self.axis == self.along else np.zeros(len(points))
        return self.slope * self.blend_mm * np.logaddexp(0.0, t), own

    def apply(self, points: Floats) -> Floats:
        """Map (n, 3) mm."""
        moved = points.copy()
        moved[:, self.axis] += self._displacement(points)[0]
        return moved

    def inverse(self, points: Floats) -> Floats:
        """Undo `apply`."""
        return _undo_displacement(points, self.axis, self._displacement)


@dataclass(frozen=True)
class Bumps:
    """Displace ``axis`` by a sum of Gaussian bumps; an infinite width makes a bump a band or a wall.

    Attributes:
        axis: 0, 1 or 2, the axis along which points move.
        centres: (k, 3) mm.
        widths: (k, 3) mm, standard deviations; ``inf`` where a bump does not depend on an axis.
        heights: (k,) mm.
    """

    axis: int
    centres: Floats
    widths: Floats
    heights: Floats

    def __post_init__(self) -> None:
        # Steepest slope of exp(-t^2/2) is exp(-1/2); neighbours may add up, so their sum is the safe bound.
        steepest = np.exp(-0.5) * np.abs(self.heights / self.widths[:, self.axis]).sum()
        if steepest > MAX_SLOPE:
            raise StudyError(
                f"expected bumps that cannot fold space (summed slope at most {MAX_SLOPE}), got {steepest:.2f}; "
                "lower the size or widen the bumps"
            )

    @classmethod
    def one(cls, axis: int, centre: ArrayLike, widths: ArrayLike, height: float) -> Bumps:
        """A single bump."""
        return cls(axis, np.array([centre], float), np.array([widths], float), np.array([float(height)]))

    def _displacement(self, points: Floats) -> tuple[Floats, Floats]:
        offset, slope = np.zeros(len(points)), np.zeros(len(points))
        for centre, width, height in zip(self.centres, self.widths, self.heights, strict=True):
            used = [axis for axis in range(3) if np.isfinite(width[axis])]
            t = (points[:, used] - centre[used]) / width[used]
            bump = height * np.exp(-0.5 * np.einsum("ni,ni->n", t, t))
            offset += bump
            if self.axis in used:
                slope -= bump * t[:, used.index(self.axis)] / width[self.axis]
        return offset, slope

    def apply(self, points: Floats) -> Floats:
        """Map (n, 3) mm."""
        moved = points.copy()
        moved[:, self.axis] += self._displacement(points)[0]
        return moved

    def inverse(self, points: Floats) -> Floats:
        """Undo `apply`."""
        return _undo_displacement(points, self.axis, self._displacement)


@dataclass(frozen=True)
class Deformation:
    """A chain of steps, first one first."""

    steps: tuple[DeformationStep, ...] = ()

    def apply(self, points: Floats) -> Floats:
        """Map (n, 3) mm."""
        moved = np.array(points, dtype=np.float64)
        for step in self.steps:
            moved = step.apply(moved)
        return moved

    def inverse(self, points: Floats) -> Floats:
        """Undo `apply`, (n, 3) mm, to about 1e-9 mm."""
        moved = np.array(points, dtype=np.float64)
        for step in reversed(self.steps):
            moved = step.inverse(moved)
        return moved

    def then(self, *steps: DeformationStep) -> Deformation:
        """This deformation followed by more steps."""
        return Deformation((*self.steps, *steps))

    def jacobian_determinant(self, points: Floats, step_mm: float = 1e-3) -> Floats:
        """Local volume change (n,) at (n, 3) mm by central differences; positive where nothing folds."""
        points = np.asarray(points, dtype=np.float64)
        columns = [
            (self.apply(points + offset) - self.apply(points - offset)) / (2 * step_mm)
            for offset in step_mm * np.eye(3)
        ]
        determinant: Floats = np.linalg.det(np.stack(columns, axis=-1))
        return determinant
