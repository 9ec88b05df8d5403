"""The chest in a cloud in any rigid pose, and the coarse alignment of two (sec. III-A)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from study.alignment.branches import Branches, find_branches
from study.alignment.orientation import find_foot, find_front, sternum_front_mm
from study.alignment.roots import RootMeasures, check_roots, measure_roots
from study.alignment.sternum import CROP, SternumFit, SternumParams, feature_plane, sternum_candidates, symmetry_axis
from study.errors import StudyError
from study.types import Floats, Ints, Part, PointCloud, RigidTransform


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
    """The sternum, branches, sides and levels of a cloud in any rigid pose (sec. III-A).

    The view is first taken from either face of the feature plane: sternum and branches look alike in a mirror. The
    branches then tell the front, since each arches towards it, and the foot, since the 5th bend most; a cloud whose
    5th are not the longest, too, is refused.

    Args:
        cloud: (n, 3) mm; its ``front``, where known, overrules the branches.
        params: the sternum templates.

    Raises:
        StudyError: no chest-like plane, no sternum, not four branches on each side, or a front or foot not to tell.
    """
    p = params or SternumParams()
    # III-A.1: the feature plane, and Eq. 1 in it; III-A.2: the branches
    T_cloud_plane = feature_plane(cloud)
    flat = T_cloud_plane.inverse.apply(cloud.points)[:, :2]
    search, T_plane_sternum = _sternum_with_branches(flat, p, cloud.name)
    T_cloud_sternum = T_cloud_plane @ T_plane_sternum
    # front and foot
    branches, local = search.branches, T_cloud_sternum.inverse.apply(cloud.points)
    known = None if cloud.front is None else float(cloud.front @ T_cloud_sternum.rotation[:, 2])
    looks_to_front, arch_mm = find_front(branches, local, known, cloud.name)
    foot = find_foot(branches, local, cloud.name)
    T_cloud_sternum, numbers = _turn_upright(T_cloud_sternum, branches.branch, not looks_to_front, foot.at_high_y)
    # names
    labelled = replace(cloud, parts=_parts_of(numbers))
    depth_mm = sternum_front_mm(T_cloud_sternum.inverse.apply(cloud.points), p)
    T_cloud_chest = T_cloud_sternum @ RigidTransform(np.eye(3), np.array([0.0, 0.0, depth_mm]))
    return Chest(
        labelled,
        T_cloud_chest,
        sternum_overlap=search.fit.overlap,
        bend_ratio=foot.bend_ratio,
        length_ratio=foot.length_ratio,
        bulge_mm=arch_mm,
        search=search,
    )


def align(source: PointCloud, target: PointCloud, params: SternumParams | None = None) -> Alignment:
    """The motion that overlays the sternums of two clouds, sides and levels matched (sec. III-A).

    Args:
        source: CT cloud, any rigid pose.
        target: US cloud, any rigid pose.
        params: the sternum templates.

    Raises:
        StudyError: a cloud in which `find_chest` finds no chest.
    """
    return Alignment(find_chest(source, params), find_chest(target, params))


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
            check_roots(roots, name)
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
        f"rectangle, need {params.min_overlap:.2f}; {CROP}"
    )


def _turn(angle: float, shift: Floats) -> RigidTransform:
    """A motion in the feature plane: counter-clockwise turn, then a shift."""
    c, s = np.cos(angle), np.sin(angle)
    return RigidTransform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.append(shift, 0.0))


def _turn_upright(
    T_cloud_sternum: RigidTransform, numbers: Ints, from_behind: bool, foot_up: bool
) -> tuple[RigidTransform, Ints]:
    """The frame turned to see the chest from the front, head up, and the branches renumbered to match.

    Half a turn about y looks from the other face, half a turn about z turns the foot down: never a reflection.
    """
    if from_behind:
        T_cloud_sternum = T_cloud_sternum @ RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
        numbers = np.choose(numbers + 1, [-1, 0, 5, 6, 7, 8, 1, 2, 3, 4])
    if foot_up:
        T_cloud_sternum = T_cloud_sternum @ RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        numbers = np.choose(numbers + 1, [-1, 0, 8, 7, 6, 5, 4, 3, 2, 1])
    return T_cloud_sternum, numbers


def _parts_of(numbers: Ints) -> Ints:
    """Parts (n,) of branch numbers (n,) seen from the front, head up: x is the patient's left."""
    names = [Part.UNKNOWN, Part.STERNUM]
    names += [Part.cartilage(side, level) for side in ("right", "left") for level in (5, 4, 3, 2)]
    return np.array(names, dtype=np.int64)[numbers + 1]
