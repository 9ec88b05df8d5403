"""Coarse alignment of two clouds from any rigid pose (sec. III-A)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares

from study.cartilage import MAX_OFFSET_MM, Branches, find_branches
from study.errors import StudyError
from study.geometry import nearest
from study.sternum import SternumFit, SternumParams, feature_plane, sternum_candidates, symmetry_axis
from study.types import CARTILAGES, ChestFrame, Floats, Part, PointCloud, RigidTransform

MIN_BULGE_MM = 0.2
HALF_MM = 6.0  # half the width of a cartilage
# The limits below stand between whole clouds and torn or shifted ones; benchmarks/coarse_margins.py prints by how much.
MIN_LENGTH_RATIO = 1.1  # of the 5th cartilages, found by their bend, over the 2nd; below 1 the bend was wrong
MIN_APART_MM = 12.0  # between the roots of neighbours
MIN_LENGTH_MM = 12.0  # beside the sternum
BESIDE_MM = 20.0  # from the sternum's edge: where neighbours that are two cartilages are apart
TOUCH_MM = 4.0
MAX_TOUCH = 0.3  # share of a root that close to its neighbour: more are two halves of one cartilage
MAX_FILL = 0.6  # density of points between neighbours over that on them; a plate has about 1


@dataclass(frozen=True)
class RootMeasures:
    """What tells eight cartilages from eight pieces of something else.

    Attributes:
        offset_mm: largest distance along the sternum between the two roots of a level.
        apart_mm: smallest distance between the roots of neighbours.
        shortest_mm: reach of the shortest branch from the sternum's edge.
        touch: largest share of a root within ``TOUCH_MM`` of its neighbour.
        fill: density of points between the roots over that on them.
    """

    offset_mm: float
    apart_mm: float
    shortest_mm: float
    touch: float
    fill: float


@dataclass(frozen=True)
class ChestSearch:
    """What the search saw on its way, for looking at (the paper's Fig. 2).

    Attributes:
        plane: (n, 2) mm, the cloud in its feature plane.
        fit: the rectangle there, with those of the coarser scales.
        local: (n, 2) mm, the cloud in sternum coordinates, y along the symmetry axis.
        branches: sternum edges, seeds and branches in ``local``.
        roots: by which the branches were taken for cartilages.
    """

    plane: Floats
    fit: SternumFit
    local: Floats
    branches: Branches
    roots: RootMeasures


@dataclass(frozen=True)
class Chest:
    """A cloud whose sternum, branches, sides and levels are known.

    Attributes:
        cloud: the points with ``parts`` set.
        T_cloud_chest: chest coordinates (x left, y up, z front; origin on the sternum's front) to the cloud's frame.
        sternum_overlap: F_k over the area of the rectangle (Eq. 1).
        bend_ratio: bend of the branches taken as 5th over that of the branches taken as 2nd.
        length_ratio: the same of their lengths beside the sternum.
        bulge_mm: mean arch of the branches towards the front.
        search: how they were found.
    """

    cloud: PointCloud
    T_cloud_chest: RigidTransform
    sternum_overlap: float
    bend_ratio: float
    length_ratio: float
    bulge_mm: float
    search: ChestSearch


@dataclass(frozen=True)
class Alignment:
    """Two chests and the motion that overlays their sternums (sec. III-A)."""

    source: Chest
    target: Chest

    @property
    def T_us_ct(self) -> RigidTransform:
        """CT frame to US frame."""
        return self.target.T_cloud_chest @ self.source.T_cloud_chest.inverse


def find_chest(cloud: PointCloud, params: SternumParams | None = None) -> Chest:
    """Find sternum, branches, sides and levels in a cloud in any rigid pose (sec. III-A).

    The view is first taken from either face of the feature plane: sternum and branches look alike in a mirror. The
    branches then tell the front, since each arches towards it, and the foot, since the 5th bend most; a cloud whose
    5th are not the longest, too, is refused: lines of a sweep that are shifted against each other bend any cartilage.

    Raises:
        StudyError: no chest-like plane, no sternum, or not four branches on each side.
    """
    p = params or SternumParams()
    T_cloud_plane = feature_plane(cloud)
    flat = T_cloud_plane.inverse.apply(cloud.points)[:, :2]
    search, T_plane_sternum = _sternum_with_branches(flat, p, cloud.name)
    branches = search.branches
    T_cloud_sternum = T_cloud_plane @ T_plane_sternum
    local = T_cloud_sternum.inverse.apply(cloud.points)
    numbers = branches.branch
    bulge = float(np.mean([_bulge_mm(local[numbers == k], local[numbers == 0]) for k in range(1, 9)]))
    if cloud.front is not None:
        bulge = float(cloud.front @ T_cloud_sternum.rotation[:, 2])
    if abs(bulge) < MIN_BULGE_MM:
        raise StudyError(
            f"{cloud.name}: expected cartilages that arch {MIN_BULGE_MM} mm or more to the front, got "
            f"{abs(bulge):.2f} mm, so front and back look alike; give the cloud its `front` direction"
        )
    bend_low, bend_high = (float(np.mean([_bend_mm(local[numbers == k]) for k in ends])) for ends in ((1, 5), (4, 8)))
    ratio = max(bend_low, bend_high) / max(min(bend_low, bend_high), 1e-9)
    lengths = _lengths_mm(branches, local)
    low, high = (float(np.mean(lengths[ends])) for ends in ([0, 4], [3, 7]))
    length_ratio = low / high if bend_low > bend_high else high / low
    if length_ratio < MIN_LENGTH_RATIO:
        raise StudyError(
            f"{cloud.name}: expected 5th cartilages, those that bend most, to be {MIN_LENGTH_RATIO:g} times as long as "
            f"the 2nd or more, got {length_ratio:.2f}, so head and foot look alike; is a latency left in, or a "
            "line of the sweep out of place?"
        )
    # Half a turn about y looks from the other face, half a turn about z turns the foot down: never a reflection.
    if bulge < 0:
        T_cloud_sternum = T_cloud_sternum @ RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
        numbers = np.choose(numbers + 1, [-1, 0, 5, 6, 7, 8, 1, 2, 3, 4])
    if bend_high > bend_low:
        T_cloud_sternum = T_cloud_sternum @ RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        numbers = np.choose(numbers + 1, [-1, 0, 8, 7, 6, 5, 4, 3, 2, 1])
    names = [Part.UNKNOWN, Part.STERNUM]
    names += [Part.cartilage(side, level) for side in ("right", "left") for level in (5, 4, 3, 2)]  # x is left, y up
    parts = np.array(names, dtype=np.int64)[numbers + 1]
    front = sternum_front_mm(T_cloud_sternum.inverse.apply(cloud.points), p)
    T_cloud_chest = T_cloud_sternum @ RigidTransform(np.eye(3), np.array([0.0, 0.0, front]))
    overlap = search.fit.overlap
    return Chest(replace(cloud, parts=parts), T_cloud_chest, overlap, ratio, length_ratio, abs(bulge), search)


def _sternum_with_branches(flat: Floats, params: SternumParams, name: str) -> tuple[ChestSearch, RigidTransform]:
    """The best covered rectangle that four separate branches leave on each side, and T_plane_sternum."""
    first_error: StudyError | None = None
    best = 0.0
    lifted = np.column_stack([flat, np.zeros(len(flat))])
    for fit in sternum_candidates(flat, params):
        best = max(best, fit.overlap)
        if fit.overlap < params.min_overlap:
            continue
        T_plane_sternum = _turn(np.radians(fit.angle_deg), fit.centre)
        local = T_plane_sternum.inverse.apply(lifted)[:, :2]
        angle_deg, shift = symmetry_axis(local)
        turn = _turn(np.radians(angle_deg), np.zeros(2))
        T_plane_sternum = T_plane_sternum @ turn @ _turn(0.0, np.array([shift, 0.0]))
        local = T_plane_sternum.inverse.apply(lifted)[:, :2]
        try:
            branches = find_branches(local, params.height_mm, name)
            roots = measure_roots(branches, local)
            _check_roots(roots, name)
        except StudyError as error:
            first_error = first_error or error
            continue
        # The rectangle slides along a longer or shorter sternum; the eight attachments do not.
        along = np.array([0.0, branches.seeds[:, 1].mean()])
        return ChestSearch(flat, fit, local, branches, roots), T_plane_sternum @ _turn(0.0, along)
    if first_error is not None:
        raise first_error
    raise StudyError(
        f"no sternum found in {name!r}: best overlap {best:.2f} of a {params.width_mm:g} × {params.height_mm:g} mm "
        f"rectangle, need {params.min_overlap:.2f}; check that the cloud holds sternum and cartilages 2-5"
    )


def measure_roots(branches: Branches, local: Floats) -> RootMeasures:
    """Measure where the branches leave the sternum; ``local`` (n, 2) mm are their points in sternum coordinates."""
    roots = branches.seeds[:, 1].reshape(2, 4)
    beside_sternum = (local[:, 0] > -branches.half_widths_mm[0] - BESIDE_MM) & (
        local[:, 0] < branches.half_widths_mm[1] + BESIDE_MM
    )
    roots_of = [local[(branches.branch == k) & beside_sternum] for k in range(1, 9)]
    neighbours = [pair for side in (roots_of[:4], roots_of[4:]) for pair in pairwise(side)]
    seeds = branches.seeds.reshape(2, 4, 2)
    between = (seeds[:, :-1] + seeds[:, 1:]) / 2
    return RootMeasures(
        offset_mm=float(np.abs(roots[0] - roots[1]).max()),
        apart_mm=float(np.diff(roots, axis=1).min()),
        shortest_mm=float(_lengths_mm(branches, local).min()),
        touch=max(max(_share_near(one, other), _share_near(other, one)) for one, other in neighbours),
        fill=float(_count_near(local, between).mean() / max(_count_near(local, seeds).mean(), 1e-9)),
    )


def _check_roots(found: RootMeasures, name: str) -> None:
    """Refuse eight pieces that are no cartilages: a rectangle laid askew can find four a side where one is missing."""
    if found.offset_mm > MAX_OFFSET_MM or found.apart_mm < MIN_APART_MM or found.shortest_mm < MIN_LENGTH_MM:
        raise StudyError(
            f"{name}: expected four cartilages a side that leave the sternum in pairs (up to {MAX_OFFSET_MM:g} mm), at "
            f"least {MIN_APART_MM:g} mm apart and {MIN_LENGTH_MM:g} mm long, got {found.offset_mm:.0f}, "
            f"{found.apart_mm:.0f} and {found.shortest_mm:.0f} mm; is a branch missing, or does the cloud hold more "
            "than cartilages 2-5?"
        )
    if found.touch > MAX_TOUCH:
        raise StudyError(
            f"{name}: expected cartilages apart from each other beside the sternum, got {found.touch:.2f} of one in "
            f"reach ({TOUCH_MM:g} mm) of the next, need {MAX_TOUCH:g} or less; is a branch missing?"
        )
    if found.fill > MAX_FILL:
        raise StudyError(
            f"{name}: expected open spaces between the cartilages, got {found.fill:.2f} of their own density there, "
            f"need {MAX_FILL:g} or less; crop to sternum and cartilages of ribs 2-5"
        )


def _lengths_mm(branches: Branches, local: Floats) -> Floats:
    """How far each of the eight branches reaches from the sternum's edge (mm); 0 for an empty one."""
    beside = [np.abs(local[branches.branch == k, 0]) - branches.half_widths_mm[k > 4] for k in range(1, 9)]
    return np.array([np.percentile(one, 98) if one.size else 0.0 for one in beside])


def _share_near(one: Floats, other: Floats) -> float:
    """Share of the points ``one`` (n, 2) that lie within ``TOUCH_MM`` of ``other`` (m, 2); 0 where one is empty."""
    return float((nearest(one, other)[0] < TOUCH_MM).mean()) if len(one) and len(other) else 0.0


def _count_near(local: Floats, places: Floats) -> Floats:
    """Number of points in a 20 × 5 mm window around each place (..., 2)."""
    flat = places.reshape(-1, 2)
    near = np.abs(local[:, None] - flat[None]) < (10.0, 2.5)
    return near.all(axis=2).sum(axis=0).astype(np.float64)


def _turn(angle: float, shift: Floats) -> RigidTransform:
    """A motion in the feature plane: counter-clockwise turn, then a shift."""
    c, s = np.cos(angle), np.sin(angle)
    return RigidTransform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.append(shift, 0.0))


def _bulge_mm(branch: Floats, sternum: Floats) -> float:
    """How far a branch arches towards z (mm): the chest bulges to the front.

    Two readings of one curvature: the rise of the branch above the chord between its ends, and the fall of its
    lateral end behind the sternum beside it, the latter scaled to the former's span.
    """
    x, y, z = branch.T
    along = np.abs(x)
    a, b = np.percentile(along, [5, 95])
    t = 2 * (along - a) / (b - a) - 1
    design = np.column_stack([np.ones_like(t), t, y - y.mean(), t * t])
    rise = -float(np.linalg.lstsq(design, z, rcond=None)[0][3])
    root = y[along < a + 0.3 * (b - a)].mean()
    beside = np.abs(sternum[:, 1] - root) < 15.0
    if not beside.any():
        return rise
    fall = float(sternum[beside, 2].mean() - z[along > b - 0.2 * (b - a)].mean())
    return rise + fall * ((b - a) / 2 / b) ** 2


def _bend_mm(branch: Floats) -> float:
    """How far a branch strays in the feature plane from the straight line between its ends (mm).

    Robust: pieces of a neighbour that the flood gave to this branch would bend it.
    """
    flat = branch[:, :2] - branch[:, :2].mean(axis=0)
    _, _, axes = np.linalg.svd(flat, full_matrices=False)
    along, across = (flat @ axes.T).T
    a, b = np.percentile(along, [2, 98])
    t = 2 * (along - a) / (b - a) - 1
    powers = np.stack([np.ones_like(t), t, t * t])
    fit = least_squares(lambda c: c @ powers - across, np.zeros(3), lambda _: powers.T, loss="cauchy", f_scale=HALF_MM)
    return abs(float(fit.x[2]))


def sternum_front_mm(local: Floats, params: SternumParams) -> float:
    """Depth of the sternum's front surface in sternum coordinates, mm.

    The foremost point of each 5 mm cell counts, so that a tube's whole surface and the sheet that ultrasound
    sees give the same answer.
    """
    x, y, z = local.T
    on = (np.abs(x) < params.width_mm / 2) & (np.abs(y) < params.height_mm / 2)
    cells = np.floor(local[on, :2] / 5.0).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    foremost = np.full(cell.max() + 1, -np.inf)
    np.maximum.at(foremost, cell, z[on])
    return float(np.median(foremost))


def align(source: PointCloud, target: PointCloud, params: SternumParams | None = None) -> Alignment:
    """Overlay the sternums of two clouds, sides and levels matched (sec. III-A).

    Args:
        source: CT cloud, any rigid pose.
        target: US cloud, any rigid pose.
        params: the sternum templates.
    """
    return Alignment(find_chest(source, params), find_chest(target, params))


def chest_frame(cloud: PointCloud) -> ChestFrame:
    """The frame the template graph is drawn in, from a labelled cloud.

    Raises:
        StudyError: a part is missing.
    """
    missing = [part.name for part in (Part.STERNUM, *CARTILAGES) if len(cloud.only(part)) < 3]
    if missing:
        raise StudyError(f"{cloud.name}: expected points on every part, got none on {', '.join(missing)}")
    sternum = cloud.only(Part.STERNUM)
    origin = sternum.mean(axis=0)
    centre = {part: cloud.only(part).mean(axis=0) for part in CARTILAGES}
    left = np.mean([centre[p] - centre[q] for p, q in zip(CARTILAGES[4:], CARTILAGES[:4], strict=True)], axis=0)
    up = np.linalg.svd(sternum - origin, full_matrices=False)[2][0]
    heads = np.mean([centre[p] for p in CARTILAGES if p.level == 2], axis=0)
    feet = np.mean([centre[p] for p in CARTILAGES if p.level == 5], axis=0)
    up = up * np.sign(up @ (heads - feet))
    left = left - (left @ up) * up
    left /= np.linalg.norm(left)
    x = (sternum - origin) @ left
    x0, x1 = np.percentile(x, [2, 98])
    origin = origin + (x0 + x1) / 2 * left
    half_width = (x1 - x0) / 2
    root, reach = {}, {}
    for part in CARTILAGES:
        away = cloud.only(part) - origin
        lateral = np.abs(away @ left)
        medial = lateral <= np.percentile(lateral, 15)
        root[part] = float((away @ up)[medial].mean())
        reach[part] = float(np.percentile(lateral, 98) - half_width)
    return ChestFrame(origin, left, up, np.cross(left, up), float(x1 - x0), root, reach)
