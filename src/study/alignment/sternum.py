"""Feature plane and sternum detection by rotating rectangle templates (sec. III-A.1, Eq. 1)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import gaussian_filter

from study.errors import StudyError
from study.geometry.points import close_gaps, pixelise, principal_axes, sample_spacing_mm
from study.types import Floats, PointCloud, RigidTransform

# What a cloud should hold; the first thing to check where none of it is found.
CROP = "crop to the sternum from at most 5 mm above the 2nd to below the 5th attachments and cartilages 2-5, no ribs"


@dataclass(frozen=True)
class SternumParams:
    """Templates of sec. III-A.1.

    Attributes:
        width_mm, height_mm: the rectangle, 30 × 90 mm.
        scales_mm: edge of a pixel at the three searches.
        ranges_deg: half range of the rotations tried at the second and third scale; the first tries all.
        steps_deg: step of the rotations.
        min_overlap: smallest part of the rectangle that must be covered at the last scale.
    """

    width_mm: float = 30.0
    height_mm: float = 90.0
    scales_mm: tuple[float, ...] = (5.0, 3.0, 2.0)
    ranges_deg: tuple[float, ...] = (15.0, 7.0)
    steps_deg: tuple[float, ...] = (10.0, 2.0, 1.0)
    min_overlap: float = 0.6


@dataclass(frozen=True)
class SternumFit:
    """The rectangle found in the feature plane.

    Attributes:
        centre: (2,) mm in plane coordinates.
        angle_deg: rotation of the long edge from the plane's second axis, counter-clockwise.
        overlap: covered part of the rectangle, 0-1 (F_k over its area).
        scale_mm: edge of a pixel of the search that found it.
        coarser: the fit at the scale before, whose neighbourhood was searched.
    """

    centre: Floats
    angle_deg: float
    overlap: float
    scale_mm: float = 0.0
    coarser: SternumFit | None = None

    @property
    def searches(self) -> tuple[SternumFit, ...]:
        """The fit of every scale, coarse to fine."""
        return (*(self.coarser.searches if self.coarser else ()), self)


@dataclass(frozen=True)
class SternumScores:
    """F_k of Eq. 1 over the feature plane, as a share of the rectangle's area.

    Attributes:
        values: (w, h) of a template with its centre at each pixel, at the rotation of the fit.
        origin: (2,) mm, the centre of the first pixel.
        pixel_mm: edge of a pixel.
        angles_deg: (a,) every rotation of the first search.
        best: (a,) the largest value at each of them.
    """

    values: Floats
    origin: Floats
    pixel_mm: float
    angles_deg: Floats
    best: Floats


def sternum_scores(points: Floats, fit: SternumFit, params: SternumParams | None = None) -> SternumScores:
    """What the first, coarse search saw around a fit, for a picture of it.

    Args:
        points: (n, 2) mm in the feature plane.
        fit: of that search, or one of a finer scale.
        params: sizes, scales and steps.
    """
    p = params or SternumParams()
    scale_mm = p.scales_mm[0]
    image, origin = _closed_image(points, scale_mm, p, 2 * sample_spacing_mm(points))
    angles = np.arange(-90.0, 90.0, p.steps_deg[0])
    best = np.array([covered.max() for covered in _covered(image, p, scale_mm, angles)])
    (values,) = _covered(image, p, scale_mm, np.array([fit.searches[0].angle_deg]))
    return SternumScores(values, origin, scale_mm, angles, best)


def feature_plane(cloud: PointCloud) -> RigidTransform:
    """The plane normal to the third principal direction (sec. III-A.1), seen from either face.

    Returns:
        T_cloud_plane: plane coordinates (x, y in the plane, z along its normal) to the cloud's frame, det +1.

    Raises:
        StudyError: a cloud that does not spread over a plane.
    """
    centre, axes = principal_axes(cloud.points)
    spread = ((cloud.points - centre) @ axes.T).std(axis=0)
    if spread[1] < 10.0 or spread[2] > 0.6 * spread[1]:
        raise StudyError(
            f"{cloud.name}: expected a chest wall spread over a plane, got principal spreads "
            f"{spread[0]:.1f}, {spread[1]:.1f}, {spread[2]:.1f} mm; {CROP}"
        )
    return RigidTransform(axes.T, centre)


def rectangle_mask(width_mm: float, height_mm: float, pixel_mm: float, angle_deg: float) -> Floats:
    """A rotated rectangle M (m, m), long edge along axis 1 at 0°, rotating counter-clockwise.

    Values are the covered part of each pixel, so that every rotation has the same area and the scores of Eq. 1
    compare: with yes-or-no pixels the upright rectangle would win by its rounding alone.
    """
    half = int(np.ceil(np.hypot(width_mm, height_mm) / 2 / pixel_mm))
    fine = (np.arange(-half * 5 - 2, half * 5 + 3) / 5) * pixel_mm  # five sub-pixels along each edge
    x, y = fine[:, None], fine[None]
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    inside = (np.abs(c * x + s * y) <= width_mm / 2) & (np.abs(-s * x + c * y) <= height_mm / 2)
    along_x = np.add.reduce([inside[k::5] for k in range(5)], dtype=np.int64)
    covered: Floats = np.add.reduce([along_x[:, k::5] for k in range(5)]) / 25
    return covered


def _closed_image(points: Floats, scale_mm: float, params: SternumParams, close_mm: float) -> tuple[Floats, Floats]:
    """The cloud as an image without gaps, padded by half a template, and the centre of its first pixel (2,) mm."""
    pad = int(np.ceil(np.hypot(params.width_mm, params.height_mm) / 2 / scale_mm)) + 1
    image, _, origin = pixelise(points, scale_mm, pad)
    return close_gaps(image, round(close_mm / scale_mm)).astype(np.float64), origin


def _covered(image: Floats, params: SternumParams, scale_mm: float, angles: Floats) -> Iterator[Floats]:
    """F_k of Eq. 1 over the rectangle's area at each rotation, by FFT, with the template's centre at each pixel."""
    # The padding is wide enough for a circular convolution: what wraps around meets empty pixels.
    shape = [next_fast_len(length, real=True) for length in image.shape]
    seen, rows, columns = rfft2(image, shape), *image.shape
    for angle in angles:
        mask = rectangle_mask(params.width_mm, params.height_mm, scale_mm, float(angle))
        product = irfft2(seen * rfft2(mask[::-1, ::-1], shape), shape)
        half = len(mask) // 2
        yield np.roll(product, (-half, -half), axis=(0, 1))[:rows, :columns] / mask.sum()


def _best_place(
    points: Floats, scale_mm: float, angles: Floats, near: Floats | None, params: SternumParams, close_mm: float
) -> list[SternumFit]:
    """The best position of each rotated template (Eq. 1, by FFT), best rotation first."""
    reach_mm = np.hypot(params.width_mm, params.height_mm)
    if near is not None:  # what the templates cannot reach need not be convolved
        points = points[np.linalg.norm(points - near, axis=1) < reach_mm / 2 + 3 * params.scales_mm[0]]
    image, origin = _closed_image(points, scale_mm, params, close_mm)
    if near is not None:  # stay on the sternum of the coarser scale
        away = np.hypot(*(np.indices(image.shape) * scale_mm + origin[:, None, None] - near[:, None, None]))
        barred = away > 2.5 * params.scales_mm[0]
    fits = []
    for angle, covered in zip(angles, _covered(image, params, scale_mm, angles), strict=True):
        if near is not None:
            covered[barred] = 0.0
        best = float(covered.max())
        centre = np.argwhere(covered >= best - 1e-6).mean(axis=0) * scale_mm + origin
        fits.append(SternumFit(centre, float(angle), best, scale_mm))
    return sorted(fits, key=lambda fit: -fit.overlap)


def sternum_candidates(points: Floats, params: SternumParams | None = None) -> Iterator[SternumFit]:
    """Rectangles that cover the projected cloud, refined over three scales, best first (Eq. 1).

    The paper keeps the best alone. On some anatomies a rectangle laid across two cartilages covers as much, so the
    others follow for a caller that can tell whether four branches leave each side.

    Args:
        points: (n, 2) mm in the feature plane, seen from the front.
        params: sizes, scales and steps.
    """
    p = params or SternumParams()
    close_mm = 2 * sample_spacing_mm(points)
    first = _best_place(points, p.scales_mm[0], np.arange(-90.0, 90.0, p.steps_deg[0]), None, p, close_mm)
    tried: list[SternumFit] = []
    for fit in first:
        if any(_alike(fit, other, p) for other in tried):
            continue
        for scale, half_range, step in zip(p.scales_mm[1:], p.ranges_deg, p.steps_deg[1:], strict=True):
            angles = np.arange(fit.angle_deg - half_range, fit.angle_deg + half_range + step / 2, step)
            fit = replace(_best_place(points, scale, angles, fit.centre, p, close_mm)[0], coarser=fit)
        if not any(_alike(fit, other, p) for other in tried):
            yield fit
        tried.append(fit)


def _alike(one: SternumFit, other: SternumFit, params: SternumParams) -> bool:
    """Whether refining both would search the same rotations around the same place."""
    turn = abs((one.angle_deg - other.angle_deg + 90.0) % 180.0 - 90.0)
    return turn <= params.ranges_deg[0] / 2 and bool(np.linalg.norm(one.centre - other.centre) < params.width_mm / 2)


def symmetry_axis(points: Floats, half_range_deg: float = 40.0, reach_mm: float = 55.0) -> tuple[float, float]:
    """The line across which the view is most nearly its own mirror image.

    A rectangle covers a sternum shorter or wider than itself equally well at many angles; the chest's symmetry does
    not depend on the size of the bone.

    Args:
        points: (n, 2) mm in the coordinates of the rectangle that found the sternum.
        half_range_deg: rotations tried.
        reach_mm: how far from the line the two halves are compared.

    Returns:
        angle of the line from y, counter-clockwise, degrees; its distance from the origin along the turned x, mm.
    """
    pixel_mm, blur = 2.0, 2.0
    image, _, origin = pixelise(points, pixel_mm, pad=4)
    filled = close_gaps(image, round(2 * sample_spacing_mm(points) / pixel_mm))
    x, y = (np.argwhere(filled) * pixel_mm + origin).T
    low = -reach_mm - 4 * pixel_mm
    rows = round(-2 * low / pixel_mm)
    half = min(int(np.hypot(x, y).max() / pixel_mm + 4 * blur) + 1, 100)  # columns, whichever way the view is turned
    shifts = np.arange(-8, 9)
    # In the product of a view and itself, row by row, the mirrored view moved by a shift is an antidiagonal.
    mirror = (rows - 1 - np.arange(rows) + shifts[:, None]) % rows
    best, answer = -1.0, (0.0, 0.0)
    for step, around in ((2.0, half_range_deg), (0.5, 2.0)):
        centre = answer[0]
        for angle in np.arange(centre - around, centre + around + step / 2, step):
            c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
            across, along = c * x + s * y, c * y - s * x
            near = (np.abs(across) < reach_mm) & (np.abs(along) < half * pixel_mm)
            row, column = (across[near] - low) // pixel_mm, along[near] // pixel_mm + half
            view = np.zeros((rows, 2 * half))
            view[row.astype(np.int64), column.astype(np.int64)] = 1.0
            view = gaussian_filter(view, blur)
            scores = (view @ view.T)[np.arange(rows), mirror].sum(axis=1)
            if scores.max() > best:
                best, answer = float(scores.max()), (float(angle), float(shifts[scores.argmax()]) * pixel_mm / 2)
    return answer
