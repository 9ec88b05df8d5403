"""Synthetic people: an invertible map φ of the canonical chest wall, drawn from published sizes."""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np

from study.errors import StudyError
from study.phantom.deformation import Affine, Bumps, Deformation, Ramp, Roll
from study.phantom.planted import breathing, rib_bending
from study.phantom.sizes import (
    BODY_MM,
    CARTILAGE_MM,
    MANUBRIUM_MM,
    MAX_SD,
    MEASURED_HU,
    MEASURED_LENGTH_MM,
    MEASURED_STERNUM_MM,
    MEASURED_THICKNESS_MM,
    STERNAL_ANGLE_DEG,
    WALL_PER_M,
)
from study.phantom.wall import BODY_BOTTOM_MM, COURSES, STERNUM_TOP_MM

SUBJECTS = ("ct1", "ct2", "ct3", "ct4", "ct5", "patient")
POPULATION = tuple(f"p{k:02d}" for k in range(1, 13))  # people of the full spread
MAX_DRAWS = 50  # of one person of the full spread, until one can be inverted; most are at once
# Canonical, mm: every subject's φ must be invertible in all of it.
ROI_LOW, ROI_HIGH = (-150.0, -75.0, -175.0), (150.0, 30.0, 75.0)
MIN_VOLUME = 0.05  # of a unit of volume under φ; less is as good as folded


@dataclass(frozen=True)
class SyntheticSubject:
    """One synthetic person.

    Attributes:
        name: one of `SUBJECTS` or `POPULATION`.
        seed: the cohort's seed.
        phi: from the flat canonical wall (`study.phantom.wall`) to the subject's RAS+ frame, mm; invertible in the ROI.
        fat_mm: thickness of the fat under the skin.
        cartilage_hu: mean of the cartilage; it calcifies with age.
    """

    name: str
    seed: int
    phi: Deformation
    fat_mm: float
    cartilage_hu: float


def draw_subject(name: str, seed: int, max_sd: float = MAX_SD) -> SyntheticSubject:
    """One person of the cohort; the same ``name`` and ``seed`` give the same person.

    Lengths of manubrium, body and the 4th and 5th cartilage are drawn from published means and SDs; lengths of the 2nd
    and 3rd, thickness, the sternum's width and the cartilage's density from those measured on the open cohort; all cut
    at ``max_sd``, the wall's curvature from the upper part of the measured range.

    Args:
        name: one of `SUBJECTS` or `POPULATION`.
        seed: the cohort's seed.
        max_sd: how many SDs a draw may lie from its mean; ``inf`` for the whole spread. The tails then hold people that
            no invertible map makes, such as a chest wall that is hollow; they are drawn again, as a whole.

    Raises:
        StudyError: an unknown name, a spread that is not positive, or nobody in many draws whose map can be inverted.
    """
    if name not in (*SUBJECTS, *POPULATION):
        raise StudyError(f"expected a phantom subject of {', '.join((*SUBJECTS, *POPULATION))}, got {name!r}")
    if not max_sd > 0:
        raise StudyError(
            f"expected max_sd > 0, got {max_sd:g}; {MAX_SD} is the reported cohort's, inf the whole spread"
        )
    person = [seed, crc32(name.encode())]
    if max_sd <= MAX_SD:  # where every draw can be inverted
        return _draw(name, seed, max_sd, np.random.default_rng(person))
    for attempt in range(MAX_DRAWS):
        try:
            drawn = _draw(name, seed, max_sd, np.random.default_rng([*person, attempt]))
        except StudyError:  # a step that would fold space
            continue
        if is_invertible(drawn.phi):
            return drawn
    raise StudyError(f"{name}: expected an invertible person in {MAX_DRAWS} draws, got none; lower max_sd ({max_sd:g})")


def is_invertible(phi: Deformation) -> bool:
    """Whether φ can be undone in the whole region of interest and folds nowhere in it."""
    axes = (np.linspace(low, high, 13) for low, high in zip(ROI_LOW, ROI_HIGH, strict=True))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    try:
        back = phi.inverse(phi.apply(points))
    except StudyError:
        return False
    return bool(np.abs(back - points).max() < 1e-6 and phi.jacobian_determinant(points).min() > MIN_VOLUME)


def _draw(name: str, seed: int, max_sd: float, rng: np.random.Generator) -> SyntheticSubject:
    """One draw of one person."""

    def normal(mean: float, sd: float) -> float:
        return mean + sd * _cut(rng.normal(), max_sd)

    sex = int(rng.integers(2))
    lean_deg = 180 - normal(STERNAL_ANGLE_DEG, 4.0)
    middle = np.array([0.0, 0.0, -40.0])
    steps = (
        *_flat_stretch(
            manubrium=normal(*MANUBRIUM_MM[sex]) / STERNUM_TOP_MM * np.cos(np.radians(lean_deg)),
            body=normal(*BODY_MM[sex]) / -BODY_BOTTOM_MM,
            width=normal(1.0, MEASURED_STERNUM_MM[0][1] / MEASURED_STERNUM_MM[0][0]),
            thickness=normal(1.0, MEASURED_THICKNESS_MM[1] / MEASURED_THICKNESS_MM[0]),
            max_sd=max_sd,
            rng=rng,
        ),
        *rib_bending(middle, np.array([2.0, -29.0, -60.0, -97.0]), 2.2, 14.0, rng),
        Roll(1000.0 / normal(*WALL_PER_M), normal(2.0e-3, 4e-4)),
        # The manubrium leans back by what the sternal angle lacks to 180 degrees.
        Ramp(1, 2, -float(np.tan(np.radians(lean_deg))), 0.0, 3.0),
        _bend(normal(0.0, 3.0), normal(1.5, 2.5)),
        # The sternum's lower end lies farther forward; the last motion is how the person lies on the table.
        Affine.motion(np.array([normal(14.0, 3.0), 0.0, 0.0]), np.zeros(3), middle),
        *breathing(middle, rng),
        Affine.motion(rng.normal(scale=2.0, size=3), rng.normal(scale=10.0, size=3), middle),
    )
    return SyntheticSubject(name, seed, Deformation(steps), fat_mm=normal(10.0, 2.5), cartilage_hu=normal(*MEASURED_HU))


def _cut(draw: float, max_sd: float) -> float:
    return float(np.clip(draw, -max_sd, max_sd))


def _flat_stretch(
    manubrium: float, body: float, width: float, thickness: float, max_sd: float, rng: np.random.Generator
) -> tuple[Affine | Ramp | Bumps, ...]:
    """Stretch of the flat wall: sternum by part, then cartilages by side and level; factors of the canonical size."""
    # The cartilages of one person go together (correlation 0.8), the sides nearly so.
    z4 = _cut(rng.normal(), max_sd)
    lengths = []
    for level, (mean, sd) in sorted((MEASURED_LENGTH_MM | CARTILAGE_MM).items()):
        own = 0.8 * z4 + 0.6 * _cut(rng.normal(), max_sd)
        lengths.append(mean + sd * _cut(z4 if level == 4 else own, max_sd))
    canonical = np.array([COURSES[level][0] for level in (2, 3, 4, 5)])
    common = float((lengths / canonical).mean())
    sides = common / width * (1 + 0.02 * np.clip(rng.normal(size=2), -max_sd, max_sd)) - 1
    edge = 13.5 * width
    # What is left of each level's own length is a push along it, centred where its cartilage ends.
    push = lengths - canonical * common
    ends = edge + common * canonical * 0.95
    heights_z = body * np.array([3.0, -29.0, -60.0, -98.0])
    pushes = [
        Bumps.one(0, (side * x, 0, z), (20.0, np.inf, 13.0), side * np.clip(h, -8, 8))
        for side in (1, -1)
        for x, z, h in zip(ends, heights_z, push, strict=True)
    ]
    return (
        Affine.stretch(np.array([width, thickness, body]), np.zeros(3)),
        Ramp(2, 2, manubrium / body - 1, 0.0, 4.0),
        Ramp(0, 0, sides[0], edge, 4.0),
        Ramp(0, 0, -sides[1], -edge, 4.0, direction=-1),
        *pushes,
    )


def _bend(sternum_mm: float, bulge_mm: float) -> Bumps:
    """Bow the sternum's body, and the front across."""
    return Bumps(
        1,
        np.array([[0, 0, -45.0], [0, 0, 0.0]]),
        np.array([[np.inf, np.inf, 35.0], [45.0, np.inf, np.inf]]),
        np.array([sternum_mm, bulge_mm]),
    )
