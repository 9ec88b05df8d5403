"""Deformations of the kinds and sizes found between people, to be planted into a real anatomy."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from study.errors import StudyError
from study.geometry.points import fit_rigid
from study.phantom.deformation import Affine, Bumps, Deformation, DeformationStep
from study.types import Floats, RigidTransform, as_points

MAX_SIZE_MM = 20.0  # twice what people differ by
N_CALIBRATION = 1500  # points that decide the size of a planted deformation; more do not move its third digit


def breathing(centre: Floats, rng: np.random.Generator) -> tuple[DeformationStep, ...]:
    """The steps of quiet breathing: the chest's front moves 3-5 mm up and forward and 1-2 mm outwards on each side.

    Args:
        centre: (3,) mm, on the sternum between levels 3 and 5, where the motion is largest.
        rng: draws the sizes of the motion.
    """
    up, forward, outward = rng.uniform([3, 3, 1], [5, 5, 2])
    x, y, z = centre
    return (
        Bumps.one(2, (x, y, z - 10), (np.inf, np.inf, 70), up),
        Bumps.one(1, (x, y, z - 10), (90, np.inf, 70), forward),
        Bumps(
            0,
            np.array([[x + 70, y, z - 10], [x - 70, y, z - 10]]),
            np.array([[45, np.inf, 70], [45, np.inf, 70]]),
            outward * np.array([1.0, -1.0]),
        ),
    )


def rib_bending(
    centre: Floats, levels_z: Floats, size_mm: float, band_mm: float, rng: np.random.Generator
) -> tuple[DeformationStep, ...]:
    """The steps that bend each rib on its own, up or down and in or out, on each side.

    Args:
        centre: (3,) mm, the middle of the sternum.
        levels_z: (k,) mm, heights of the ribs at ``centre`` ± 55 mm.
        size_mm: standard deviation of the displacement at the middle of the bend, cut at two of them.
        band_mm: standard deviation of a band along z; about half the distance of two ribs.
        rng: draws the bends.
    """
    sides = np.tile([55.0, -55.0], len(levels_z))
    centres = np.column_stack([centre[0] + sides, np.full(len(sides), centre[1]), np.repeat(levels_z, 2)])
    heights = size_mm * np.clip(rng.normal(size=(2, len(sides))), -2, 2)
    # Bands to the front or back may be narrow, as y does not fold along z; those along z must not fold.
    out = Bumps(1, centres, np.tile([30.0, np.inf, band_mm], (len(sides), 1)), heights[0])
    up = tuple(
        Bumps.one(2, middle, (30.0, np.inf, 1.6 * band_mm), height)
        for middle, height in zip(centres, heights[1], strict=True)
    )
    return (out, *up)


def planted_deformation(points: Floats, size_mm: float, rng: np.random.Generator) -> Deformation:
    """A smooth deformation of a real anatomy, of the kinds and sizes found between people.

    Stretch, bend of the sternum, bulge of the chest, breathing and rib-by-rib bending, the lot scaled so that what
    remains after the best rigid alignment is ``size_mm`` on average. Breathing keeps its published size.

    Args:
        points: (n, 3) mm, RAS+, the surface of sternum and cartilages 2-5.
        size_mm: mean distance of ``points`` from their deformed places after a rigid fit; people differ by 5-10 mm.
        rng: draws the deformation.

    Raises:
        StudyError: a size that breathing alone exceeds, above 20 mm, or that would fold space.
    """
    points = as_points(points, "points to deform", at_least=50)
    sample = points[rng.permutation(len(points))[:N_CALIBRATION]]
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    centre = np.median(points, axis=0)
    centre[0] = (low[0] + high[0]) / 2
    levels_z = np.linspace(low[2], high[2], 4)
    stretch = 0.1 * np.clip(rng.normal(size=3), -1.5, 1.5)
    bend, bulge = rng.uniform(4.0, 9.0, 2) * rng.choice([-1, 1], 2)
    seed = int(rng.integers(2**63))

    def deformation(scale: float) -> Deformation:
        replay = np.random.default_rng(seed)  # the same ribs and breath at every scale
        return Deformation(
            (
                Affine.stretch(np.exp(scale * stretch), centre),
                Bumps.one(1, (centre[0], centre[1], centre[2] - 20), (np.inf, np.inf, 45), scale * bend),
                Bumps.one(1, (centre[0], centre[1], centre[2]), (50, np.inf, np.inf), scale * bulge),
                *rib_bending(centre, levels_z, 2.5 * scale, 16.0, replay),
                *breathing(centre, replay),
            )
        )

    def excess(scale: float) -> float:
        return residual_mm(sample, deformation(scale).apply(sample)) - size_mm

    breath_mm = residual_mm(sample, deformation(0.0).apply(sample))
    if not breath_mm < size_mm <= MAX_SIZE_MM:
        raise StudyError(
            f"expected a size between the {breath_mm:.2f} mm that breathing alone makes and {MAX_SIZE_MM:g} mm, "
            f"got {size_mm:g}; people differ by 5-10 mm"
        )
    scale = 1.0
    while excess(scale) < 0:
        scale *= 1.1  # a scale that folds space raises in its step
    return deformation(float(brentq(excess, 0.0, scale, xtol=1e-4)))


def residual_mm(source: Floats, target: Floats) -> float:
    """Mean distance (mm) of paired (n, 3) points after the best rigid alignment."""
    fitted: RigidTransform = fit_rigid(source, target)
    return float(np.linalg.norm(fitted.apply(source) - target, axis=1).mean())
