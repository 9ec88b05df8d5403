"""What the growth of cartilage assumes of adult anatomy and of Hounsfield units, and the image it works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from study.ct.landmarks import Landmarks
from study.errors import StudyError
from study.types import Bools, Floats, RigidTransform, Volume

GRID_MM = 1.0  # all of the growth is done on an isotropic grid, so that voxels are millimetres
MARGIN_MM = 25.0  # around the landmarks
AIR_HU = -200.0  # a chest CT in Hounsfield units has lung and room air far below this


@dataclass(frozen=True)
class Growth:
    """What the growth assumes of adult anatomy and of Hounsfield units.

    Attributes:
        bone_hu: the sternum's shell is denser than this, uncalcified cartilage (92 ± 25) is not.
        sternum_depth_mm: bone farther than this from the midline, front or back, is no sternum.
        sternum_half_width_mm: the same to the sides.
        sternum_reach_mm: slices whose shell is open, at the joints, borrow their outline from this far up and down.
        muscle_hu: on the middle line, tissue below this is expensive; muscle is about 55.
        window_hu: densities outside are clipped before edges are sought: calcification and lung are no steeper than
            muscle.
        edge_hu_per_mm: slope that counts as much as lying one ``shape_sd_mm`` off the expected radius.
        shape_sd_mm: see there.
        half_thickness_mm: expected radius across the chest wall.
        half_width_mm: expected radius along it.
    """

    bone_hu: float = 150.0
    sternum_depth_mm: float = 14.0
    sternum_half_width_mm: float = 28.0
    sternum_reach_mm: float = 10.0
    muscle_hu: float = 60.0
    window_hu: tuple[float, float] = (20.0, 120.0)
    edge_hu_per_mm: float = 20.0
    shape_sd_mm: float = 4.0
    half_thickness_mm: float = 5.0
    half_width_mm: float = 6.5


def isotropic(ct: Volume, points: Floats) -> Volume:
    """The box around ``points`` on a 1 mm grid along the CT's axes.

    Raises:
        StudyError: not in Hounsfield units, or points outside the image.
    """
    index = ct.to_index(points)
    outside = ((index < -0.5) | (index > np.array(ct.shape) - 0.5)).any(axis=1)
    if outside.any():
        first = points[outside][0].round(1).tolist()
        raise StudyError(
            f"{ct.name}: expected every landmark inside the image, got {outside.sum()} outside (first {first} mm); "
            "the field of view ends before, or they belong to another scan"
        )
    margin = MARGIN_MM / ct.spacing_mm
    low, high = np.floor(index.min(axis=0) - margin), np.ceil(index.max(axis=0) + margin) + 1
    box = ct.crop(low.astype(int), high.astype(int))
    shape = tuple(int(n) for n in np.floor((np.array(box.shape) - 1) * box.spacing_mm / GRID_MM) + 1)
    step = GRID_MM / box.spacing_mm
    values = ndimage.affine_transform(box.values, step, output_shape=shape, order=1, output=np.float32)
    if values.min() > AIR_HU:
        raise StudyError(
            f"{ct.name}: expected Hounsfield units, with lung below {AIR_HU:g}, got a minimum of {values.min():.0f} "
            "in the chest; subtract the scanner's offset"
        )
    return Volume(
        values, np.full(3, GRID_MM), RigidTransform(box.T_ras_index.rotation, box.to_mm([[0, 0, 0]])[0]), ct.name
    )


def check_in_tissue(image: Volume, landmarks: Landmarks) -> None:
    """A cartilage's ends lie in tissue, not in fat, lung or air.

    Raises:
        StudyError: one does not; the message names it.
    """
    smooth = ndimage.gaussian_filter(image.values.clip(-200, 400), 3.0)
    for what, points in (("junction", landmarks.junctions), ("attachment", landmarks.attachments)):
        for part, point in points.items():
            density = ndimage.map_coordinates(smooth, image.to_index(point)[:, None], order=1, mode="nearest")[0]
            if density < 0.0:
                raise StudyError(
                    f"{image.name}: expected cartilage or bone at the {what} of {part.name.lower()}, got {density:.0f} "
                    f"HU at {np.round(point, 1).tolist()} mm (fat or lung); check the landmark and the orientation"
                )


def path_cost(image: Volume, ribs: Bools, growth: Growth) -> Floats:
    """What a millimetre of a middle line costs in each voxel: 1 in cartilage, more in muscle, 100 in fat and lung.

    Args:
        image: Hounsfield units on the 1 mm grid.
        ribs: where bone of ribs is, which would be cheap by its density.
        growth: assumptions.
    """
    smooth = ndimage.gaussian_filter(image.values.clip(-200, 400), 2.0)
    cost: Floats = 1 + 30 / (1 + np.exp((smooth - growth.muscle_hu + 20) / 10))
    cost[smooth < 0] = 100.0  # fat and lung
    cost[ribs] = 5.0
    return cost
