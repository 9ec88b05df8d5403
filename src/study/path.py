"""Path transfer from CT to US (sec. III-D)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from study.errors import StudyError
from study.geometry import fit_rigid
from study.types import Floats, as_points

MIN_SUPPORT = 3


def transfer_path(source: Floats, warped: Floats, waypoints: ArrayLike, *, radius_mm: float = 20.0) -> Floats:
    """Move each waypoint by the rigid fit of the cloud points around it (sec. III-D).

    Args:
        source: (n, 3) mm, CT.
        warped: (n, 3) mm, row i is ``source[i]`` in the US frame.
        waypoints: (k, 3) mm, CT.
        radius_mm: sphere around each waypoint; 20 mm in the paper.

    Returns:
        (k, 3) mm in the US frame.

    Raises:
        StudyError: clouds that do not pair, or a sphere with fewer than 3 points or with points on a line.
    """
    waypoints = as_points(waypoints, "waypoints")
    source, warped = as_points(source, "source"), as_points(warped, "warped")
    if source.shape != warped.shape:
        raise StudyError(f"expected one warped point per source point, got {source.shape} and {warped.shape}")
    if not radius_mm > 0:
        raise StudyError(f"expected radius_mm > 0, got {radius_mm}")
    moved = np.empty_like(waypoints)
    for k, members in enumerate(KDTree(source).query_ball_point(waypoints, radius_mm)):
        local = source[members]
        flat = len(members) >= MIN_SUPPORT and np.linalg.svd(local - local.mean(axis=0), compute_uv=False)[1] < 1e-6
        if len(members) < MIN_SUPPORT or flat:
            raise StudyError(
                f"waypoint {k}: expected at least {MIN_SUPPORT} CT points off a line within {radius_mm:g} mm, "
                f"got {len(members)}; check that it lies between the cartilages, or raise radius_mm"
            )
        moved[k] = fit_rigid(local, warped[members]).apply(waypoints[k : k + 1])[0]
    return moved
