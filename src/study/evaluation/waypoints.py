"""Waypoints between the cartilages, by the paper's protocol (sec. IV-B)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.cluster.vq import ClusterError, kmeans2

from study.errors import StudyError
from study.types import CARTILAGES, Floats, Part, PointCloud, Waypoints

# Waypoints in the space below each level: the longer the cartilages, the more. Both neighbours of a space are cut into
# that many parts, so the 4th is cut twice: into 3 for the space above it and into 4 for the one below.
N_WAYPOINTS = {2: 3, 3: 3, 4: 4}

_MIN_POINTS_PER_PART = 5
_KMEANS_ITERATIONS = 100


def intercostal_waypoints(cloud: PointCloud, cut: Literal["kmeans", "slices"] = "kmeans") -> Waypoints:
    """The 20 waypoints of a labelled cloud: 3, 3 and 4 a side between cartilages 2-3, 3-4 and 4-5.

    Each cartilage is cut into equal parts along its length; the midpoint of corresponding parts' centres on
    neighbouring cartilages is a waypoint. Nothing is drawn: k-means starts from equal slices between the medial and
    the lateral end, so every cloud of an anatomy is cut the same way.

    Args:
        cloud: labelled; mm, any rigid pose.
        cut: "kmeans" is the paper's; "slices" keeps the equal slices. k-means balances points, so strips that a sweep
            missed move its waypoints half as far again as those of the slices.

    Returns:
        (20, 3) mm in the cloud's frame, right side first, medial to lateral: ``"R2-3.1"`` ... ``"L4-5.4"``.

    Raises:
        StudyError: no labels, a cartilage that is missing, has too few points or too wide a gap, an unknown ``cut``.
    """
    if cut not in ("kmeans", "slices"):
        raise StudyError(f"expected cut kmeans|slices, got {cut!r}")
    if cloud.parts is None:
        raise StudyError(
            f"{cloud.name}: expected labelled parts, got none; label it with study.alignment.find_chest first"
        )
    branches = {part: cloud.only(part) for part in CARTILAGES}
    for part, points in branches.items():
        needed = _MIN_POINTS_PER_PART * max(N_WAYPOINTS.values())
        if len(points) < needed:
            raise StudyError(
                f"{cloud.name}: expected at least {needed} points of cartilage {part.name} for its waypoints, "
                f"got {len(points)}; check the crop and the labels"
            )
    to_the_right = _direction_to_the_right(branches)
    midpoints: list[Floats] = []
    labels: list[str] = []
    for side, outwards in (("right", to_the_right), ("left", -to_the_right)):
        for level, count in N_WAYPOINTS.items():
            upper, lower = (
                _centres_along(branches[Part.cartilage(side, at)], count, outwards, cut, cloud.name)
                for at in (level, level + 1)
            )
            midpoints.append((upper + lower) / 2)
            labels += [f"{side[0].upper()}{level}-{level + 1}.{k + 1}" for k in range(count)]
    return Waypoints(np.concatenate(midpoints), tuple(labels))


def _direction_to_the_right(branches: dict[Part, Floats]) -> Floats:
    """Unit vector (3,) from the left to the right cartilages, each counting once however densely it is sampled."""
    right, left = (
        np.mean([points.mean(axis=0) for part, points in branches.items() if part.side == side], axis=0)
        for side in ("right", "left")
    )
    across: Floats = (right - left) / np.linalg.norm(right - left)
    return across


def _centres_along(points: Floats, count: int, outwards: Floats, cut: str, name: str) -> Floats:
    """Centres (count, 3) of the parts of one cartilage, medial to lateral."""
    along = points @ outwards
    # The last percent at either end is noise and stray labels, and would decide where all slices lie.
    low, high = np.percentile(along, [1, 99])
    edges = np.linspace(low, high, count + 1)
    slices = np.searchsorted(edges[1:-1], along)
    gap = f"{name}: expected a cartilage that {count} parts can cover, got a gap wider than one; check the coverage"
    if len(np.unique(slices)) < count:
        raise StudyError(gap)
    centres = np.array([points[slices == k].mean(axis=0) for k in range(count)])
    if cut == "kmeans":
        try:
            centres, _ = kmeans2(points, centres, iter=_KMEANS_ITERATIONS, minit="matrix", missing="raise")
        except ClusterError as error:
            raise StudyError(gap) from error
    return centres[np.argsort(centres @ outwards)]
