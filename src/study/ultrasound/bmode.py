"""B-mode-like frames over a known surface: simulated, to try on what looks for the surface in them. Never measured.

The model is the common one of speckle: complex scatterers under a point spread function, their envelope compressed to
decibels. Over it lie what a bone does to a beam (a bright line, darker where it is tilted; a shadow behind; an echo
between probe and bone at twice the depth) and what else is bright in a chest wall (skin, sheets of connective tissue).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from study.errors import StudyError
from study.types import Bools, Floats
from study.ultrasound.cloud import upper_contour

PULSE_MM = 0.18  # standard deviations of the point spread function, along the beam and across
BEAM_MM = 0.45
FLOOR_DB, TOP_DB = -24.0, 26.0  # what the grey levels 0 and 255 stand for, above the mean speckle
ELECTRONIC_DB = -26.0
ATTENUATION_DB_MM = 0.2  # what the gain over time leaves
SHEETS = (4, 10)  # sheets of connective tissue in a frame
CHUNK = 32  # frames held as complex doubles at once


@dataclass(frozen=True)
class Echo:
    """What a surface does to the beam; levels in dB above the speckle of muscle.

    Attributes:
        surface_db: of the surface met at a right angle.
        fall: how fast that falls with tilt, dB for a cosine of 0.5.
        behind_db: of what lies behind it.
        thickness_mm: how far that reaches; infinite for a shadow.
        back_db: of the far side, where there is one.
        twice_db: of the echo at twice the depth, against that of the surface.
    """

    surface_db: float
    fall: float
    behind_db: float
    thickness_mm: float = float("inf")
    back_db: float = 0.0
    twice_db: float = -14.0


BONE = Echo(surface_db=20.0, fall=14.0, behind_db=-24.0)
# Cartilage that is not calcified lets the beam through: a weaker line, a dark inside, and its far side.
CARTILAGE = Echo(surface_db=13.0, fall=12.0, behind_db=-14.0, thickness_mm=9.0, back_db=6.0, twice_db=-20.0)


def simulate_bmode(
    masks: Bools, pixel_spacing_mm: tuple[float, float], rng: np.random.Generator, *, echo: Echo = BONE
) -> NDArray[np.uint8]:
    """B-mode-like frames whose surface is the upper edge of known masks: simulated, not measured.

    Args:
        masks: (f, h, w) bool, row 0 at the transducer, without an annotator's jitter.
        pixel_spacing_mm: (sx, sy) mm.
        rng: draws scatterers, sheets and noise.
        echo: what the surface does to the beam.

    Returns:
        (f, h, w) grey levels.

    Raises:
        StudyError: masks that are no stack of images.
    """
    if masks.ndim != 3 or 0 in masks.shape:
        raise StudyError(f"expected masks (frames, rows, columns), got {masks.shape}; pass those of a sweep")
    depth = np.full((len(masks), masks.shape[2]), np.inf)
    frames, columns, rows = upper_contour(masks)
    depth[frames, columns] = rows * pixel_spacing_mm[1]
    depth = _without_steps(depth, *pixel_spacing_mm)
    images = np.empty(masks.shape, dtype=np.uint8)
    for start in range(0, len(masks), CHUNK):
        block = slice(start, start + CHUNK)
        images[block] = _frames(depth[block], masks.shape[1], pixel_spacing_mm, rng, echo)
    return images


def _frames(
    depth: Floats, n_rows: int, spacing_mm: tuple[float, float], rng: np.random.Generator, echo: Echo
) -> NDArray[np.uint8]:
    """Frames (f, h, w) over surfaces at ``depth`` (f, w) mm, infinite where there is none."""
    (n_frames, n_columns), (sx, sy) = depth.shape, spacing_mm
    at = (np.arange(n_rows) * sy)[:, None]
    shape = (n_frames, n_rows, n_columns)
    tissue = _tissue_db(shape, spacing_mm, rng)
    sheets = _sheets_db(shape, spacing_mm, rng)
    below = at - depth[:, None, :]
    inside = (below > 0) & (below < echo.thickness_mm)
    tissue = np.where(inside, np.minimum(tissue, 0.0) + echo.behind_db, np.logaddexp(tissue, sheets))
    tissue -= ATTENUATION_DB_MM * at
    psf = (0.0, PULSE_MM / sy, BEAM_MM / sx)
    speckle = [gaussian_filter(10 ** (tissue / 20) * rng.normal(size=shape), psf, mode="reflect") for _ in range(2)]
    # The envelope of speckle under this point spread function has this mean where the amplitude is one.
    gain = np.sqrt(4 * np.pi * psf[1] * psf[2]) / np.sqrt(np.pi / 2)
    field = gain * (speckle[0] + 1j * speckle[1])
    # A surface is seen whole, but its brightness wanders along it, and with its tilt.
    wander = gaussian_filter1d(rng.normal(size=depth.shape), 1.5 / sx, axis=1) * np.sqrt(2 * np.sqrt(np.pi) * 1.5 / sx)
    phase = np.exp(2j * np.pi * rng.random((n_frames, 1, 1)))
    seen = np.isfinite(depth)
    flat = np.where(seen, depth, 0.0)
    tilt = np.gradient(np.where(seen, depth, np.nan), sx, axis=1)
    cosine = 1 / np.hypot(1.0, np.nan_to_num(tilt))
    level = echo.surface_db + 3.0 * wander + echo.fall * np.log2(np.maximum(cosine, 0.25))
    for factor, offset_mm, db in (
        (1.0, 0.0, level),
        (2.0, 0.0, level + echo.twice_db),
        (1.0, echo.thickness_mm, np.full_like(level, echo.back_db)),
    ):
        place = factor * flat + offset_mm
        if np.isfinite(offset_mm):
            line = np.exp(-0.5 * ((at - place[:, None, :]) / (1.5 * PULSE_MM)) ** 2)
            amplitude = 10 ** ((db - ATTENUATION_DB_MM * place) / 20) * seen
            field += phase * line * amplitude[:, None, :]
    field *= 10 ** (_contact_db(depth.shape, sx, rng) / 20)[:, None, :]
    noise = 10 ** (ELECTRONIC_DB / 20) * (rng.normal(size=shape) + 1j * rng.normal(size=shape))
    shown = 20 * np.log10(np.abs(field + noise) + 1e-9)
    grey: NDArray[np.uint8] = np.rint(255 * np.clip((shown - FLOOR_DB) / (TOP_DB - FLOOR_DB), 0, 1)).astype(np.uint8)
    return grey


def _without_steps(depth: Floats, sx: float, sy: float) -> Floats:
    """Depths (f, w) mm without the steps of the masks' rows; as they are at edges and jumps."""
    seen = np.isfinite(depth)
    weight = gaussian_filter1d(seen.astype(np.float64), 1.0 / sx, axis=1, mode="constant")
    total = gaussian_filter1d(np.where(seen, depth, 0.0), 1.0 / sx, axis=1, mode="constant")
    smooth = np.divide(total, weight, out=depth.copy(), where=seen & (weight > 0.99))
    moved = np.abs(np.subtract(smooth, depth, out=np.full(depth.shape, np.inf), where=seen))
    return np.where(moved < sy, smooth, depth)


def _contact_db(shape: tuple[int, int], sx: float, rng: np.random.Generator) -> Floats:
    """What a strip of poor contact takes (f, w), dB: in every third frame one, a few millimetres wide."""
    x = np.arange(shape[1]) * sx
    middle, width = rng.uniform(0, x[-1], (shape[0], 1)), rng.uniform(1, 4, (shape[0], 1))
    depth = rng.uniform(6, 18, (shape[0], 1)) * (rng.random((shape[0], 1)) < 0.33)
    loss: Floats = -depth * np.exp(-(((x - middle) / width) ** 2))
    return loss


def _tissue_db(shape: tuple[int, int, int], spacing_mm: tuple[float, float], rng: np.random.Generator) -> Floats:
    """How bright tissue is (f, h, w), dB: layers and patches of muscle and fat, and a bright skin."""
    sx, sy = spacing_mm
    sigma = (0.0, 1.5 / sy, 4.0 / sx)
    patches = gaussian_filter(rng.normal(size=shape), sigma, mode="reflect")
    patches *= 3.0 * np.sqrt(4 * np.pi * sigma[1] * sigma[2])
    skin = 10.0 * np.exp(-(np.arange(shape[1]) * sy) / 1.2)
    bright: Floats = patches + skin[:, None]
    return bright


def _sheets_db(shape: tuple[int, int, int], spacing_mm: tuple[float, float], rng: np.random.Generator) -> Floats:
    """Bright sheets (f, h, w), dB, far below zero where there are none: thin, nearly level, broken."""
    n_frames, n_rows, n_columns = shape
    sx, sy = spacing_mm
    sheets = np.full(shape, -80.0)
    x = np.arange(n_columns) * sx
    at = (np.arange(n_rows) * sy)[:, None]
    for frame in range(n_frames):
        for _ in range(rng.integers(*SHEETS)):
            middle, slope, bend = rng.uniform(2, n_rows * sy), rng.normal(0, 0.08), rng.normal(0, 0.002)
            start, length = rng.uniform(-10, n_columns * sx), rng.uniform(5, 40)
            place = middle + slope * (x - start) + bend * (x - start) ** 2
            level = np.where((x > start) & (x < start + length), rng.uniform(6, 15), -80.0)
            line = level - 0.5 * ((at - place) / 0.25) ** 2 * 8.7
            sheets[frame] = np.maximum(sheets[frame], line)
    return sheets
