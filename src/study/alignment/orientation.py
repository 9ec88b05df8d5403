"""Which face of a chest is the front, which end the foot, and how deep the sternum's front lies (sec. III-A).

All of it is read off the branches in sternum coordinates, mm: x across, y along the sternum, z along the normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from study.alignment.branches import Branches, branch_lengths_mm
from study.alignment.sternum import CROP, SternumParams
from study.errors import StudyError
from study.geometry.points import foremost_in_cells
from study.types import Floats

MIN_BULGE_MM = 0.2
MIN_FRONT_COSINE = 0.2  # between a given front and the normal of the feature plane
# Stands between whole clouds and torn or shifted ones; benchmarks/coarse_margins.py prints by how much.
MIN_LENGTH_RATIO = 1.1  # of the 5th cartilages, found by their bend, over the 2nd; below 1 the bend was wrong
HALF_MM = 6.0  # half the width of a cartilage
FRONT_CELL_MM = 5.0


@dataclass(frozen=True)
class Foot:
    """Which end of the sternum points to the feet, and how clearly.

    Attributes:
        at_high_y: whether the 5th cartilages are the branches of highest y.
        bend_ratio: bend of the branches taken as 5th over that of the branches taken as 2nd.
        length_ratio: the same of their lengths beside the sternum.
    """

    at_high_y: bool
    bend_ratio: float
    length_ratio: float


def find_front(branches: Branches, local: Floats, front_cosine: float | None, name: str) -> tuple[bool, float]:
    """Whether z looks to the front, and how clearly: the branches arch towards it.

    Args:
        branches: numbers of the points.
        local: (n, 3) mm in sternum coordinates.
        front_cosine: between z and the front where the cloud knows it, which then decides; else None.
        name: what the points are, for messages.

    Returns:
        whether z looks to the front; the mean arch of the eight branches towards the front, mm.

    Raises:
        StudyError: a front that lies in the feature plane or that the branches contradict, or branches too flat to
            tell.
    """
    number = branches.branch
    bulge = float(np.mean([bulge_mm(local[number == k], local[number == 0]) for k in range(1, 9)]))
    if front_cosine is None:
        if abs(bulge) < MIN_BULGE_MM:
            raise StudyError(
                f"{name}: expected cartilages that arch {MIN_BULGE_MM} mm or more to the front, got "
                f"{abs(bulge):.2f} mm, so front and back look alike; give the cloud its `front` direction"
            )
        return bulge > 0, abs(bulge)
    if abs(front_cosine) < MIN_FRONT_COSINE:
        raise StudyError(
            f"{name}: expected a `front` across the feature plane (cosine with its normal {MIN_FRONT_COSINE:g} or "
            f"more), got {abs(front_cosine):.2f}; check the direction given with the cloud"
        )
    towards_front = bulge if front_cosine > 0 else -bulge
    if towards_front < -MIN_BULGE_MM:
        raise StudyError(
            f"{name}: expected cartilages that arch towards the `front` given, got {-towards_front:.2f} mm away from "
            "it; does it point to the back, or is the cloud mirrored?"
        )
    return front_cosine > 0, towards_front


def find_foot(branches: Branches, local: Floats, name: str) -> Foot:
    """The end of the sternum beside which the branches bend most: the 5th cartilages do.

    Args:
        branches: numbers and edges of the sternum.
        local: (n, 3) mm in sternum coordinates.
        name: what the points are, for messages.

    Raises:
        StudyError: 5th cartilages that are not the longer ones, too: lines of a sweep that are shifted against each
            other bend any cartilage.
    """
    number = branches.branch
    bend_low, bend_high = (float(np.mean([bend_mm(local[number == k]) for k in ends])) for ends in ((1, 5), (4, 8)))
    lengths = branch_lengths_mm(branches, local)
    low, high = (float(np.mean(lengths[ends])) for ends in ([0, 4], [3, 7]))
    length_ratio = low / high if bend_low > bend_high else high / low
    if length_ratio < MIN_LENGTH_RATIO:
        raise StudyError(
            f"{name}: expected 5th cartilages, those that bend most, to be {MIN_LENGTH_RATIO:g} times as long as "
            f"the 2nd or more, got {length_ratio:.2f}, so head and foot look alike; {CROP}; if "
            "it is so cropped, is a latency left in, or a line of the sweep out of place?"
        )
    bend_ratio = max(bend_low, bend_high) / max(min(bend_low, bend_high), 1e-9)
    return Foot(bend_high > bend_low, bend_ratio, length_ratio)


def bulge_mm(branch: Floats, sternum: Floats) -> float:
    """How far a branch arches towards z (mm): the chest bulges to the front.

    Two readings of one curvature: the rise of the branch above the chord between its ends, and the fall of its
    lateral end behind the sternum beside it, the latter scaled to the former's span.

    Args:
        branch: (n, 3) mm in sternum coordinates.
        sternum: (m, 3) mm in sternum coordinates.
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
    return float(rise + fall * ((b - a) / 2 / b) ** 2)


def bend_mm(branch: Floats) -> float:
    """How far a branch (n, 3) mm strays in the feature plane from the straight line between its ends (mm).

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
    """Depth of the sternum's front surface along z, mm.

    The foremost point of each 5 mm cell counts, so that a tube's whole surface and the sheet that ultrasound
    sees give the same answer.

    Args:
        local: (n, 3) mm in sternum coordinates with z to the front.
        params: the rectangle whose points count.

    Raises:
        StudyError: no point in the rectangle.
    """
    x, y, _ = local.T
    on = (np.abs(x) < params.width_mm / 2) & (np.abs(y) < params.height_mm / 2)
    _, foremost = foremost_in_cells(local[on], FRONT_CELL_MM)
    return float(np.median(foremost))
