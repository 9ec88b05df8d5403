"""Small geometry that several sections need."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from study.errors import StudyError
from study.types import Floats, Ints, RigidTransform


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


def principal_axes(points: Floats) -> tuple[Floats, Floats]:
    """Centroid (3,) and right-handed principal axes (3, 3), rows by falling variance (sec. III-A.1)."""
    centre = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - centre).T))
    axes = axes[:, ::-1].T
    axes[2] = np.cross(axes[0], axes[1])
    return centre, axes
