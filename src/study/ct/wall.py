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

PICK_MM = 5.0  # around a pick
DISC_MM = 3.0  # of the column under it
STEP_MM = 0.5  # along it
UNDER_SKIN_MM, WALL_MM = 4.0, 80.0  # from the skin: where the column begins and ends
DENSE_HU = 60.0  # muscle has 55, cartilage 90
ENOUGH_HU_MM = 150.0  # above it, summed over the thickness
DEEPER_MM = 8.0  # what lies so much behind the sheet is no wall
BONE_HU = 150.0
HALF_BONE_MM = 7.0  # of the sternum, front to back
MARROW_MM, MARROW_HU = 8.0, -20.0
LUNG_WIDTH_MM = 60.0  # of both lungs together, in a slice of the chest
CHEST_MM = 100.0  # height over which lungs lie behind the wall; the lungs of an abdominal CT end above


@dataclass(frozen=True)
class WallImage:
    """The flattened wall; row r is height ``z_mm[r]``, column c is ``x_mm[c]``, in the CT's own axes.

    Attributes:
        image: (rows, columns) mean density of the sheet, clipped to soft tissue and bone, HU.
        depth_mm: (rows, columns) y of the dense tissue in the sheet; NaN outside the chest.
        x_mm: (columns,) R is positive.
        z_mm: (rows,) upwards.
        skin_mm: (rows, columns) y of the skin; NaN beside the body.
        ct: what was flattened.
    """

    image: Floats
    depth_mm: Floats
    x_mm: Floats
    z_mm: Floats
    skin_mm: Floats
    ct: Volume

    def pick(self, x_mm: float, z_mm: float) -> Floats:
        """The point (3,) RAS+ mm in bone or cartilage under a pick in the picture.

        The sheet follows the lungs. Where none lie behind it, as behind the manubrium, it runs too deep; so the middle
        of the first dense tissue under the skin counts, unless that is deeper than the sheet's and so no wall.

        Raises:
            StudyError: outside the picture or the chest, or nothing as dense as cartilage there.
        """
        near = np.hypot(self.x_mm[None] - x_mm, self.z_mm[:, None] - z_mm) <= PICK_MM
        place = f"x = {x_mm:g}, z = {z_mm:g} mm"
        if not np.isfinite(self.depth_mm[near]).any():
            raise StudyError(f"expected a pick on the chest wall, got {place}; outside the picture")
        y_mm, density = self._column(x_mm, z_mm)
        sheet_mm = float(np.nanmedian(self.depth_mm[near]))
        first_mm = _first_dense(y_mm, density)
        depth_mm = sheet_mm if first_mm is None or first_mm < sheet_mm - DEEPER_MM else first_mm
        here = np.abs(y_mm - depth_mm) <= HALF_BONE_MM  # a shell of bone beside marrow, which may be fat
        found = float(density[here].max(initial=-np.inf))
        if found < DENSE_HU:
            raise StudyError(
                f"{self.ct.name}: expected bone or cartilage under {place}, got at most {found:.0f} HU at the wall, "
                f"y = {depth_mm:.1f} mm; pick a brighter place"
            )
        return np.array([x_mm, depth_mm, z_mm])

    def _column(self, x_mm: float, z_mm: float) -> tuple[Floats, Floats]:
        """Depths (n,) mm from the skin backwards, and the density (n,) HU there, mean of a disc."""
        nearest = np.abs(self.z_mm - z_mm).argmin(), np.abs(self.x_mm - x_mm).argmin()
        y_mm = self.skin_mm[nearest] - np.arange(UNDER_SKIN_MM, WALL_MM, STEP_MM)
        grid = np.arange(-DISC_MM, DISC_MM + 0.5)
        disc = np.array([(dx, dz) for dx in grid for dz in grid if np.hypot(dx, dz) <= DISC_MM])
        places = np.empty((len(y_mm), len(disc), 3))
        places[..., 0], places[..., 1], places[..., 2] = x_mm + disc[:, 0], y_mm[:, None], z_mm + disc[:, 1]
        index = self.ct.to_index(places.reshape(-1, 3)).T
        samples = ndimage.map_coordinates(self.ct.values, index, output=np.float64, order=1, mode="nearest")
        return y_mm, ndimage.gaussian_filter1d(samples.reshape(len(y_mm), -1).mean(axis=1), 1.0 / STEP_MM)


def _first_dense(y_mm: Floats, density: Floats) -> float | None:
    """Middle (mm) of the first tissue under the skin that is thick and dense enough for cartilage; None without.

    Bone has two shells with marrow between them: they count as one.
    """
    labels, n = ndimage.label(density > DENSE_HU)
    runs = [np.flatnonzero(labels == one) for one in range(1, n + 1)]
    for one, run in enumerate(runs):
        if (density[run] - DENSE_HU).sum() * STEP_MM < ENOUGH_HU_MM:
            continue
        first, last = run[0], run[-1]
        if one + 1 < n:
            behind = runs[one + 1]
            bone = min(density[run].max(), density[behind].max()) > BONE_HU
            if bone and (behind[0] - last) * STEP_MM <= MARROW_MM and density[last : behind[0]].min() > MARROW_HU:
                last = behind[-1]
        return float(y_mm[first] + y_mm[last]) / 2
    return None


def anterior_wall_image(ct: Volume, thickness_mm: float = 24.0, step_mm: float = 1.0) -> WallImage:
    """Flatten the sheet in front of the lungs.

    Args:
        ct: Hounsfield units, with axes along R, A, S (a patient lying straight).
        thickness_mm: from the lung's front forwards.
        step_mm: pixel size.

    Raises:
        StudyError: no lung in sight or an abdomen's, or a grid turned away from the patient's axes.
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
    high_mm = float((known.sum(axis=0) * step_mm > LUNG_WIDTH_MM).sum() * step_mm)
    if high_mm < CHEST_MM:
        raise StudyError(
            f"{ct.name}: expected lungs behind at least {CHEST_MM:g} mm of the front wall, got {high_mm:.0f} of "
            f"{shape[2] * step_mm:.0f} mm; is this an abdomen? give a CT from the collar bones to the costal arch"
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
    skin_mm = np.where(body.any(axis=1), origin[1] + skin * step_mm, np.nan)
    return WallImage(
        samples.clip(-50.0, 250.0).mean(axis=-1).T,
        depth_mm.T,
        origin[0] + np.arange(shape[0]) * step_mm,
        origin[2] + np.arange(shape[2]) * step_mm,
        skin_mm.T,
        ct,
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
