"""Where bone and cartilage begin in B-mode frames: a baseline that needs no training.

Published parts, put together: the symmetry of local phase under log-Gabor filters marks bright ridges at any gain
(Kovesi 1997; for bone Hacihaliloglu et al. 2009), a confidence per beam falls where it has met a strong echo (after
Karamalis et al. 2012), what lies below bone is dark (Foroughi et al. 2007), and dynamic programming finds the strongest
smooth path through that, as they do. A path may begin and end anywhere: not every column shows bone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import gaussian_filter

from study.errors import StudyError
from study.types import Bools, Floats, Ints
from study.ultrasound.tracked import TrackedSweep

DARK = 0.08  # of a frame's brightest: a column without more has shown nothing

Progress = Callable[[Iterable[int]], Iterable[int]]


@dataclass(frozen=True)
class BoneFinder:
    """How the surface is looked for; the defaults were chosen on simulated frames and by eye on one real recording.

    Attributes:
        wavelengths_mm: of the log-Gabor filters, along the beam.
        tilts_deg: of the filters' axes off the beam.
        near_mm: skin and transducer, where nothing is looked for.
        shadow_mm: how far below a line it should be dark.
        least: likelihood from which a column pays for itself.
        slope: cost of one mm down per mm across, squared.
        turn_on: cost of a path's beginning, and of its end.
        alike: a piece of path whose mean likelihood is less than this share of the best piece's is soft tissue.
        apart_mm: a piece that begins this much higher or lower than where the best piece ends is soft tissue.
        shortest_mm: of a path across.
        line_mm: thickness of the mask that is drawn from the surface down.
        min_quality: frames below it are dropped.
    """

    wavelengths_mm: tuple[float, ...] = (1.6, 3.2)
    tilts_deg: tuple[float, ...] = (-30.0, 0.0, 30.0)
    near_mm: float = 3.0
    shadow_mm: float = 6.0
    least: float = 0.08
    slope: float = 0.03
    turn_on: float = 1.0
    alike: float = 0.7
    apart_mm: float = 6.0
    shortest_mm: float = 4.0
    line_mm: float = 1.0
    min_quality: float = 0.16


@dataclass(frozen=True)
class BoneSurface:
    """What was found in the frames of a sweep.

    Attributes:
        rows: (f, w) row of the surface in each column, with fractions; NaN where none is seen.
        quality: (f,) 0-1, mean likelihood along the frame's paths; NaN where there is none.
        poor: (f,) bool, frames whose path is too uncertain to use; their rows are NaN too.
    """

    rows: Floats
    quality: Floats
    poor: Bools

    def masks(self, n_rows: int, line_rows: int) -> Bools:
        """Masks (f, n_rows, w), a line of ``line_rows`` from the surface down."""
        masks = np.zeros((len(self.rows), n_rows, self.rows.shape[1]), dtype=bool)
        frames, columns = np.nonzero(np.isfinite(self.rows))
        # The edge of a mask lies half a row above its first: so the edge is at the surface, to half a row.
        first = np.rint(self.rows[frames, columns] + 0.5).astype(np.int64)
        for below in range(max(line_rows, 1)):
            inside = (first + below >= 0) & (first + below < n_rows)
            masks[frames[inside], first[inside] + below, columns[inside]] = True
        return masks


def find_bone_surface(
    images: NDArray[Any],
    pixel_spacing_mm: tuple[float, float],
    finder: BoneFinder | None = None,
    progress: Progress = iter,
) -> BoneSurface:
    """Look for the surface of bone and cartilage in B-mode frames.

    Args:
        images: (f, h, w) grey, row 0 at the transducer, log-compressed as on the screen.
        pixel_spacing_mm: (sx, sy) mm.
        finder: how; the defaults when None.
        progress: wraps the numbers of the frames, as tqdm does.

    Raises:
        StudyError: no frames, or frames too small to hold a surface.
    """
    finder = finder or BoneFinder()
    sx, sy = pixel_spacing_mm
    if images.ndim != 3 or len(images) == 0:
        raise StudyError(f"expected B-mode frames (frames, rows, columns), got {images.shape}; pass those of a sweep")
    if images.shape[1] * sy < 2 * finder.near_mm or images.shape[2] * sx < finder.shortest_mm:
        raise StudyError(
            f"expected frames that are {2 * finder.near_mm:g} mm deep and {finder.shortest_mm:g} mm wide or more, got"
            f" {images.shape[1] * sy:.1f} x {images.shape[2] * sx:.1f} mm; check the pixel spacing"
        )
    step = max(1, int(0.15 / sy)), max(1, int(0.3 / sx))  # finer pixels hold nothing that a pulse could show
    filters = _Filters(finder, images.shape[1:], step, pixel_spacing_mm)
    rows = np.full((len(images), images.shape[2]), np.nan)
    quality = np.full(len(images), np.nan)
    for frame in progress(range(len(images))):
        likelihood = filters.likelihood(images[frame])
        path = _trusted(_strongest_path(likelihood, finder, filters.spacing_mm), likelihood, finder, filters.spacing_mm)
        found = np.flatnonzero(path >= 0)
        if len(found):
            quality[frame] = likelihood[path[found], found].mean()
            rows[frame] = filters.full_rows(_refined(likelihood, path), images.shape[2])
    poor = quality < finder.min_quality
    rows[poor] = np.nan
    return BoneSurface(rows, quality, poor)


def mask_sweep(
    sweep: TrackedSweep, finder: BoneFinder | None = None, progress: Progress = iter
) -> tuple[TrackedSweep, BoneSurface]:
    """A sweep of B-mode with masks of the surface found in it; poor frames have an empty mask.

    Raises:
        StudyError: no images, no pixel spacing, or frames in which nothing can be looked for.
    """
    finder = finder or BoneFinder()
    if sweep.images is None:
        raise StudyError(f"{sweep.name}: expected B-mode images, got masks only; they need no surface found")
    if sweep.pixel_spacing_mm is None:
        raise StudyError(f"{sweep.name}: expected pixel_spacing_mm, got none; give the calibration")
    found = find_bone_surface(sweep.images, sweep.pixel_spacing_mm, finder, progress)
    masks = found.masks(sweep.images.shape[1], round(finder.line_mm / sweep.pixel_spacing_mm[1]))
    return replace(sweep, masks=masks), found


class _Filters:
    """Log-Gabor filters for frames of one size, and what they say of a frame."""

    def __init__(
        self, finder: BoneFinder, shape: tuple[int, ...], step: tuple[int, int], spacing_mm: tuple[float, float]
    ) -> None:
        self.finder, self.step = finder, step
        self.spacing_mm = spacing_mm[0] * step[1], spacing_mm[1] * step[0]
        self.shape = shape[0] // step[0], shape[1] // step[1]
        sx, sy = self.spacing_mm
        # Reflected at the edges, so that the frame's border is no ridge.
        self._pad = tuple((fft.next_fast_len(2 * n) - n) // 2 for n in self.shape)
        padded = tuple(n + 2 * pad for n, pad in zip(self.shape, self._pad, strict=True))
        v, u = np.meshgrid(fft.fftfreq(padded[0], sy), fft.fftfreq(padded[1], sx), indexing="ij")
        radius = np.hypot(u, v)
        radius[0, 0] = 1.0
        self._banks = []
        for tilt in np.radians(finder.tilts_deg):
            angle = np.arctan2(u * np.cos(tilt) - v * np.sin(tilt), u * np.sin(tilt) + v * np.cos(tilt))
            across = np.exp(-(angle**2) / (2 * np.radians(20.0) ** 2))  # one side only: the response is analytic
            bank = [np.exp(-(np.log(radius * length) ** 2) / (2 * np.log(0.55) ** 2)) * across
                    for length in finder.wavelengths_mm]  # fmt: skip
            for response in bank:
                response[0, 0] = 0.0
            self._banks.append([response.astype(np.float32) for response in bank])  # twice as fast, and fine enough

    def likelihood(self, image: NDArray[Any]) -> Floats:
        """How likely (h, w), 0-1, the surface is at each pixel of the thinned frame."""
        grey = self._thinned(image)
        _, sy = self.spacing_mm
        ridge = self._symmetry(grey)
        below = _mean_below(grey, round(1.0 / sy), max(1, round(self.finder.shadow_mm / sy)))
        bright = gaussian_filter(grey, (0.25 / sy, 1.0))
        contrast = np.clip((bright - below) / (bright + below + 0.02), 0.0, 1.0)
        strength = ridge * contrast * np.sqrt(np.clip(bright, 0.0, 1.0))
        strength[: round(self.finder.near_mm / sy)] = 0.0
        strength[:, grey.max(axis=0) < DARK] = 0.0  # beside the fan, or without contact
        # A beam ends at bone: what has something stronger below it is a sheet of soft tissue, while the reflections
        # between probe and bone, which lie below, are weaker.
        gap = round(1.0 / sy)
        under = np.zeros_like(strength)
        under[:-gap] = np.maximum.accumulate(strength[::-1], axis=0)[::-1][gap:]
        rank = np.divide(strength, under, out=np.ones_like(strength), where=under > strength)
        ranked: Floats = np.clip(strength * rank**2, 0.0, 1.0)
        return ranked

    def full_rows(self, rows: Floats, n_columns: int) -> Floats:
        """Rows (w,) of the frame as it is, of those (k,) of the thinned one; NaN where it has none."""
        down, across = self.step
        centres = np.arange(len(rows)) * across + (across - 1) / 2
        full = np.full(n_columns, np.nan)
        for start, stop in _pieces(np.where(np.isfinite(rows), 0, -1), reach=0):
            columns = np.arange(start * across, min(stop * across, n_columns))
            full[columns] = np.interp(columns, centres[start:stop], rows[start:stop])
        return full * down + (down - 1) / 2

    def _thinned(self, image: NDArray[Any]) -> Floats:
        """A frame as means of blocks, 0-1."""
        (down, across), (h, w) = self.step, self.shape
        grey = image[: h * down, : w * across].astype(np.float32).reshape(h, down, w, across).mean(axis=(1, 3))
        top = float(np.quantile(grey, 0.998))
        shown: Floats = np.clip(grey / top, 0.0, 1.0) if top > 0 else grey
        return shown

    def _symmetry(self, grey: Floats) -> Floats:
        """Symmetry of the local phase (h, w), 0-1: one on bright ridges, at any gain."""
        (py, px), (h, w) = self._pad, self.shape
        spectrum = fft.fft2(np.pad(grey, ((py, py), (px, px)), mode="reflect"))
        best = np.zeros(self.shape)
        for bank in self._banks:
            symmetric, total = np.zeros(self.shape), np.zeros(self.shape)
            for response in bank:
                answer = 2 * fft.ifft2(spectrum * response)[py : py + h, px : px + w]
                size = np.abs(answer)
                noise = 2.0 * float(np.median(size))  # of speckle, which covers most of a frame
                symmetric += np.maximum(answer.real - np.abs(answer.imag) - noise, 0.0)
                total += size
            best = np.maximum(best, symmetric / (total + 0.02))
        return np.clip(best, 0.0, 1.0)


def _mean_below(grey: Floats, gap: int, length: int) -> Floats:
    """Mean (h, w) of ``length`` rows that begin ``gap`` rows below each, as far as the frame reaches."""
    h = len(grey)
    sums = np.concatenate([np.zeros((1, grey.shape[1])), np.cumsum(grey, axis=0)])
    start = np.minimum(np.arange(h) + gap, h - 1)
    stop = np.minimum(start + length, h)
    means: Floats = (sums[stop] - sums[start]) / (stop - start)[:, None]
    return means


def _strongest_path(likelihood: Floats, finder: BoneFinder, spacing_mm: tuple[float, float]) -> Ints:
    """Row (w,) of the strongest smooth path in each column, -1 where there is none (dynamic programming)."""
    h, w = likelihood.shape
    sx, sy = spacing_mm
    reach = _reach(spacing_mm)
    moves = np.arange(-reach, reach + 1)
    cost = finder.slope * (moves * sy / sx) ** 2 * sx
    gain = (likelihood - finder.least) * sx  # by the mm, so that a pixel's size does not matter
    best = np.full((w, h), -np.inf)  # of all paths that end in this row of this column
    came = np.zeros((w, h), dtype=np.int64)  # number of the move that led there; -1: the path begins here
    off = np.zeros(w + 1)  # of all that have ended before this column
    ended = np.full(w + 1, -1, dtype=np.int64)  # row in which the last one ended, -1: none ended here
    padded = np.full(h + 2 * reach, -np.inf)
    best[0] = gain[:, 0] - finder.turn_on
    came[0] = -1
    for column in range(1, w):
        last = best[column - 1]
        ended[column] = -1
        off[column] = off[column - 1]
        if last.max() - finder.turn_on > off[column]:
            ended[column] = int(last.argmax())
            off[column] = last.max() - finder.turn_on
        padded[reach : reach + h] = last
        options = np.lib.stride_tricks.sliding_window_view(padded, h) - cost[:, None]
        chosen = options.argmax(axis=0)
        reached = options[chosen, np.arange(h)]
        begun = off[column] - finder.turn_on
        came[column] = np.where(reached >= begun, chosen, -1)
        best[column] = np.maximum(reached, begun) + gain[:, column]
    path = np.full(w, -1, dtype=np.int64)
    row = int(best[-1].argmax()) if best[-1].max() - finder.turn_on > off[w - 1] else -1
    for column in range(w - 1, -1, -1):
        if row < 0:
            # Off here: did a path end in the column before?
            row = int(ended[column]) if column > 0 else -1
            continue
        path[column] = row
        step = came[column, row]
        if step < 0:
            row = int(ended[column]) if column > 0 else -1
            continue
        row = row + int(moves[step])
    return path


def _pieces(path: Ints, reach: int) -> list[tuple[int, int]]:
    """First column of each piece of a path, and the one behind its last; a jump of more than ``reach`` rows cuts."""
    on = np.concatenate([[False], path >= 0, [False]])
    cut = np.concatenate([[False], np.abs(np.diff(path)) > reach, [False]])
    starts = np.flatnonzero(on[1:-1] & (~on[:-2] | cut[:-1]))
    stops = np.flatnonzero(on[1:-1] & (~on[2:] | cut[1:])) + 1
    return list(zip(starts.tolist(), stops.tolist(), strict=True))


def _reach(spacing_mm: tuple[float, float]) -> int:
    """Rows that a path may go from one column to the next: 60 degrees."""
    return max(1, int(np.ceil(1.7 * spacing_mm[0] / spacing_mm[1])))


def _trusted(path: Ints, likelihood: Floats, finder: BoneFinder, spacing_mm: tuple[float, float]) -> Ints:
    """A path without the pieces that are short, much less likely than its best, or far from that in depth."""
    sx, sy = spacing_mm
    pieces = [
        (start, stop) for start, stop in _pieces(path, _reach(spacing_mm)) if (stop - start) * sx >= finder.shortest_mm
    ]
    sums = [float(likelihood[path[start:stop], np.arange(start, stop)].sum()) for start, stop in pieces]
    kept = np.full_like(path, -1)
    if not pieces:
        return kept
    best = int(np.argmax(sums))
    first, last = pieces[best][0], pieces[best][1] - 1
    alike = finder.alike * sums[best] / (last + 1 - first)
    for (start, stop), total in zip(pieces, sums, strict=True):
        near, far = (stop - 1, first) if stop <= first else (start, last)  # the two ends that face each other
        apart_mm = 0.0 if start == first else abs(int(path[near]) - int(path[far])) * sy
        if total >= alike * (stop - start) and apart_mm <= finder.apart_mm:
            kept[start:stop] = path[start:stop]
            kept[start] = -1  # a gap, so that nothing is drawn from one piece to the next
    return kept


def _refined(likelihood: Floats, path: Ints) -> Floats:
    """The path's rows (w,) to fractions, by the parabola through each maximum; NaN where there is no path."""
    rows = np.full(len(path), np.nan)
    found = np.flatnonzero(path >= 0)
    row = path[found]
    inner = np.clip(row, 1, len(likelihood) - 2)
    above, here, under = (likelihood[inner + step, found] for step in (-1, 0, 1))
    bend = above - 2 * here + under
    shift = np.divide(0.5 * (above - under), bend, out=np.zeros(len(found)), where=bend < -1e-9)
    rows[found] = row + np.where(inner == row, np.clip(shift, -0.5, 0.5), 0.0)
    return rows
