"""One pair from start to end: coarse alignment, then a method (sec. III)."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from study.alignment.chest import Alignment, Chest, find_chest
from study.alignment.sizes import size_warnings
from study.errors import StudyError
from study.geometry.points import nearest, principal_axes, unit

# The methods import these, and with them Open3D, trimesh and pycpd, on first use. Whoever runs methods, here or in a
# batch, loads them before: a limit of threads holds only for the pools that are there when it is set, and Open3D brings
# one; nor does the clock measure an import.
from study.methods import METHODS, drift, mesh  # noqa: F401
from study.quality import QUALITY_LIMITS, SWAPPED, measure_quality, quality_warnings
from study.registration import Method, Registration
from study.seeds import named_rng
from study.types import Floats, PointCloud, as_points, as_times
from study.ultrasound.cloud import SweepCloud, thin_evenly

FINE_MM = 1.5  # spacing of the points in which the chest is found
MIN_SPACING_MM = 2.0  # of those that a method sees
EVEN_SHARE = 0.7  # of the typical distance to the nearest neighbour: random scatter keeps most of its points
CARRIERS = 8  # points a method saw, whose rigid motion carries a given one


def find_method(name: str) -> Method:
    """The method called ``name``.

    Raises:
        StudyError: no such method.
    """
    if name not in METHODS:
        raise StudyError(f"expected a method among {', '.join(METHODS)}, got {name!r}; check the spelling")
    return METHODS[name]


def register_pair(
    ct: ArrayLike | PointCloud,
    us: ArrayLike | PointCloud | SweepCloud,
    method: str = "skeleton_graph",
    seed: int = 0,
    front: ArrayLike | None = None,
    times: ArrayLike | None = None,
) -> Registration:
    """Register a CT cartilage cloud to a US cartilage cloud (sec. III).

    Both clouds are thinned to an even density first, so that places given more often do not weigh more.

    Args:
        ct: (n, 3) mm, sternum and cartilages 2-5 of both sides, any rigid pose.
        us: (m, 3) mm, the same anatomy as ultrasound sees it, any rigid pose.
        method: a name in ``METHODS``; the default is the paper's, `study.BEST_METHOD` has the smallest true error.
        seed: draws of the method.
        front: (3,) direction from the chest to the probe in the US frame, where it is known; a swept cloud's own when
            None. Branches that arch the other way are refused.
        times: (m,) s, when each US point was seen, on any one clock; a cloud's own when None. What a method makes of
            them is its affair: most ignore them.

    Returns:
        the registration: ``warped`` (n, 3) mm in the US cloud's frame, one row per given CT point, ``transfer`` for
        waypoints, ``quality`` and ``warnings``. An answer with a warning should not guide a probe.

    Raises:
        StudyError: bad arrays, no sternum, a missing branch, sizes that no chest has, an unknown method, or a method
            that failed.

    Two made-up people, and where the second one's ultrasound frame has the first one's waypoints:

        >>> import numpy as np
        >>> from study import phantom
        >>> rng = np.random.default_rng(0)
        >>> person, patient = phantom.draw_subject("ct1", 0), phantom.draw_subject("patient", 0)
        >>> ct = phantom.reference_cloud(person, 3000, rng).points
        >>> us = phantom.anterior_cloud(patient, 2000, 0.5, 0, rng).points
        >>> pair = register_pair(ct, us, "icp", front=[0, 1, 0])
        >>> pair.warped.shape, pair.quality.wrong_part_share < 0.05
        ((3000, 3), True)
        >>> pair.transfer(phantom.waypoints(person).points).shape
        (20, 3)
    """
    chosen = find_method(method)
    given, seen = _as_cloud(ct, "ct"), _as_cloud(us, "us", front, times)
    alignment = Alignment(_even_chest(given), _even_chest(seen))
    result = register_aligned(alignment, chosen, named_rng(seed, f"ct/us/{method}"), method)
    result = replace(result, target=seen.points)
    if len(alignment.source.cloud) == len(given):
        return result
    _, like = nearest(given.points, result.source)
    parts = None if result.parts is None else result.parts[like]
    return replace(result, source=given.points, warped=result.carry(given.points, CARRIERS), parts=parts)


def _as_cloud(
    given: ArrayLike | PointCloud | SweepCloud,
    name: str,
    front: ArrayLike | None = None,
    times: ArrayLike | None = None,
) -> PointCloud:
    """An unlabelled cloud of what was given, under the name that messages call it."""
    if isinstance(given, SweepCloud):
        given = replace(given.cloud, front=given.front)
    if not isinstance(given, PointCloud):
        given = PointCloud(as_points(given, name), name)
    return PointCloud(
        given.points,
        name,
        front=given.front if front is None else unit(front, "front"),
        times=given.times if times is None else as_times(times, len(given), name),
    )


def _even_chest(cloud: PointCloud) -> Chest:
    """The chest in a cloud, with points of an even density; the points themselves where they are even.

    It is found among more points than the method sees: the coarse alignment needs every one of a sparse cloud, but a
    side that was given five times would still weigh more.
    """
    centre, axes = principal_axes(cloud.points)
    local = (cloud.points - centre) @ axes.T  # so that a moved cloud keeps the same points
    kept, kept_s = _evened(local, cloud.times, FINE_MM)
    fine = cloud if len(kept) == len(cloud) else replace(cloud, points=kept @ axes + centre, times=kept_s)
    chest = find_chest(fine)
    seen, seen_s = _evened(local, cloud.times, MIN_SPACING_MM)
    if len(seen) in (len(kept), len(cloud)):
        return chest
    # In the order of the cloud that the chest was found in, which is not that of ``kept`` where nothing was thinned.
    _, like = nearest(seen, local if fine is cloud else kept)
    assert chest.cloud.parts is not None
    parts = chest.cloud.parts[like]
    return replace(chest, cloud=replace(chest.cloud, points=seen @ axes + centre, parts=parts, times=seen_s))


def _evened(local: Floats, times: Floats | None, spacing_mm: float) -> tuple[Floats, Floats | None]:
    """Points (k, 3) mm thinned to the spacing that is typical by area, or ``spacing_mm`` where that is more.

    By number, a patch sampled 20 times would be typical of the whole. Times (k,) s, where there are any, follow.
    """
    rows = local if times is None else np.column_stack([local, times])
    thinned = thin_evenly(rows, spacing_mm)
    spacing, _ = KDTree(thinned[:, :3]).query(thinned[:, :3], k=[2])
    ordered = np.sort(spacing[:, 0])
    area = np.cumsum(ordered**2)
    typical_mm = EVEN_SHARE * float(ordered[np.searchsorted(area, area[-1] / 2)])
    if typical_mm > spacing_mm:
        thinned = thin_evenly(rows, typical_mm)
    # A copy, since a product of strided rows may differ in its last bit: times must not move a point.
    return np.ascontiguousarray(thinned[:, :3]), None if times is None else thinned[:, 3]


def register_aligned(
    alignment: Alignment, method: Method, rng: np.random.Generator, name: str | None = None
) -> Registration:
    """Run one method from a coarse alignment (sec. III-B, III-C).

    The method sees both clouds in the US frame; the result is expressed from the CT cloud's own frame.

    Args:
        alignment: the two chests and the motion that overlays their sternums.
        method: the method.
        rng: its draws.
        name: what the result calls the method; its own name when None.

    Raises:
        StudyError: as `run_method`.
    """
    suspect = size_warnings(alignment)
    source, T0 = alignment.source.cloud, alignment.T_us_ct
    result = run_method(method, source.moved(T0), alignment.target.cloud, rng, name)
    quality = measure_quality(alignment, result.warped)
    return replace(
        result,
        source=source.points,
        T_us_ct=result.T_us_ct @ T0,
        quality=quality,
        warnings=(*suspect, *result.warnings, *quality_warnings(quality)),
        converged=result.converged and quality.wrong_part_share <= QUALITY_LIMITS[SWAPPED][0],
        parts=source.parts,
        front=alignment.target.T_cloud_chest.rotation[:, 2],
        target=alignment.target.cloud.points,
    )


def run_method(
    method: Method, source: PointCloud, target: PointCloud, rng: np.random.Generator, name: str | None = None
) -> Registration:
    """Run one method on clouds in one frame, on one thread, against the clock, and check what it returns.

    Args:
        method: the method.
        source: labelled CT cloud, coarsely aligned.
        target: labelled US cloud.
        rng: draws of the method.
        name: what the result calls the method; its own name when None.

    Raises:
        StudyError: what the method raises, or an answer without one finite place per source point.
    """
    name = name or method.name
    # Sums of several threads come in the order in which the threads finish: the last bits would change by the run.
    with threadpool_limits(limits=1):
        start = perf_counter()
        result = method.register(source, target, rng)
        seconds = perf_counter() - start
    _check(result, source, name)
    return replace(result, seconds=seconds, method=name)


def _check(result: Registration, source: PointCloud, name: str) -> None:
    """Refuse an answer that is none: every measure after this one would take it for a place."""
    if result.source.shape != source.points.shape or result.warped.shape != source.points.shape:
        raise StudyError(
            f"{name}: expected one warped point per point of {source.name!r} {source.points.shape}, "
            f"got {result.warped.shape}; a method keeps every row and its order"
        )
    bad = int((~np.isfinite(result.warped)).any(axis=1).sum())
    if bad:
        raise StudyError(
            f"{name}: expected finite points from {source.name!r}, got {bad} rows with NaN or infinity; "
            "choose milder parameters or another method"
        )
