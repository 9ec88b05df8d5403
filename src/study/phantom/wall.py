"""The canonical chest wall: sternum, cartilages and ribs as signed distances (mm, negative inside), laid out flat.

x to the right and z to the head are lengths on the wall, y is the depth to the front, and the wall's middle is the
plane y = 0; z = 0 is the sternal angle. Each subject is an invertible map φ of that flat space
(`study.phantom.subject`), which stretches it, rolls it into a chest and bends it. So a place of one subject is a known
place of every other, and the surface, the CT volume and the waypoints of a subject are all φ of the same wall.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

from study.phantom.sizes import MEASURED_STERNUM_MM, MEASURED_THICKNESS_MM, MEASURED_WIDTH_MM
from study.types import Floats, Ints

# The canonical course of the right side's cartilages and ribs on the flat wall, x and z in mm, z = 0 at the sternal
# angle; the cartilage takes the first `length` mm from the edge of the sternum, bone follows.
COURSES: Mapping[int, tuple[float, tuple[tuple[float, float], ...]]] = {
    1: (28.0, ((16, 34), (34, 37), (48, 44), (62, 57), (74, 72))),
    2: (40.0, ((8, 0), (32, 1), (54, 5), (78, 17), (102, 36), (122, 54))),
    3: (47.0, ((8, -28), (36, -30), (60, -28), (86, -14), (112, 8), (134, 28))),
    4: (56.0, ((8, -51), (34, -59), (54, -62), (72, -58), (98, -40), (124, -16), (144, 4))),
    5: (70.0, ((8, -71), (32, -84), (50, -95), (66, -100), (80, -97), (104, -82), (130, -57), (148, -39))),
    6: (92.0, ((8, -88), (26, -102), (44, -116), (62, -127), (80, -133), (94, -131), (118, -116), (146, -89))),
    7: (125.0, ((8, -98), (18, -111), (34, -130), (58, -152), (84, -166), (102, -167), (126, -154), (148, -135))),
    8: (45.0, ((68, -159), (82, -177), (100, -189), (116, -191), (140, -177))),
}
# Bridges between neighbours: the 5th and 6th meet well beside the sternum, the 8th ends on the 7th.
_BRIDGES = (((58, -98), (60, -126)), ((66, -129), (68, -157)))
HALF_WIDTH_MM = {1: 7.0, **{level: width / 2 for level, width in MEASURED_WIDTH_MM.items()}, 6: 6.0, 7: 6.0, 8: 5.5}
_HALF_THICKNESS_MM = MEASURED_THICKNESS_MM[0] / 2
_RIB_HALF_MM = (6.5, 4.0)
_BRIDGE_HALF_MM = (5.0, 4.0)

# Sternum outline: half width over z, from the xiphoid's tip to the jugular notch.
_STERNUM_Z = (-128, -120, -108, -99, -92, -78, -62, -45, -28, -12, 0, 10, 22, 36, 45, 49)
_STERNUM_HALF_WIDTH = (3, 5.5, 7, 8, 10.5, 13, 13.5, 13, 12, 11.5, 12, 13.5, 17, 24, 23, 19)
STERNUM_TOP_MM, STERNUM_BOTTOM_MM, BODY_BOTTOM_MM = 49.0, -128.0, -95.0
STERNUM_HALF_THICKNESS_MM = MEASURED_STERNUM_MM[1] / 2
_EDGE_RADIUS_MM = 3.0

_SAMPLE_MM = 0.25  # spacing of centreline samples: the surface ripples by less than 2 µm

BONE, CARTILAGE = 1, 2  # tissues


@dataclass(frozen=True)
class Lines:
    """Samples of the centrelines of all cartilages, ribs and bridges on the flat wall.

    Attributes:
        xz: (n, 2) mm.
        tangent: (n, 2) unit vectors along the line.
        arc: (n,) mm from the sternum's edge along the line.
        half: (n, 2) mm, half width and half thickness of the tube.
        level: (n,) 1-8, 0 for a bridge.
        side: (n,) +1 right, -1 left.
        tissue: (n,) `BONE` or `CARTILAGE`.
        trees: first row and tree of the ribs, then of the bridges between them.
    """

    xz: Floats
    tangent: Floats
    arc: Floats
    half: Floats
    level: Ints
    side: Ints
    tissue: Ints
    trees: tuple[tuple[int, KDTree], ...]


def _course(knots: tuple[tuple[float, float], ...]) -> tuple[Floats, Floats, Floats]:
    """Samples, unit tangents and arc length of a smooth line through ``knots``."""
    through = np.array(knots, dtype=float)
    chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(through, axis=0), axis=1))])
    spline = CubicSpline(chord, through) if len(through) > 2 else CubicSpline(chord, through, bc_type="natural")
    dense = spline(np.linspace(0, chord[-1], 4000))
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    even = np.arange(0, arc[-1], _SAMPLE_MM)
    t = np.interp(even, arc, np.linspace(0, chord[-1], 4000))
    tangent = spline(t, 1)
    return spline(t), tangent / np.linalg.norm(tangent, axis=1, keepdims=True), even


@lru_cache(maxsize=1)
def centrelines() -> Lines:
    """The centrelines of both sides, made once a process and shared: do not write to them."""
    rows: list[tuple[Floats, ...]] = []
    for level, (length, knots) in COURSES.items():
        xz, tangent, arc = _course(knots)
        arc = arc - np.interp(sternum_half_width(xz[:1, 1])[0], xz[:, 0], arc)  # 0 at the sternum's edge
        blend = np.clip((arc - length + 6) / 12, 0, 1)[:, None]
        half = (1 - blend) * [HALF_WIDTH_MM[level], _HALF_THICKNESS_MM] + blend * np.array(_RIB_HALF_MM)
        tissue = np.where(arc < length, CARTILAGE, BONE)
        rows.append((xz, tangent, arc, half, np.full(len(arc), level), tissue))
    for knots in _BRIDGES:
        xz, tangent, arc = _course(knots)
        half = np.broadcast_to(_BRIDGE_HALF_MM, xz.shape)
        rows.append((xz, tangent, arc, half, np.zeros(len(arc)), np.full(len(arc), CARTILAGE)))
    xz, tangent, arc, half, levels, tissue = (np.concatenate(column) for column in zip(*rows, strict=True))
    mirror = np.array([-1.0, 1.0])
    both = np.concatenate([xz, xz * mirror])
    order = np.argsort(np.tile(levels, 2) == 0, kind="stable")  # ribs, then bridges
    n_ribs = int(2 * np.count_nonzero(levels))
    return Lines(
        xz=both[order],
        tangent=np.concatenate([tangent, tangent * mirror])[order],
        arc=np.tile(arc, 2)[order],
        half=np.tile(half, (2, 1))[order],
        level=np.tile(levels, 2).astype(np.int64)[order],
        side=np.repeat([1, -1], len(arc))[order],
        tissue=np.tile(tissue, 2).astype(np.int64)[order],
        trees=((0, KDTree(both[order][:n_ribs])), (n_ribs, KDTree(both[order][n_ribs:]))),
    )


@lru_cache(maxsize=1)
def _sternum_spline() -> CubicSpline:
    return CubicSpline(_STERNUM_Z, _STERNUM_HALF_WIDTH)


def sternum_half_width(z: Floats) -> Floats:
    """Half width (n,) mm of the sternum at canonical heights ``z`` (n,) mm; beyond its ends, that of the end."""
    half: Floats = _sternum_spline()(np.clip(z, STERNUM_BOTTOM_MM, STERNUM_TOP_MM))
    return half


@lru_cache(maxsize=1)
def _sternum_edge() -> KDTree:
    """Samples (x >= 0, z) of the right half of the outline."""
    z = np.arange(STERNUM_BOTTOM_MM, STERNUM_TOP_MM, _SAMPLE_MM)
    edge = [np.column_stack([sternum_half_width(z), z])]
    for end in (STERNUM_BOTTOM_MM, STERNUM_TOP_MM):
        x = np.arange(0, sternum_half_width(np.array([end]))[0], _SAMPLE_MM)
        edge.append(np.column_stack([x, np.full(len(x), end)]))
    return KDTree(np.concatenate(edge))


def sternum_distance(points: Floats) -> Floats:
    """Signed distance (n,) mm of canonical points (n, 3) to the sternum, a plate with rounded edges."""
    x, y, z = np.abs(points[:, 0]), np.abs(points[:, 1]), points[:, 2]
    inside = (x < sternum_half_width(z)) & (z > STERNUM_BOTTOM_MM) & (z < STERNUM_TOP_MM)
    edge = _sternum_edge().query(np.column_stack([x, z]))[0] * np.where(inside, -1, 1) + _EDGE_RADIUS_MM
    face = y - STERNUM_HALF_THICKNESS_MM + _EDGE_RADIUS_MM
    beyond = np.hypot(np.maximum(edge, 0), np.maximum(face, 0))
    distance: Floats = np.minimum(np.maximum(edge, face), 0) + beyond - _EDGE_RADIUS_MM
    return distance


def tube_distance(points: Floats) -> tuple[Floats, Ints]:
    """Signed distance (n,) mm of canonical points (n, 3) to the nearest flattened tube: a cartilage, rib or bridge.

    Returns:
        the distances, and the index (n,) of the tube's nearest sample in `centrelines`.
    """
    plane = points[:, [0, 2]]
    ribs, bridges = (first + tree.query(plane)[1] for first, tree in centrelines().trees)
    to_rib, to_bridge = _ellipse_distance(points, ribs), _ellipse_distance(points, bridges)
    is_rib = to_rib <= to_bridge
    return np.where(is_rib, to_rib, to_bridge), np.where(is_rib, ribs, bridges)


def _ellipse_distance(points: Floats, index: Ints) -> Floats:
    """Signed distance (n,) mm to the tube around the centreline sample ``index`` (n,); exact on the surface."""
    lines = centrelines()
    offset = points[:, [0, 2]] - lines.xz[index]
    along = np.abs(np.einsum("ni,ni->n", offset, lines.tangent[index]))
    across = np.sqrt(np.maximum(np.einsum("ni,ni->n", offset, offset) - along**2, 0))
    # Between two samples only the distance across counts; beyond the last one the end is round.
    across = np.where(along < _SAMPLE_MM, across, np.hypot(across, along))
    half_width, half_thickness = lines.half[index].T
    scaled = np.hypot(across / half_width, points[:, 1] / half_thickness)
    slope = np.hypot(across / half_width**2, points[:, 1] / half_thickness**2)
    # First-order distance to the ellipse; at its very centre the slope vanishes.
    distance: Floats = scaled * (scaled - 1) / np.maximum(slope, 1e-6) + np.where(scaled < 1e-6, -half_thickness, 0)
    return distance


def wall_distance(points: Floats) -> Floats:
    """Signed distance (n,) mm of canonical points (n, 3) to sternum, cartilages and ribs together."""
    return np.minimum(sternum_distance(points), tube_distance(points)[0])
