"""Cartilage branches: boundary search, clusters, flood fill, levels (sec. III-A.2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, islice, pairwise

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from sklearn.cluster import KMeans

from study.alignment.sternum import CROP
from study.errors import StudyError
from study.geometry.points import close_gaps, pixelise, sample_spacing_mm
from study.types import Bools, Floats, Ints

PIXEL_MM = 1.0
BANDS_MM = ((2.0, 14.0), (6.0, 18.0), (10.0, 22.0), (14.0, 26.0), (2.0, 26.0))  # outwards from the sternum's edge
MIN_SPACE_MM = 4.0  # between neighbouring cartilages beside the sternum; narrower gaps are holes of the sampling
MAX_OFFSET_MM = 15.0  # along the sternum between the two roots of a level; a missing branch shifts by a level, 20-35
GAP_COST = 3.0  # of crossing an empty pixel, against 1 along a cartilage
MAX_GAP_MM = 20.0  # a piece farther than this from every branch belongs to none


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
    coverage last passes the middle between the two. The last, since a strip missed by the sweep may split the sternum.

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
    covered = close_gaps(image, int(np.ceil(sample_spacing_mm(points) / PIXEL_MM))).mean(axis=1)
    covered = np.convolve(np.pad(covered, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    lines = np.arange(len(covered)) * PIXEL_MM + PIXEL_MM / 2
    on = covered[lines < 12].max()
    off = np.median(covered[(lines > 24) & (lines < 40)])
    above = np.flatnonzero((covered >= (on + off) / 2) & (lines < 30))
    return float(lines[above[-1]] + PIXEL_MM) if above.size else float(lines[0])


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
    image = close_gaps(image, int(np.ceil(sample_spacing_mm(points) / PIXEL_MM)))
    x = np.arange(image.shape[0])[:, None] * PIXEL_MM + origin[0]
    edges = (sternum_edge_mm(points, height_mm, -1), sternum_edge_mm(points, height_mm, 1))
    sternum = (x >= -edges[0]) & (x <= edges[1])
    left, right = (
        _seeds(image, sign * x - edge, side, name) for side, (sign, edge) in enumerate(zip((-1, 1), edges, strict=True))
    )
    starts = _facing(left, right)
    flooded = _flood(image, np.broadcast_to(sternum, image.shape), starts.astype(np.int64))
    branch = flooded[pixels[:, 0], pixels[:, 1]]
    return Branches(branch, edges, starts * PIXEL_MM + origin)


def branch_lengths_mm(branches: Branches, local: Floats) -> Floats:
    """How far each of the eight branches reaches from the sternum's edge (8,) mm; 0 for an empty one.

    Args:
        branches: numbers of the points and edges of the sternum.
        local: (n, 2) or (n, 3) mm, the points in sternum coordinates.
    """
    beside = [np.abs(local[branches.branch == k, 0]) - branches.half_widths_mm[k > 4] for k in range(1, 9)]
    return np.array([np.percentile(one, 98) if one.size else 0.0 for one in beside])


def _flood(image: Bools, sternum: Bools, starts: Ints) -> Ints:
    """Give every pixel beside the sternum to the seed that reaches it first; 0 on the sternum, -1 where none can.

    The paper floods one branch after another, which leaks where neighbours touch and stops at a missed strip. Here
    all eight fills grow at one pace, and a pixel that the cloud left empty costs more to cross but can be crossed.
    """
    passable = ~sternum & (distance_transform_edt(~image) * PIXEL_MM <= MAX_GAP_MM / 2)
    number = np.arange(image.size).reshape(image.shape)
    cost = np.where(image, 1.0, GAP_COST)
    rows, columns, weights = [], [], []
    for step, length in (((0, 1), 1.0), ((1, 0), 1.0), ((1, 1), np.sqrt(2)), ((1, -1), np.sqrt(2))):
        near = (slice(0, image.shape[0] - step[0]), slice(max(0, -step[1]), image.shape[1] - max(0, step[1])))
        far = (slice(step[0], None), slice(max(0, step[1]), image.shape[1] + min(0, step[1])))
        open_ = passable[near] & passable[far]
        rows.append(number[near][open_])
        columns.append(number[far][open_])
        weights.append((cost[near][open_] + cost[far][open_]) * length / 2)
    entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
    grid = csr_array(entries, shape=(image.size, image.size))
    origins = number[tuple(starts.T)]
    _, _, source = dijkstra(grid, directed=False, indices=origins, min_only=True, return_predecessors=True)
    order = np.argsort(origins)
    branch = order[np.searchsorted(origins, np.maximum(source, origins.min()), sorter=order) % len(origins)] + 1
    branch = np.where(source < 0, -1, branch).reshape(image.shape)
    return np.where(sternum, 0, branch).astype(np.int64)


def _facing(left: Iterator[Floats], right: Iterator[Floats]) -> Floats:
    """The seeds (8, 2) of both sides, from one band of each.

    The roots of a level face each other. Where a strip was missed beside the sternum on one side, they do so only in
    bands farther out: the nearest pair of bands that fits, else the one that fits best. A band is searched when its
    turn comes.
    """
    seen: tuple[list[Floats], list[Floats]] = ([], [])
    best_mm, best = np.inf, np.empty((0, 2))
    for total in count():  # of both sides' bands, so that near ones come first
        for found, following in zip(seen, (left, right), strict=True):
            found += islice(following, 1)
        if total > len(seen[0]) + len(seen[1]) - 2:
            return best
        for i in range(max(0, total + 1 - len(seen[1])), min(total + 1, len(seen[0]))):
            pair = seen[0][i], seen[1][total - i]
            offset_mm = float(np.abs(pair[0][:, 1] - pair[1][:, 1]).max() * PIXEL_MM)
            if offset_mm < best_mm:
                best_mm, best = offset_mm, np.concatenate(pair)
            if best_mm <= MAX_OFFSET_MM:
                return best
    raise AssertionError("counting does not end")


def _seeds(image: Bools, outwards_mm: Floats, side: int, name: str) -> Iterator[Floats]:
    """Four cluster centres (4, 2) beside the sternum (k-means), each snapped to a pixel of its cluster, by rising y.

    The roots of neighbours may touch and a sweep may miss a strip, so the search moves outwards: one answer for every
    band in which no two centres lie on one cartilage.

    Raises:
        StudyError: no such band.
    """
    where = ("left", "right")[side]
    found = False
    for near, far in BANDS_MM:
        candidates = np.argwhere(image & (outwards_mm >= near) & (outwards_mm <= far))
        if len(candidates) < 8:
            continue
        candidates = candidates[np.argsort(candidates[:, 1], kind="stable")]
        starts = [np.array_split(candidates, 4)]
        # A strip may have left little of one cartilage: quarters of the pixels then start on the wrong ones, pieces
        # between clear gaps do not.
        gaps = np.flatnonzero(np.diff(candidates[:, 1]) * PIXEL_MM >= MIN_SPACE_MM) + 1
        if len(gaps) == 3:
            starts.append(np.split(candidates, gaps))
        for pieces in starts:
            start = np.array([piece.mean(axis=0) for piece in pieces])
            clusters = KMeans(n_clusters=4, init=start).fit(candidates)
            seeds = []
            for k in np.argsort(clusters.cluster_centers_[:, 1]):
                members = candidates[clusters.labels_ == k]
                seeds.append(members[np.argmin(np.linalg.norm(members - clusters.cluster_centers_[k], axis=1))])
            if not any(_joined(image, lower, upper) for lower, upper in pairwise(seeds)):
                found = True
                yield np.array(seeds, dtype=np.float64)
    if not found:
        raise StudyError(
            f"{name}: expected 4 separate cartilages at the {where} of the sternum as seen from one face, got fewer; "
            f"{CROP}; if it is so cropped, is a branch missing, or do two touch along their length?"
        )


def _joined(image: Bools, one: Ints, other: Ints) -> bool:
    """Whether the straight line between two pixels stays on the cartilage."""
    steps = np.linspace(one, other, 4 * int(np.ceil(np.linalg.norm(other - one))) + 2)
    return bool(image[tuple(np.round(steps).astype(int).T)].all())
