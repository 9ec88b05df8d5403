"""What a robot's planner is told of carried waypoints, and the way back from the US frame to the CT (sec. III-D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from study.errors import StudyError
from study.geometry.points import nearest
from study.registration import REACH_MM, FieldRegistration, Registration, carry
from study.types import Bools, Floats, Ints, Waypoints

NORMAL_MM = 30.0  # around a waypoint, US points that span the surface there: two cartilages and more
MIN_SURFACE = 30  # of them; fewer are a patch of noise
MOST_TILT = 0.5  # cosine to the chest's front: a plane that stands steeper was fitted to an edge of the cloud
NEIGHBOURS = 8  # whose rigid motion carries a place back, where a registration has no field
AT_REST_MM = 1e-3  # of the inverse's iteration
MAX_STEPS = 60


@dataclass(frozen=True)
class GuidedPath:
    """Waypoints in the US frame, with what a planner must know of each.

    Attributes:
        points: (k, 3) mm; NaN where a waypoint could not be carried.
        reasons: (k,) why not, ``""`` for a good one.
        normals: (k, 3) unit vectors to the skin: of the plane through the US points around; NaN as ``points``.
        from_surface: (k,) False where too few US points lie around, and the normal is the chest's front instead.
        bounds_mm: (k,) how far at most it lies from its true place, 19 times in 20; None of a method without bounds.
        ct_distance_mm: (k,) from the waypoint to the nearest CT point, in the CT frame.
        residual_mm: (k,) median distance to the nearest warped CT point of the US points around; NaN without any.
        n_us: (k,) US points around.
    """

    points: Floats
    reasons: tuple[str, ...]
    normals: Floats
    from_surface: Bools
    bounds_mm: Floats | None
    ct_distance_mm: Floats
    residual_mm: Floats
    n_us: Ints


def guide(result: Registration, waypoints: Waypoints, radius_mm: float = 20.0) -> GuidedPath:
    """Carry waypoints into the US frame, and look at the ultrasound around each.

    Args:
        result: of `study.register_pair`, whose ``front`` and ``target`` are known.
        waypoints: mm, CT frame.
        radius_mm: sphere of the path transfer (sec. III-D).

    Raises:
        StudyError: a result without them; waypoints in metres; not one that can be carried.
    """
    us = result.target
    if result.front is None or us is None:
        raise StudyError(
            "expected a registration of study.register_pair, got one without `front` and `target`; use that"
        )
    path = result.carry_path(waypoints.points, radius_mm)
    carried = np.array([not reason for reason in path.reasons])
    if not carried.any():
        raise StudyError(
            f"waypoints: expected one or more that can be carried, got none: {waypoints.labels[0]}: {path.reasons[0]}"
        )
    try:
        bounds_mm = result.bounds(waypoints.points)
    except StudyError:  # most methods have none
        bounds_mm = None
    normals, from_surface = np.full_like(path.points, np.nan), np.zeros(len(carried), dtype=bool)
    residual_mm, n_us = np.full(len(carried), np.nan), np.zeros(len(carried), dtype=np.int64)
    off_mm, _ = nearest(us, result.warped)
    around = KDTree(us).query_ball_point(path.points[carried], NORMAL_MM)
    for k, members in zip(np.flatnonzero(carried), around, strict=True):
        n_us[k] = len(members)
        if members:
            residual_mm[k] = np.median(off_mm[members])
        normals[k], from_surface[k] = _surface_normal(us[members], result.front)
    return GuidedPath(
        path.points,
        path.reasons,
        normals,
        from_surface,
        bounds_mm,
        nearest(waypoints.points, result.source)[0],
        residual_mm,
        n_us,
    )


def _surface_normal(points: Floats, front: Floats) -> tuple[Floats, bool]:
    """The normal (3,) of the plane through points (n, 3), towards ``front``, and whether they say one."""
    if len(points) < MIN_SURFACE:
        return front, False
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    normal = normal * np.sign(normal @ front)
    return (normal, True) if normal @ front >= MOST_TILT else (front, False)


def pull_back(result: Registration, points: Floats) -> tuple[Floats, Bools]:
    """Where in the CT frame places (n, 3) mm of the US frame come from.

    A registration that is a field is inverted. Of another one the nearest warped points take a place back with them,
    by the rigid motion of the nearest ``NEIGHBOURS``. Farther than ``REACH_MM`` from every warped point nothing is
    known of the deformation, and the rigid part alone answers.

    Returns:
        places (n, 3) mm; False (n,) where a field has no inverse, and the rigid part answers.
    """
    places = result.T_us_ct.inverse.apply(points)
    away, _ = KDTree(result.warped).query(points, distance_upper_bound=REACH_MM)
    near, known = np.isfinite(away), np.ones(len(points), dtype=bool)
    if not near.any():
        return places, known
    if isinstance(result, FieldRegistration):
        found, known[near] = _inverse(result, points[near])
        places[near] = np.where(known[near][:, None], found, places[near])
    else:
        places[near] = carry(points[near], result.warped, result.source, NEIGHBOURS)
    return places, known


def _inverse(result: FieldRegistration, points: Floats) -> tuple[Floats, Bools]:
    """The fixed point of: go back by what is missing; a field that bends less than it turns has one."""
    places = result.T_us_ct.inverse.apply(points)
    for _ in range(MAX_STEPS):
        missing = points - result.carry(places)
        off_mm = np.linalg.norm(missing, axis=1)
        if off_mm.max() < AT_REST_MM:
            break
        places = places + missing @ result.T_us_ct.rotation
    return places, off_mm < 100 * AT_REST_MM
