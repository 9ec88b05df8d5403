"""A small stored image with one marked voxel."""

from __future__ import annotations

import numpy as np
import SimpleITK as sitk

from study.types import Volume

SPACING = (0.7, 0.9, 2.5)
SIZE = (6, 7, 5)
MARKED = (4, 1, 3)  # voxel i, j, k of the stored image
LPS_TO_RAS = np.array([-1.0, -1.0, 1.0])


def stored_image(direction: np.ndarray | None = None, dtype: type = np.int16) -> sitk.Image:
    values = np.full(SIZE[::-1], -1000, dtype=dtype)
    values[MARKED[::-1]] = 300
    image = sitk.GetImageFromArray(values)
    image.SetSpacing(SPACING)
    image.SetOrigin((-120.0, 80.0, -340.0))
    image.SetDirection((np.eye(3) if direction is None else direction).ravel().tolist())
    return image


def marked_mm(volume: Volume) -> np.ndarray:
    return volume.to_mm(np.argwhere(volume.values == 300))[0]
