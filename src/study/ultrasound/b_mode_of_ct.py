"""A B-mode-like picture out of a CT, for the eye only: no method and no number of the study uses it.

The rules are those of a textbook: interfaces across the beam reflect, bone and air let nothing through, muscle speckles
more than cartilage does. So cartilage is a dark band with the pleural line beneath it, and bone a bright line with a
shadow, as in the paper's Fig. 1 c and d. It is simulated, and no substitute for a measured image.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from study.errors import StudyError
from study.types import Bools, Floats, Part, RigidTransform, Volume
from study.ultrasound.probe import Probe

_DYNAMIC_RANGE_DB = 55.0
_BONE_HU, _AIR_HU, _FAT_HU = 160.0, -300.0, -60.0  # bone as it is left after the blur of a CT


def ct_frame(
    volume: Volume, T_ras_image: RigidTransform, shape: tuple[int, int], pixel_mm: float, *, order: int = 1
) -> Floats:
    """A volume's values in the plane of an ultrasound image.

    Args:
        volume: Hounsfield units, or labels with ``order`` 0.
        T_ras_image: image frame (x along the aperture, y into the body, mm) to RAS+ mm.
        shape: (rows, columns) of the image.
        pixel_mm: edge of a pixel.
        order: of the interpolation.

    Returns:
        (rows, columns); outside of the volume, its nearest voxel.
    """
    rows, columns = np.indices(shape) * pixel_mm
    plane = np.stack([columns.ravel(), rows.ravel(), np.zeros(rows.size)], axis=1)
    places = volume.to_index(T_ras_image.apply(plane)).T
    values: Floats = ndimage.map_coordinates(volume.values, places, order=order, mode="nearest", output=np.float64)
    return values.reshape(shape)


def skin_depth_mm(volume: Volume, place_mm: Floats) -> float:
    """How far (mm) the frontmost tissue lies in front of a place (3,) RAS+ mm.

    Raises:
        StudyError: no tissue in front of that place.
    """
    i, _, k = np.round(volume.to_index(np.reshape(place_mm, (1, 3)))[0]).astype(int)
    inside = 0 <= i < volume.shape[0] and 0 <= k < volume.shape[2]
    tissue = np.flatnonzero(volume.values[i, :, k] > _AIR_HU) if inside else np.empty(0)
    if not len(tissue):
        raise StudyError(f"{volume.name}: expected tissue in front of {place_mm} mm, got none; take a place in the CT")
    return float(volume.to_mm([[i, tissue.max(), k]])[0, 1] - place_mm[1])


def frame_below(volume: Volume, mask: Volume, place_mm: Floats, probe: Probe, rng: np.random.Generator) -> Floats:
    """A B-mode-like frame of a CT: the probe on the skin in front of a place, its aperture along the body.

    Args:
        volume: Hounsfield units, axes along R, A, S.
        mask: `Part` values.
        place_mm: (3,) RAS+ mm, in the middle of the frame.
        probe: shape and pixel of the frame.
        rng: of the speckle.

    Raises:
        StudyError: no tissue in front of that place.
    """
    skin = place_mm[1] + skin_depth_mm(volume, place_mm)
    # x of the image runs to the feet, y to the back, so that the third axis runs to the patient's left.
    rotation = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
    T_ras_image = RigidTransform(rotation, np.array([place_mm[0], skin - 1.0, place_mm[2] + probe.aperture_mm / 2]))
    return frame_of(volume, mask, T_ras_image, probe.shape, probe.pixel_mm, rng)


def frame_of(
    volume: Volume,
    mask: Volume,
    T_ras_image: RigidTransform,
    shape: tuple[int, int],
    pixel_mm: float,
    rng: np.random.Generator,
) -> Floats:
    """A B-mode-like frame of a CT in any plane; arguments as of `ct_frame` and `b_mode_like`."""
    hu = ct_frame(volume, T_ras_image, shape, pixel_mm)
    parts = ct_frame(mask, T_ras_image, shape, pixel_mm, order=0)
    return b_mode_like(hu, parts > Part.STERNUM, pixel_mm, rng)


def b_mode_like(hu: Floats, cartilage: Bools, pixel_mm: float, rng: np.random.Generator) -> Floats:
    """Grey values, 0-1, of a picture that looks like B-mode; the transducer is above the first row.

    Args:
        hu: (rows, columns) Hounsfield units in the plane of the image.
        cartilage: (rows, columns) what is cartilage, which CT hardly tells from muscle.
        pixel_mm: edge of a pixel.
        rng: of the speckle.
    """
    smooth = ndimage.gaussian_filter(hu, 0.4 / pixel_mm)
    step = ndimage.gaussian_filter1d(smooth, 0.5 / pixel_mm, axis=0, order=1) * (1.0 / pixel_mm)  # HU a mm
    inside = ndimage.gaussian_filter(cartilage.astype(np.float64), 0.3 / pixel_mm)
    rim = np.abs(ndimage.gaussian_filter1d(inside, 0.4 / pixel_mm, axis=0, order=1)) / pixel_mm
    # The share of an interface's echo, and of tissue's own; fat is darker than muscle, cartilage nearly black.
    bone = (smooth > _BONE_HU) & (inside < 0.5)  # calcified cartilage is no bone
    reflected = np.clip(np.abs(step) / 400.0, 0.0, 1.0) ** 1.2 + 0.25 * np.clip(rim, 0.0, 1.0)
    reflected += 0.35 * bone * np.clip(step / 100.0, 0.0, 1.0)
    own = np.where(hu < _FAT_HU, 0.035, 0.07) * (1.0 - 0.88 * inside)
    own = np.where(bone | (hu < _AIR_HU), 0.004, own)
    speckle = ndimage.gaussian_filter(
        rng.normal(size=(2, *hu.shape)), (0, 0.12 / pixel_mm, 0.3 / pixel_mm)
    )  # of a wave: a real and an imaginary part
    grain = np.hypot(*speckle) / np.hypot(*speckle).mean()
    # Bone and air pass almost nothing; soft tissue loses some on the way.
    loss = np.where(bone, 4.0, np.where(hu < _AIR_HU, 0.9, 0.012)) * pixel_mm
    passed = np.exp(-np.cumsum(loss, axis=0))
    echo = passed * (reflected * (0.6 + 0.4 * grain) + own * grain)
    echo = ndimage.gaussian_filter(echo, (0.1 / pixel_mm, 0.2 / pixel_mm))
    decibel = 20.0 * np.log10(np.maximum(echo / np.percentile(echo, 99.7), 1e-6))
    picture: Floats = np.clip(1.0 + decibel / _DYNAMIC_RANGE_DB, 0.0, 1.0)
    return picture
