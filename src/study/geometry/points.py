"""Geometry of points and masks that several sections need: rigid fits, neighbours, axes, pixels, cells, pieces."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import binary_closing, label
from scipy.spatial import KDTree

from study.errors import StudyError
from study.types import Bools, Floats, Ints, RigidTransform


def fit_rigid(source: Floats, target: Floats, weights: Floats | None = None) -> RigidTransform:
    """The proper rigid motion of least squares from ``source`` to ``target`` (Eq. 3; Kabsch).

    Args:
        source: (n, 3) mm, at least 3 points.
        target: (n, 3) mm, row i belongs to ``source[i]``.
        weights: (n,) non-negative, or None for equal weights.

    Raises:
        StudyError: shapes that do not pair, or fewer than 3 points.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise StudyError(f"expected paired (n, 3) points, got {source.shape} and {target.shape}")
    if len(source) < 3:
        raise StudyError(f"expected at least 3 pairs for a rigid fit, got {len(source)}; widen the neighbourhood")
    w = np.full(len(source), 1 / len(source)) if weights is None else weights / weights.sum()
    rotations, translations = fit_rigid_batch(source[None], target[None], w[None])
    return RigidTransform(rotations[0], translations[0])


def fit_rigid_batch(source: Floats, target: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """`fit_rigid` for b neighbourhoods at once.

    Args:
        source: (b, n, 3) mm.
        target: (b, n, 3) mm.
        weights: (b, n), each row summing to 1; a zero leaves a pair out, so ragged sets can be padded.

    Returns:
        rotations (b, 3, 3) with determinant +1 and translations (b, 3).
    """
    mean_s = np.einsum("bn,bni->bi", weights, source)
    mean_t = np.einsum("bn,bni->bi", weights, target)
    cov = np.einsum("bn,bni,bnj->bij", weights, target - mean_t[:, None], source - mean_s[:, None])
    u, _, vt = np.linalg.svd(cov)
    # A reflection would fit a flat neighbourhood as well as a rotation: flip the weakest axis back.
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    rotations = u @ vt
    return rotations, mean_t - np.einsum("bij,bj->bi", rotations, mean_s)


def nearest(queries: Floats, cloud: Floats) -> tuple[Floats, Ints]:
    """Distance (q,) mm and index (q,) of the closest ``cloud`` point to each query, by KD-tree."""
    distances, indices = KDTree(cloud).query(queries)
    return distances, indices


def unit(vector: ArrayLike, name: str) -> Floats:
    """A direction (3,) at length 1; ``name`` is what the message calls it.

    Raises:
        StudyError: not three finite numbers, or all zero.
    """
    try:
        array = np.asarray(vector, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (3,) or not np.isfinite(array).all() or not np.linalg.norm(array) > 0:
        raise StudyError(f"expected {name} as a direction (3,), got {vector!r}; give three numbers, not all 0")
    return array / np.linalg.norm(array)


def principal_axes(points: Floats) -> tuple[Floats, Floats]:
    """Centroid (3,) and right-handed principal axes (3, 3), rows by falling variance (sec. III-A.1).

    The first two point to the longer tail of the points, so that a moved cloud has the moved axes.
    """
    centre = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - centre).T))
    axes = axes[:, ::-1].T
    axes[(((points - centre) @ axes.T) ** 3).sum(axis=0) < 0] *= -1
    axes[2] = np.cross(axes[0], axes[1])
    return centre, axes


def pixelise(points: Floats, pixel_mm: float, pad: int = 0) -> tuple[Bools, Ints, Floats]:
    """Occupancy image of 2-D points (``I_b`` of Eq. 1).

    Args:
        points: (n, 2) mm.
        pixel_mm: edge of a pixel.
        pad: empty pixels added on every side.

    Returns:
        image (rows, columns) of bool with axis 0 along x and axis 1 along y; the pixel (n, 2) of each point;
        the position (2,) mm of the centre of pixel (0, 0).
    """
    low = np.floor(points.min(axis=0) / pixel_mm) - pad
    pixels = (np.floor(points / pixel_mm) - low).astype(np.int64)
    image = np.zeros(pixels.max(axis=0) + 1 + pad, dtype=bool)
    image[pixels[:, 0], pixels[:, 1]] = True
    return image, pixels, (low + 0.5) * pixel_mm


def close_gaps(image: Bools, pixels: int) -> Bools:
    """Fill holes up to ``2 * pixels`` wide, such as those between the samples of a sparse cloud."""
    if pixels < 1:
        return image
    disc = np.hypot(*np.mgrid[-pixels : pixels + 1, -pixels : pixels + 1]) <= pixels
    closed: Bools = binary_closing(np.pad(image, pixels), disc)[pixels:-pixels, pixels:-pixels]
    return closed


def largest_component(mask: Bools) -> Bools:
    """The largest connected piece of a mask of any dimension, neighbours sharing a face; the first of equal ones.

    An empty mask, or one of a single piece, comes back as it is.
    """
    pieces, n = label(mask)
    if n <= 1:
        return mask
    largest: Bools = pieces == np.bincount(pieces.ravel())[1:].argmax() + 1
    return largest


def foremost_in_cells(local: Floats, cell_mm: float) -> tuple[Ints, Floats]:
    """What a grid of cells across the view shows of points: the foremost of each cell.

    Args:
        local: (n, 3) mm, x and y across the view, z to the front.
        cell_mm: edge of a cell.

    Returns:
        cell (n,) of each point, numbered by x, then y; the largest z (c,) mm in each cell.

    Raises:
        StudyError: no points, or a cell of no size.
    """
    if len(local) == 0 or not cell_mm > 0:
        raise StudyError(f"expected points and a cell above 0 mm, got {len(local)} and {cell_mm!r}; check the crop")
    cells = np.floor(local[:, :2] / cell_mm).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.ravel()
    foremost = np.full(cell.max() + 1, -np.inf)
    np.maximum.at(foremost, cell, local[:, 2])
    return cell, foremost


def sample_spacing_mm(points: Floats) -> float:
    """Median distance from a point to its nearest neighbour, mm."""
    distances, _ = KDTree(points).query(points, k=[2])
    return float(np.median(distances))


def farthest_points(points: Floats, n: int) -> Ints:
    """Indices (min(n, len),) of points spread evenly over (k, 3) ``points``, whatever their density.

    Each is the one farthest from those before it, the first the one farthest from the centroid: no draw, and the
    same rows in any rigid pose.
    """
    x, y, z = np.ascontiguousarray(points.T)  # whole columns are read several times faster than rows
    gap = ((points - points.mean(axis=0)) ** 2).sum(axis=1)
    chosen = np.empty(min(n, len(points)), dtype=np.int64)
    for k in range(len(chosen)):
        chosen[k] = at = np.argmax(gap)
        squared = (x - x[at]) ** 2 + (y - y[at]) ** 2 + (z - z[at]) ** 2
        gap = squared if k == 0 else np.minimum(gap, squared, out=gap)
    return chosen
