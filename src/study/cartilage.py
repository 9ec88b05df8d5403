"""Cartilage branches: boundary search, clusters, flood fill, levels (sec. III-A.2)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import distance_transform_edt, label
from skimage.segmentation import watershed
from sklearn.cluster import KMeans

from study.errors import StudyError
from study.geometry import close_gaps, pixelise, sample_spacing_mm
from study.types import Bools, Floats, Ints

PIXEL_MM = 2.0
BANDS_MM = ((2.0, 14.0), (6.0, 18.0), (10.0, 22.0), (14.0, 26.0))  # outwards from the sternum's edge; roots may touch
MAX_GAP_MM = 20.0  # an unreached piece farther than this from every branch stays unlabelled


@dataclass(frozen=True)
class Branches:
    """What the flood fill found, in sternum coordinates (x to the viewer's right, y along the sternum).

    Attributes:
        branch: (n,) int64 per point: 0 sternum, 1-4 at x < 0 and 5-8 at x > 0 by rising y, -1 unreached.
        half_widths_mm: sternum edge at x < 0 and x > 0, positive.
        seeds: (8, 2) mm.
    """

    branch: Ints
    half_widths_mm: tuple[float, float]
    seeds: Floats


def sternum_edge_mm(points: Floats, height_mm: float, sign: int) -> float:
    """Distance from the centreline to where the covered part of a parallel line drops (sec. III-A.2).

    The line is covered whole on the sternum and only where cartilages leave it outside; the edge is where the
    coverage passes the middle between the two.

    Args:
        points: (n, 2) mm in sternum coordinates.
        height_mm: length of the line.
        sign: -1 or +1, the side to search.
    """
    x, y = points[:, 0] * sign, points[:, 1]
    rows = round(height_mm / PIXEL_MM)
    inside = (np.abs(y) < rows * PIXEL_MM / 2) & (x >= 0) & (x < 60.0)
    image = np.zeros((int(60 / PIXEL_MM), rows), dtype=bool)
    image[(x[inside] / PIXEL_MM).astype(int), ((y[inside] + rows * PIXEL_MM / 2) / PIXEL_MM).astype(int)] = True
    covered = close_gaps(image, round(2 * sample_spacing_mm(points) / PIXEL_MM)).mean(axis=1)
    covered = np.convolve(np.pad(covered, 1, mode="edge"), np.ones(3) / 3, mode="valid")
    lines = np.arange(len(covered)) * PIXEL_MM + PIXEL_MM / 2
    on = covered[lines < 10].mean()
    off = covered[(lines > 10) & (lines < 40)].min()
    below = np.flatnonzero((covered < (on + off) / 2) & (lines > 6))
    return float(lines[below[0]]) if below.size else float(lines[-1])


def find_branches(points: Floats, height_mm: float, name: str = "cloud") -> Branches:
    """Split a front view into the sternum and four branches a side (sec. III-A.2).

    Args:
        points: (n, 2) mm in sternum coordinates: origin at the rectangle's centre, y along its long edge.
        height_mm: long edge of the rectangle.
        name: what the points are, for messages.

    Raises:
        StudyError: a side on which four separate branches do not leave the sternum.
    """
    image, pixels, origin = pixelise(points, PIXEL_MM, pad=4)
    image = close_gaps(image, round(2 * sample_spacing_mm(points) / PIXEL_MM))
    x = np.arange(image.shape[0])[:, None] * PIXEL_MM + origin[0]
    edges = (sternum_edge_mm(points, height_mm, -1), sternum_edge_mm(points, height_mm, 1))
    sternum = (x >= -edges[0]) & (x <= edges[1])
    markers = np.zeros(image.shape, dtype=np.int64)
    seeds = []
    for side, (sign, edge) in enumerate(zip((-1, 1), edges, strict=True)):
        seeds.append(_seeds(image, sign * x - edge, side, name) * PIXEL_MM + origin)
        for k, seed in enumerate(seeds[-1]):
            row, column = np.round((seed - origin) / PIXEL_MM).astype(int)
            markers[row, column] = 1 + 4 * side + k
    free = image & ~sternum
    flooded = watershed(np.zeros(image.shape), markers, mask=free)  # all eight fills grow at one pace
    flooded = _adopt_islands(flooded, free)
    flooded[sternum & image] = 9
    found = flooded[pixels[:, 0], pixels[:, 1]]
    branch = np.where(found == 9, 0, np.where(found == 0, -1, found)).astype(np.int64)
    return Branches(branch, edges, np.concatenate(seeds))


def _seeds(image: Bools, outwards_mm: Floats, side: int, name: str) -> Floats:
    """Four cluster centres beside the sternum (k-means), each snapped to a pixel of its cluster, by rising y.

    The roots of neighbours may touch, so the search moves outwards until no two centres lie on one cartilage.
    """
    where = ("left", "right")[side]
    for near, far in BANDS_MM:
        candidates = np.argwhere(image & (outwards_mm >= near) & (outwards_mm <= far))
        if len(candidates) < 8:
            break
        quarters = np.array_split(candidates[np.argsort(candidates[:, 1], kind="stable")], 4)
        clusters = KMeans(n_clusters=4, init=np.array([quarter.mean(axis=0) for quarter in quarters])).fit(candidates)
        seeds = []
        for k in np.argsort(clusters.cluster_centers_[:, 1]):
            members = candidates[clusters.labels_ == k]
            seeds.append(members[np.argmin(np.linalg.norm(members - clusters.cluster_centers_[k], axis=1))])
        if not any(_joined(image, lower, upper) for lower, upper in pairwise(seeds)):
            return np.array(seeds, dtype=np.float64)
    raise StudyError(
        f"{name}: expected 4 separate cartilages at the {where} of the sternum as seen from one face, got fewer; "
        "is a branch missing, or do two touch along their length?"
    )


def _joined(image: Bools, one: Ints, other: Ints) -> bool:
    """Whether the straight line between two pixels stays on the cartilage."""
    steps = np.linspace(one, other, 4 * int(np.ceil(np.linalg.norm(other - one))) + 2)
    return bool(image[tuple(np.round(steps).astype(int).T)].all())


def _adopt_islands(flooded: Ints, free: np.ndarray) -> Ints:
    """Give each piece that no fill reached to the branch whose pixels come closest to it."""
    islands, count = label(free & (flooded == 0), structure=np.ones((3, 3)))
    if count == 0:
        return flooded
    distance, nearest = distance_transform_edt(flooded == 0, return_indices=True)
    result = flooded.copy()
    for island in range(1, count + 1):
        members = np.argwhere(islands == island)
        gap = distance[tuple(members.T)]
        if gap.min() * PIXEL_MM <= MAX_GAP_MM:
            touch = members[np.argmin(gap)]
            result[islands == island] = flooded[tuple(nearest[:, touch[0], touch[1]])]
    return result
