"""The front wall of the chest as a flat picture, in which a landmark can be picked and turned into millimetres.

Cartilages lie in a sheet 20-30 mm thick in front of the lungs. Flattened along the direction front to back, that
sheet shows ribs, cartilages and sternum side by side, as a surgeon draws them, and each pixel knows its depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from study.errors import StudyError
from study.types import Floats, Volume


@dataclass(frozen=True)
class WallImage:
    """The flattened wall; row r is height ``z_mm[r]``, column c is ``x_mm[c]``, in the CT's own axes.

    Attributes:
        image: (rows, columns) mean density of the sheet, clipped to soft tissue and bone, HU.
        depth_mm: (rows, columns) y of the dense tissue in the sheet; NaN outside the chest.
        x_mm: (columns,) R is positive.
        z_mm: (rows,) upwards.
    """

    image: Floats
    depth_mm: Floats
    x_mm: Floats
    z_mm: Floats

    def pick(self, x_mm: float, z_mm: float) -> Floats:
        """The point (3,) RAS+ mm under a pick in the picture: median depth of the 5 mm around it.

        Raises:
            StudyError: outside the picture or the chest.
        """
        near = np.hypot(self.x_mm[None] - x_mm, self.z_mm[:, None] - z_mm) <= 5.0
        if not np.isfinite(self.depth_mm[near]).any():
            raise StudyError(
                f"expected a pick on the chest wall, got x = {x_mm:g}, z = {z_mm:g} mm; outside the picture"
            )
        return np.array([x_mm, np.nanmedian(self.depth_mm[near]), z_mm])


def anterior_wall_image(ct: Volume, thickness_mm: float = 24.0, step_mm: float = 1.0) -> WallImage:
    """Flatten the sheet in front of the lungs.

    Args:
        ct: Hounsfield units, with axes along R, A, S (a patient lying straight).
        thickness_mm: from the lung's front forwards.
        step_mm: pixel size.

    Raises:
        StudyError: no lung in sight, or a grid turned away from the patient's axes.
    """
    if np.diag(ct.T_ras_index.rotation).min() < 0.98:
        raise StudyError(f"{ct.name}: expected a grid along the patient's axes, got a turned one; resample it first")
    shape = np.floor((np.array(ct.shape) - 1) * ct.spacing_mm / step_mm).astype(int) + 1
    density = ndimage.affine_transform(
        ct.values, step_mm / ct.spacing_mm, output_shape=tuple(shape), order=1, output=np.float32
    )
    body, _ = ndimage.label(ndimage.binary_opening(density > -300, iterations=2))
    body = body == np.bincount(body.ravel())[1:].argmax() + 1
    skin = shape[1] - 1 - body[:, ::-1].argmax(axis=1)  # (x, z), the frontmost body voxel
    inside = np.arange(shape[1])[None, :, None] < skin[:, None] - 5.0 / step_mm
    lung = ndimage.binary_opening((density < -500) & inside, iterations=2)
    front = shape[1] - 1 - lung[:, ::-1].argmax(axis=1)
    known = lung.any(axis=1) & body.any(axis=1) & (skin - front < 80.0 / step_mm)
    if known.mean() < 0.05:
        raise StudyError(
            f"{ct.name}: expected lungs behind the chest wall, got none; is this a chest CT in Hounsfield units?"
        )
    front = _smooth_known(front.astype(np.float64), known, 8.0 / step_mm)
    sheet = np.arange(-3.0, thickness_mm, step_mm) / step_mm
    i, k = np.meshgrid(np.arange(shape[0]), np.arange(shape[2]), indexing="ij")
    rows = front[..., None] + sheet
    places = np.stack([np.broadcast_to(i[..., None], rows.shape), rows, np.broadcast_to(k[..., None], rows.shape)])
    samples = ndimage.map_coordinates(density, places, order=1, mode="nearest")
    weight = (samples - 60.0).clip(0.0, 200.0) + 1e-3
    depth = (rows * weight).sum(axis=-1) / weight.sum(axis=-1)
    origin = ct.to_mm([[0, 0, 0]])[0]
    depth_mm = np.where(body.any(axis=1), origin[1] + depth * step_mm, np.nan)
    image = samples.clip(-50.0, 250.0).mean(axis=-1)
    return WallImage(
        image.T, depth_mm.T, origin[0] + np.arange(shape[0]) * step_mm, origin[2] + np.arange(shape[2]) * step_mm
    )


def _smooth_known(values: Floats, known: np.ndarray, sigma: float) -> Floats:
    """Known values blurred; unknown ones (the mediastinum, which has no lung in front) bridged from their sides."""
    filled = np.where(known, values, 0.0)
    result = np.full(values.shape, np.nan)
    for scale in (1.0, 2.0, 4.0, 8.0, 32.0):
        weight = ndimage.gaussian_filter(known.astype(float), sigma * scale)
        blurred = ndimage.gaussian_filter(filled, sigma * scale) / np.maximum(weight, 1e-9)
        result = np.where(np.isnan(result) & (weight > 0.1), blurred, result)
    return np.where(np.isnan(result), np.median(values[known]), result)
