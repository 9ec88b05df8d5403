"""The CT of a synthetic subject and its labels: every voxel taken back to the canonical wall."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from study.errors import StudyError
from study.phantom.subject import SyntheticSubject
from study.phantom.wall import (
    BONE,
    STERNUM_HALF_THICKNESS_MM,
    centrelines,
    sternum_distance,
    tube_distance,
    wall_distance,
)
from study.types import Floats, Ints, RigidTransform, Volume

# Label ids of the volumes, those of TotalSegmentator 2.
STERNUM_ID, CARTILAGE_ID = 116, 117
LEFT_RIB_ID, RIGHT_RIB_ID = 91, 103  # plus the level

VIEW_LOW, VIEW_HIGH = (-118.0, -18.0, -158.0), (118.0, 24.0, 58.0)  # canonical, mm: a CT shows all of it
LATTICE_MM = 6.0  # of the voxels' approximate way back to the wall
NOISE_HU = 12.0


def ct_volume(subject: SyntheticSubject, spacing_mm: float, rng: np.random.Generator) -> tuple[Volume, Volume]:
    """A CT of the front of the chest and its labels, both on the same isotropic grid along R, A, S.

    Voxel centres are taken back to the canonical wall by φ⁻¹; a voxel that a surface cuts gets the mixture of both
    sides. Only voxels near bone or cartilage are taken back one by one: elsewhere a coarse lattice is interpolated,
    which moves the skin and the lungs by less than 0.1 mm.

    Args:
        subject: who.
        spacing_mm: about 1.5; 2.5 for a quick look.
        rng: the scanner's noise.

    Returns:
        int16 Hounsfield units, and uint8 labels with the ids of TotalSegmentator 2: 116 sternum, 117 costal
        cartilages (all of them), 92-103 left ribs 1-12, 104-115 right ribs 1-12.

    Raises:
        StudyError: a spacing that cannot show a cartilage.
    """
    if not 0.5 <= spacing_mm <= 4.0:
        raise StudyError(f"expected a spacing of 0.5-4 mm, got {spacing_mm:g}; a cartilage is only 10 mm thick")
    origin, shape = _field_of_view(subject, spacing_mm)
    canonical = _canonical_coordinates(subject, origin, shape, spacing_mm)
    x, y, z = canonical
    hu = _soft_tissue_hu(x, y, z, subject.fat_mm, spacing_mm)

    near = _voxels_near_the_wall(canonical, spacing_mm)
    exact = subject.phi.inverse(origin + spacing_mm * near)
    labels = np.zeros(shape, dtype=np.uint8)
    i, j, k = near.T
    hard, share, ids = _hard_tissue(exact, subject.cartilage_hu, spacing_mm)
    hu[i, j, k] += share * (hard - hu[i, j, k])
    labels[i, j, k] = ids

    noise = gaussian_filter(rng.standard_normal(shape, dtype=np.float32), 0.6)  # a scanner's noise is not white
    hu += (NOISE_HU / noise.std()) * noise
    grid = RigidTransform(translation=origin)
    spacing = np.full(3, float(spacing_mm))
    return (
        Volume(np.clip(np.round(hu), -1024, 3071).astype(np.int16), spacing, grid, f"phantom:{subject.name}"),
        Volume(labels, spacing, grid, f"labels of phantom:{subject.name}"),
    )


def _field_of_view(subject: SyntheticSubject, spacing_mm: float) -> tuple[Floats, tuple[int, ...]]:
    """Origin (3,) mm and shape of the grid that holds the whole view of a subject."""
    box = np.stack(np.meshgrid(*np.linspace(VIEW_LOW, VIEW_HIGH, 7).T, indexing="ij"), axis=-1).reshape(-1, 3)
    box = subject.phi.apply(box)
    origin = np.floor(box.min(axis=0))
    return origin, tuple(int(n) for n in np.ceil((box.max(axis=0) - origin) / spacing_mm) + 1)


def _voxels_near_the_wall(canonical: Floats, spacing_mm: float) -> Ints:
    """Voxels (v, 3) so near to bone or cartilage that their approximate place (3, i, j, k) will not do."""
    near = np.argwhere(np.abs(canonical[1]) < STERNUM_HALF_THICKNESS_MM + 3)
    approximate = canonical[:, near[:, 0], near[:, 1], near[:, 2]].T
    return near[wall_distance(approximate) < 1.5 + spacing_mm]


def _canonical_coordinates(
    subject: SyntheticSubject, origin: Floats, shape: tuple[int, ...], spacing_mm: float
) -> Floats:
    """Approximate φ⁻¹ (3, i, j, k) of all voxel centres, from a lattice of 6 mm."""
    step = LATTICE_MM / spacing_mm
    counts = [int(np.ceil((n - 1) / step)) + 1 for n in shape]
    lattice = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    values = subject.phi.inverse(origin + LATTICE_MM * lattice).reshape(*counts, 3)
    for axis, n in enumerate(shape):
        place = np.arange(n) / step
        below = np.minimum(place.astype(int), counts[axis] - 2)
        weight = (place - below).reshape([-1 if a == axis else 1 for a in range(4)])
        values = np.take(values, below, axis) * (1 - weight) + np.take(values, below + 1, axis) * weight
    return np.moveaxis(values, -1, 0)


def _soft_tissue_hu(x: Floats, y: Floats, z: Floats, fat_mm: float, spacing_mm: float) -> Floats:
    """Hounsfield units of air, skin, fat, muscle, lung and what lies between and below the lungs."""

    def beyond(distance: Floats) -> Floats:
        return np.clip(distance / spacing_mm + 0.5, 0, 1)

    muscle = 6.5 + 5 * (1 - np.exp(-((x / 25) ** 2)))  # next to none in front of the sternum
    skin = muscle + fat_mm
    dome = -95 - 0.004 * (np.abs(x) - 75) ** 2  # of the diaphragm
    # Behind the sternum the lungs leave room that widens with depth, more on the left, where the heart lies.
    straight, depth = x * (1 + y / 125), np.maximum(-y - 10, 0)
    heart = np.where(x < 0, 25 * np.clip((-20 - z) / 40, 0, 1), 0)
    lung = beyond(-y - 10) * beyond(z - dome) * beyond(np.abs(straight) - 12 - 0.4 * np.minimum(depth, 40) - heart)
    hu = np.full(x.shape, 50.0)
    hu += lung * (-850 - hu)
    for front, value in ((muscle, -100), (skin, 30), (skin + 2, -1000)):  # fat, skin, air
        hu += beyond(y - front) * (value - hu)
    return hu


def _hard_tissue(canonical: Floats, cartilage_hu: float, spacing_mm: float) -> tuple[Floats, Floats, Ints]:
    """Hounsfield units (n,) of bone or cartilage, its share (n,) of the voxel, and label ids (n,), 0 outside."""
    lines = centrelines()
    sternum = sternum_distance(canonical)
    tube, index = tube_distance(canonical)
    distance = np.minimum(sternum, tube)
    is_sternum = sternum <= tube
    is_bone = is_sternum | (lines.tissue[index] == BONE)
    cortex = np.clip((distance + 1.5) / spacing_mm + 0.5, 0, 1)  # the outer 1.5 mm of bone
    marrow = np.where(is_sternum, 110.0, 220.0)
    hu = np.where(is_bone, marrow + cortex * (550.0 - marrow), cartilage_hu)
    rib = lines.level[index] + np.where(lines.side[index] > 0, RIGHT_RIB_ID, LEFT_RIB_ID)
    ids = np.where(is_sternum, STERNUM_ID, np.where(is_bone, rib, CARTILAGE_ID))
    return hu, np.clip(0.5 - distance / spacing_mm, 0, 1), np.where(distance < 0, ids, 0)
