"""Whether eight branches are eight cartilages, by their roots beside the sternum (sec. III-A.2)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from study.alignment.branches import MAX_OFFSET_MM, Branches, branch_lengths_mm
from study.alignment.sternum import CROP
from study.errors import StudyError
from study.geometry.points import nearest
from study.types import Floats

# The limits stand between whole clouds and torn or shifted ones; benchmarks/coarse_margins.py prints by how much.
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


def measure_roots(branches: Branches, local: Floats) -> RootMeasures:
    """Measures of where the branches leave the sternum.

    Args:
        branches: numbers of the points, edges of the sternum and seeds.
        local: (n, 2) mm, the points in sternum coordinates.
    """
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
        shortest_mm=float(branch_lengths_mm(branches, local).min()),
        touch=max(max(_share_near(one, other), _share_near(other, one)) for one, other in neighbours),
        fill=float(_count_near(local, between).mean() / max(_count_near(local, seeds).mean(), 1e-9)),
    )


def check_roots(found: RootMeasures, name: str) -> None:
    """Refuse eight pieces that are no cartilages: a rectangle laid askew can find four a side where one is missing.

    Args:
        found: the measures of one cloud.
        name: what the points are, for messages.

    Raises:
        StudyError: roots that do not pair, touch or stand too close, or a plate instead of open spaces.
    """
    if found.offset_mm > MAX_OFFSET_MM or found.apart_mm < MIN_APART_MM or found.shortest_mm < MIN_LENGTH_MM:
        raise StudyError(
            f"{name}: expected four cartilages a side that leave the sternum in pairs (up to {MAX_OFFSET_MM:g} mm), at "
            f"least {MIN_APART_MM:g} mm apart and {MIN_LENGTH_MM:g} mm long, got {found.offset_mm:.0f}, "
            f"{found.apart_mm:.0f} and {found.shortest_mm:.0f} mm; {CROP}; if it is so cropped, is a branch missing?"
        )
    if found.touch > MAX_TOUCH:
        raise StudyError(
            f"{name}: expected cartilages apart from each other beside the sternum, got {found.touch:.2f} of one in "
            f"reach ({TOUCH_MM:g} mm) of the next, need {MAX_TOUCH:g} or less; {CROP}; if it is so cropped, is a "
            "branch missing?"
        )
    if found.fill > MAX_FILL:
        raise StudyError(
            f"{name}: expected open spaces between the cartilages, got {found.fill:.2f} of their own density there, "
            f"need {MAX_FILL:g} or less; {CROP}"
        )


def _share_near(one: Floats, other: Floats) -> float:
    """Share of the points ``one`` (n, 2) that lie within ``TOUCH_MM`` of ``other`` (m, 2); 0 where one is empty."""
    return float((nearest(one, other)[0] < TOUCH_MM).mean()) if len(one) and len(other) else 0.0


def _count_near(local: Floats, places: Floats) -> Floats:
    """Number of points in a 20 × 5 mm window around each place (..., 2)."""
    flat = places.reshape(-1, 2)
    near = np.abs(local[:, None] - flat[None]) < (10.0, 2.5)
    count: Floats = near.all(axis=2).sum(axis=0).astype(np.float64)
    return count
