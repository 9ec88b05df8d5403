"""What a registration is, what a method must offer, and path transfer from CT to US (sec. III-D)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from study import preview
from study.errors import StudyError
from study.geometry.points import fit_rigid, fit_rigid_batch, nearest
from study.quality import Quality
from study.types import Floats, Ints, PointCloud, RigidTransform, as_points

MIN_SUPPORT = 3  # points that hold a rigid motion
MIN_WIDTH_MM = 1e-6  # second singular value of points that lie on a line but for rounding
REACH_MM = 50.0  # from the CT points, beyond which a field is a guess
CARRIED_AT_ONCE = 20_000  # points; each takes a kilobyte while its rigid motion is fitted
MIN_PATH_MM = 1.0  # extent of a path; one in metres is a fraction of a millimetre across


@dataclass(frozen=True)
class CarriedPath:
    """Waypoints after path transfer, the bad ones told apart from the good.

    Attributes:
        points: (k, 3) mm in the US frame; NaN where a waypoint could not be carried.
        reasons: (k,) why not, ``""`` for a good one.
    """

    points: Floats
    reasons: tuple[str, ...]

    def complete(self) -> Floats:
        """The points (k, 3) mm, all of them good.

        Raises:
            StudyError: a waypoint that could not be carried.
        """
        for number, reason in enumerate(self.reasons):
            if reason:
                raise StudyError(f"expected waypoints that can all be carried, got waypoint {number}: {reason}")
        return self.points


def as_waypoints(waypoints: ArrayLike) -> Floats:
    """Check and copy waypoints as a read-only (k, 3) float64 array, mm.

    Raises:
        StudyError: what `study.types.as_points` refuses, or waypoints in metres.
    """
    path = as_points(waypoints, "waypoints")
    extent = float(np.linalg.norm(np.ptp(path, axis=0)))
    if 0 < extent < MIN_PATH_MM:
        raise StudyError(
            f"waypoints: expected a path in millimetres, got {len(path)} points {extent:.2g} mm across; metres? "
            "multiply by 1000"
        )
    return path


def carry_path(source: ArrayLike, warped: ArrayLike, waypoints: ArrayLike, *, radius_mm: float = 20.0) -> CarriedPath:
    """Move each waypoint by the rigid fit of the cloud points around it (sec. III-D), a bad one for itself.

    Args:
        source: (n, 3) mm, CT.
        warped: (n, 3) mm, row i is ``source[i]`` in the US frame.
        waypoints: (k, 3) mm, CT.
        radius_mm: sphere around each waypoint; 20 mm in the paper.

    Raises:
        StudyError: clouds that do not pair, a radius that is none, or waypoints in metres.
    """
    waypoints = as_waypoints(waypoints)
    source, warped = as_points(source, "source"), as_points(warped, "warped")
    if source.shape != warped.shape:
        raise StudyError(
            f"expected one warped point per source point, got {source.shape} and {warped.shape}; "
            "pass both clouds of one registration"
        )
    if not 0 < radius_mm < np.inf:
        raise StudyError(f"expected radius_mm > 0, got {radius_mm}; the paper's is 20")
    moved, reasons = np.full_like(waypoints, np.nan), []
    for k, members in enumerate(KDTree(source).query_ball_point(waypoints, radius_mm)):
        local = source[members]
        if len(members) < MIN_SUPPORT or _on_a_line(local):
            reasons.append(
                f"expected at least {MIN_SUPPORT} CT points off a line within {radius_mm:g} mm, got {len(members)}; "
                "check that it lies between the cartilages, or raise the radius"
            )
            continue
        moved[k] = fit_rigid(local, warped[members]).apply(waypoints[k : k + 1])[0]
        reasons.append("")
    return CarriedPath(moved, tuple(reasons))


def transfer(source: ArrayLike, warped: ArrayLike, waypoints: ArrayLike, *, radius_mm: float = 20.0) -> Floats:
    """`carry_path` of waypoints that must all be good (sec. III-D).

    Returns:
        (k, 3) mm in the US frame.

    Raises:
        StudyError: what `carry_path` refuses, or a sphere with fewer than 3 points or with points on a line.

    A breath lifts this wall by 5 mm and widens it by 2 %; a waypoint behind it goes along:

        >>> import numpy as np
        >>> wall = np.random.default_rng(0).uniform([-60, -5, -60], [60, 5, 60], (2000, 3))
        >>> transfer(wall, wall * [1.02, 1, 1] + [0, 5, 0], [[50, -10, 20]]).round(1)
        array([[51., -5., 20.]])
    """
    return carry_path(source, warped, waypoints, radius_mm=radius_mm).complete()


def carry(points: Floats, source: Floats, warped: Floats, neighbours: int) -> Floats:
    """Move each of ``points`` (k, 3) by the rigid motion of its nearest ``source`` (n, 3) to ``warped`` (n, 3)."""
    tree, carried = KDTree(source), np.empty_like(points)
    for start in range(0, len(points), CARRIED_AT_ONCE):
        rows = slice(start, start + CARRIED_AT_ONCE)
        _, index = tree.query(points[rows], k=neighbours)
        weights = np.full(index.shape, 1 / neighbours)
        rotations, translations = fit_rigid_batch(source[index], warped[index], weights)
        carried[rows] = np.einsum("nij,nj->ni", rotations, points[rows]) + translations
    return carried


def _on_a_line(points: Floats) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] < MIN_WIDTH_MM)


@dataclass(frozen=True)
class Registration:
    """What every method returns; a method that has more to show returns a subclass.

    Attributes:
        source: (n, 3) mm, the CT points as given.
        warped: (n, 3) mm, row i is ``source[i]`` in the target (US) frame.
        T_us_ct: the rigid part only: the whole answer of a rigid method, the coarse alignment of a non-rigid one. Not
            what a robot should follow; `transfer` is.
        converged: False when the iteration limit or the end of a schedule came before the method was at rest.
        n_iterations: iterations (epochs) run.
        stop_reason: why it stopped, in words.
        history: figures of progress, in order; what they are and how often depends on the method.
        seconds: wall time of the method; `study.pipeline.run_method` sets it, and
        method: the name it ran under.
        warnings: sentences, each on one thing that makes the answer suspect; empty when nothing does.
        quality: measures of the result that need no truth; `study.pipeline.register_aligned` sets both.
        parts: (n,) `Part` of each CT point, as the coarse alignment named it; it sets this, and
        front: (3,) unit vector from the chest to the skin in the US frame, and
        target: (m, 3) mm, the US points as given; None of a method that ran by itself.

    A notebook shows one as a few lines and a picture. Its verb is path transfer:

        >>> import numpy as np
        >>> from study.types import RigidTransform
        >>> wall = np.random.default_rng(0).uniform([-60, -5, -60], [60, 5, 60], (2000, 3))
        >>> up = RigidTransform(np.eye(3), np.array([0.0, 5.0, 0.0]))
        >>> pair = Registration(wall, up.apply(wall), up, converged=True, n_iterations=1, stop_reason="planted")
        >>> pair.transfer([[50, -10, 20]]).round(1)
        array([[50., -5., 20.]])
    """

    source: Floats
    warped: Floats
    T_us_ct: RigidTransform
    converged: bool
    n_iterations: int
    stop_reason: str
    history: tuple[float, ...] = ()
    seconds: float = 0.0
    method: str = ""
    warnings: tuple[str, ...] = ()
    quality: Quality | None = None
    parts: Ints | None = None
    front: Floats | None = None
    target: Floats | None = None

    def transfer(self, waypoints: ArrayLike, radius_mm: float = 20.0) -> Floats:
        """`carry_path` of waypoints that must all be good: (k, 3) mm in the US frame.

        Raises:
            StudyError: fewer than 3 cloud points within ``radius_mm`` of a waypoint.
        """
        return self.carry_path(waypoints, radius_mm).complete()

    def carry_path(self, waypoints: ArrayLike, radius_mm: float = 20.0) -> CarriedPath:
        """Waypoints (k, 3) mm from the CT frame into the US frame by local rigid fits (sec. III-D).

        Raises:
            StudyError: as the function `carry_path`.
        """
        return carry_path(self.source, self.warped, waypoints, radius_mm=radius_mm)

    def bounds(self, waypoints: ArrayLike) -> Floats:
        """How far (k,) mm at most each transferred waypoint lies from its true place, 19 times in 20.

        Raises:
            StudyError: a method that says nothing of its error, as most do.
        """
        raise StudyError(
            f"{self.method or 'this registration'}: expected a method with bounds, got one without; study.BEST_METHOD "
            "has them"
        )

    def carry(self, points: Floats, neighbours: int) -> Floats:
        """Where other places (k, 3) mm of the CT lie in the US frame: each goes along with its nearest CT points."""
        return carry(points, self.source, self.warped, neighbours)

    def _repr_html_(self) -> str:
        """A few lines, and the warped cloud coloured by how far each point left the rigid part."""
        bent_mm = np.linalg.norm(self.warped - self.T_us_ct.apply(self.source), axis=1)
        lines = {
            "points": f"{len(self.source):,}",
            "converged": "yes" if self.converged else "no",
            "iterations": f"{self.n_iterations:,}",
            "stopped": self.stop_reason,
            "warnings": "; ".join(self.warnings) or "none",
            "seconds": f"{self.seconds:.1f}",
            "colour": f"distance from the rigid part, 0 to {bent_mm.max():.1f} mm",
        }
        return preview.card(f"Registration: {self.method or 'unnamed'}", lines, preview.by_size(self.warped, bent_mm))


class Field(Protocol):
    """A map of space, known anywhere."""

    def apply(self, points: Floats) -> Floats:
        """Where points (k, 3) mm of the US frame come to lie in it."""
        ...


@dataclass(frozen=True, kw_only=True)
class FieldRegistration(Registration):
    """A registration that knows where any place goes, not its points only; its waypoints need no local fits.

    Attributes:
        field: takes the CT after ``T_us_ct`` to its places in the US frame; ``warped`` is what it makes of ``source``.
    """

    field: Field

    def carry_path(self, waypoints: ArrayLike, radius_mm: float = 20.0) -> CarriedPath:
        """Waypoints (k, 3) mm from the CT frame into the US frame by the field itself; ``radius_mm`` plays no part.

        Raises:
            StudyError: waypoints that are none. One far from the CT points, where nothing holds the field, has a
                reason instead.
        """
        path = as_waypoints(waypoints)
        away, _ = nearest(path, self.source)
        far = away > REACH_MM
        reasons = tuple(
            f"expected CT points within {REACH_MM:g} mm, got none within {mm:.0f}; check its frame" if bad else ""
            for mm, bad in zip(away, far, strict=True)
        )
        return CarriedPath(np.where(far[:, None], np.nan, self.carry(path)), reasons)

    def carry(self, points: Floats, neighbours: int = 0) -> Floats:
        """Where other places (k, 3) mm of the CT lie in the US frame, by the field."""
        return self.field.apply(self.T_us_ct.apply(points))


@runtime_checkable
class Method(Protocol):
    """A registration method: a frozen dataclass of its parameters plus one verb.

    It is its algorithm and no more: the clock, the one arithmetic thread, the name and the check of the result stand
    once, around all of them, in `study.pipeline.run_method`.
    """

    name: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, Any]]  # a frozen dataclass: asdict(method) is its provenance

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """Register labelled, coarsely aligned clouds: ``warped`` row i is source point i in the target frame."""
        ...
