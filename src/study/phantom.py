"""A synthetic thorax whose anatomy and deformation are known exactly.

One canonical anterior chest wall is laid out flat: x to the right and z to the head are lengths on the wall, y is the
depth to the front, and the wall's middle is the plane y = 0. It is an implicit function, negative inside. Each subject
is an invertible map φ of that flat space (`study.deform`) which stretches it, rolls it into a chest and bends it, with
sizes drawn from published ones. So a place of one subject is a known place of every other, and the surface, the CT
volume and the waypoints of a subject are all φ of the same canonical thing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from zlib import crc32

import numpy as np
from scipy.interpolate import CubicSpline, RegularGridInterpolator
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from study.deform import Affine, Bumps, Deformation, Ramp, Roll, breathing, rib_bending
from study.errors import StudyError
from study.types import CARTILAGES, Floats, Ints, Part, PointCloud, Waypoints

SUBJECTS = ("ct1", "ct2", "ct3", "ct4", "ct5", "patient")

# Label ids of the volumes, those of the open CT's masks.
STERNUM_ID, CARTILAGE_ID = 116, 118
LEFT_RIB_ID, RIGHT_RIB_ID = 91, 103  # plus the level

# Published sizes, mean and SD in mm: (female, male), and both together.
MANUBRIUM_MM = ((46.7, 5.1), (51.2, 6.0))
BODY_MM = ((86.6, 9.7), (102.4, 13.3))
CARTILAGE_MM = {4: (55.8, 9.8), 5: (70.0, 10.8)}
STERNAL_ANGLE_DEG = 163.0

# The canonical course of the right side's cartilages and ribs on the flat wall, x and z in mm, z = 0 at the sternal
# angle; the cartilage takes the first `length` mm from the edge of the sternum, bone follows.
_COURSES: Mapping[int, tuple[float, tuple[tuple[float, float], ...]]] = {
    1: (30.0, ((20, 34), (34, 38), (48, 43), (64, 50), (78, 58))),
    2: (40.0, ((14, 0), (32, 1), (56, 4), (82, 12), (108, 24), (128, 36))),
    3: (47.0, ((14, -29), (36, -31), (62, -32), (90, -26), (116, -14), (134, -3))),
    4: (56.0, ((14, -54), (34, -60), (56, -65), (74, -65), (102, -56), (136, -37))),
    5: (70.0, ((14, -75), (34, -84), (56, -97), (72, -104), (86, -103), (112, -92), (142, -72))),
    6: (92.0, ((12, -90), (26, -101), (44, -115), (66, -129), (84, -136), (98, -136), (122, -127), (146, -111))),
    7: (125.0, ((8, -98), (18, -112), (34, -130), (58, -150), (84, -165), (104, -170), (126, -163), (146, -150))),
    8: (40.0, ((68, -158), (82, -176), (98, -190), (116, -197), (140, -190))),
}
# Bridges between neighbours: the 5th and 6th meet well beside the sternum, the 8th ends on the 7th.
_BRIDGES = (((56, -97), (58, -124)), ((66, -129), (68, -157)))
_HALF_WIDTH_MM = {1: 8.0, 2: 7.5, 3: 7.2, 4: 7.2, 5: 7.2, 6: 6.2, 7: 6.0, 8: 5.5}
_HALF_THICKNESS_MM = 5.0
_RIB_HALF_MM = (6.5, 4.0)
_BRIDGE_HALF_MM = (5.0, 4.0)

# Sternum outline: half width over z, from the xiphoid's tip to the jugular notch.
_STERNUM_Z = (-128, -120, -108, -99, -92, -78, -62, -45, -28, -12, 0, 10, 22, 36, 45, 49)
_STERNUM_HALF_WIDTH = (3, 5.5, 7, 9.5, 14, 18.5, 19, 17.5, 16, 15, 17, 17.5, 20, 26, 24, 20)
_STERNUM_TOP, _STERNUM_BOTTOM, _BODY_BOTTOM = 49.0, -128.0, -95.0
_STERNUM_HALF_THICKNESS_MM = 6.0
_EDGE_RADIUS_MM = 3.0

_ROI_LOW = np.array([-150.0, -75.0, -175.0])  # canonical, mm; what a CT of the phantom must show
_ROI_HIGH = np.array([150.0, 30.0, 70.0])
_SURFACE_SPACING_MM = 1.25
_SAMPLE_MM = 0.25  # spacing of centreline samples: the surface ripples by less than 2 µm

_BONE, _CARTILAGE = 1, 2


@dataclass(frozen=True)
class Subject:
    """One synthetic person.

    Attributes:
        name: one of `SUBJECTS`.
        seed: the cohort's seed.
        phi: from the flat canonical wall to the subject's RAS+ frame, mm.
    """

    name: str
    seed: int
    phi: Deformation
    fat_mm: float
    calcification: float


@dataclass(frozen=True)
class PhantomCT:
    """A CT of a subject and its labels.

    Attributes:
        hu: (i, j, k) int16 Hounsfield units; i, j, k run to R, A, S.
        labels: (i, j, k) uint8, ids as in the open CT's masks: 116 sternum, 118 costal cartilages, 92-103 left and
            104-115 right ribs.
        affine: (4, 4), voxel index to RAS+ mm.
        spacing_mm: (3,) mm.
    """

    hu: np.ndarray
    labels: np.ndarray
    affine: Floats
    spacing_mm: Floats


# ---------------------------------------------------------------------------------------------- canonical anatomy


@dataclass(frozen=True)
class _Lines:
    """Samples of all centrelines on the flat wall, in one tree."""

    xz: Floats  # (n, 2) mm
    tangent: Floats  # (n, 2)
    arc: Floats  # (n,) mm from the sternum's edge
    half: Floats  # (n, 2) half width and half thickness, mm
    level: Ints  # (n,) 1-8, 0 for a bridge
    side: Ints  # (n,) +1 right, -1 left
    tissue: Ints  # (n,)
    tree: KDTree


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
def _lines() -> _Lines:
    rows: list[tuple[Floats, ...]] = []
    for level, (length, knots) in _COURSES.items():
        xz, tangent, arc = _course(knots)
        arc = arc - np.interp(_sternum_half_width(xz[:1, 1])[0], xz[:, 0], arc)  # 0 at the sternum's edge
        blend = np.clip((arc - length + 6) / 12, 0, 1)[:, None]
        half = (1 - blend) * [_HALF_WIDTH_MM[level], _HALF_THICKNESS_MM] + blend * np.array(_RIB_HALF_MM)
        tissue = np.where(arc < length, _CARTILAGE, _BONE)
        rows.append((xz, tangent, arc, half, np.full(len(arc), level), tissue))
    for knots in _BRIDGES:
        xz, tangent, arc = _course(knots)
        half = np.broadcast_to(_BRIDGE_HALF_MM, xz.shape)
        rows.append((xz, tangent, arc, half, np.zeros(len(arc)), np.full(len(arc), _CARTILAGE)))
    xz, tangent, arc, half, level, tissue = (np.concatenate(column) for column in zip(*rows, strict=True))
    mirror = np.array([-1.0, 1.0])
    both = np.concatenate([xz, xz * mirror])
    return _Lines(
        xz=both,
        tangent=np.concatenate([tangent, tangent * mirror]),
        arc=np.tile(arc, 2),
        half=np.tile(half, (2, 1)),
        level=np.tile(level, 2).astype(np.int64),
        side=np.repeat([1, -1], len(arc)),
        tissue=np.tile(tissue, 2).astype(np.int64),
        tree=KDTree(both),
    )


@lru_cache(maxsize=1)
def _sternum_spline() -> CubicSpline:
    return CubicSpline(_STERNUM_Z, _STERNUM_HALF_WIDTH)


def _sternum_half_width(z: Floats) -> Floats:
    return _sternum_spline()(np.clip(z, _STERNUM_BOTTOM, _STERNUM_TOP))


@lru_cache(maxsize=1)
def _sternum_edge() -> KDTree:
    z = np.arange(_STERNUM_BOTTOM, _STERNUM_TOP, _SAMPLE_MM)
    side = np.column_stack([_sternum_half_width(z), z])
    ends = [
        np.column_stack([(x := np.arange(0, _sternum_half_width(np.array([end]))[0], _SAMPLE_MM)), np.full(len(x), end)])
        for end in (_STERNUM_BOTTOM, _STERNUM_TOP)
    ]
    return KDTree(np.concatenate([side, *ends]))


def _sternum_distance(points: Floats) -> Floats:
    """Signed distance (n,) mm to the sternum, a plate with rounded edges."""
    x, y, z = np.abs(points[:, 0]), np.abs(points[:, 1]), points[:, 2]
    inside = (x < _sternum_half_width(z)) & (z > _STERNUM_BOTTOM) & (z < _STERNUM_TOP)
    edge = _sternum_edge().query(np.column_stack([x, z]))[0] * np.where(inside, -1, 1) + _EDGE_RADIUS_MM
    face = y - _STERNUM_HALF_THICKNESS_MM + _EDGE_RADIUS_MM
    return np.minimum(np.maximum(edge, face), 0) + np.hypot(np.maximum(edge, 0), np.maximum(face, 0)) - _EDGE_RADIUS_MM


def _tube_distance(points: Floats) -> tuple[Floats, Ints]:
    """Signed distance (n,) mm to the nearest flattened tube, and the index (n,) of its nearest centreline sample."""
    lines = _lines()
    plane = points[:, [0, 2]]
    _, index = lines.tree.query(plane)
    offset = plane - lines.xz[index]
    along = np.abs(np.einsum("ni,ni->n", offset, lines.tangent[index]))
    across = np.sqrt(np.maximum(np.einsum("ni,ni->n", offset, offset) - along**2, 0))
    # Between two samples only the distance across counts; beyond the last one the end is round.
    across = np.where(along < _SAMPLE_MM, across, np.hypot(across, along))
    half_width, half_thickness = lines.half[index].T
    scaled = np.hypot(across / half_width, points[:, 1] / half_thickness)
    slope = np.hypot(across / half_width**2, points[:, 1] / half_thickness**2)
    # First-order distance to the ellipse, exact on it; at its very centre the slope vanishes.
    return scaled * (scaled - 1) / np.maximum(slope, 1e-6) + np.where(scaled < 1e-6, -half_thickness, 0), index


def _distance(points: Floats) -> Floats:
    """Signed distance (n,) mm to sternum, cartilages and ribs together; canonical points."""
    return np.minimum(_sternum_distance(points), _tube_distance(points)[0])


def _gradient(points: Floats) -> Floats:
    step = 0.02
    rows = [(_distance(points + offset) - _distance(points - offset)) / (2 * step) for offset in step * np.eye(3)]
    return np.stack(rows, axis=-1)


def _on_surface(points: Floats) -> Floats:
    """Move canonical points near the surface onto it."""
    points = points.copy()
    for _ in range(4):
        slope = _gradient(points)
        points -= (_distance(points) / np.maximum(np.einsum("ni,ni->n", slope, slope), 0.25))[:, None] * slope
    return points


def _span_z() -> tuple[float, float]:
    """Canonical heights of the sternum's cut, from the lower edge of the 5th cartilage to the upper of the 2nd."""
    (_, fifth), (_, second) = _COURSES[5], _COURSES[2]
    return fifth[0][1] - _HALF_WIDTH_MM[5], second[0][1] + _HALF_WIDTH_MM[2]


def _parts(points: Floats) -> Ints:
    """Part (n,) of canonical points; UNKNOWN for bone beyond the junction, other levels, bridges, uncut sternum."""
    lines = _lines()
    tube, index = _tube_distance(points)
    level, side = lines.level[index], lines.side[index]
    wanted = (level >= 2) & (level <= 5) & (lines.tissue[index] == _CARTILAGE)
    cartilage = np.where(wanted, level - 1 + np.where(side > 0, 0, 4), int(Part.UNKNOWN))
    low, high = _span_z()
    span = (points[:, 2] >= low) & (points[:, 2] <= high)
    return np.where(_sternum_distance(points) <= tube, np.where(span, int(Part.STERNUM), int(Part.UNKNOWN)), cartilage)


@dataclass(frozen=True)
class _Surface:
    vertices: Floats  # (v, 3) canonical, mm
    faces: Ints  # (f, 3)
    normals: Floats  # (f, 3) outward
    parts: Ints  # (f,)


@lru_cache(maxsize=1)
def _surface() -> _Surface:
    """The canonical surface of sternum (cut to levels 2-5) and cartilages 2-5 up to the junction with bone."""
    low, high = np.array([-115.0, -9.0, -125.0]), np.array([115.0, 9.0, 30.0])
    axes = [np.arange(a, b, _SURFACE_SPACING_MM) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = _distance(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(_SURFACE_SPACING_MM,) * 3)
    vertices = _on_surface(vertices + low)
    middle = vertices[faces].mean(axis=1)
    parts = _parts(middle)
    keep = parts != Part.UNKNOWN
    normals = _gradient(middle[keep])
    return _Surface(vertices, faces[keep].astype(np.int64), normals, parts[keep])


# ------------------------------------------------------------------------------------------------------- subjects


def draw_subject(name: str, seed: int) -> Subject:
    """Draw a subject of the cohort; the same ``name`` and ``seed`` give the same person.

    Lengths of manubrium, body and the 4th and 5th cartilage are drawn from the published means and SDs.

    Raises:
        StudyError: a name that is not in `SUBJECTS`.
    """
    if name not in SUBJECTS:
        raise StudyError(f"expected a phantom subject of {', '.join(SUBJECTS)}, got {name!r}")
    rng = np.random.default_rng([seed, crc32(name.encode())])

    def normal(mean: float, sd: float) -> float:
        return mean + sd * float(np.clip(rng.normal(), -1.8, 1.8))

    sex = int(rng.integers(2))
    body = normal(*BODY_MM[sex]) / -_BODY_BOTTOM
    manubrium = normal(*MANUBRIUM_MM[sex]) / _STERNUM_TOP
    width = normal(0.96 + 0.08 * sex, 0.06)
    length4, length5 = (normal(*CARTILAGE_MM[level]) / _COURSES[level][0] for level in (4, 5))
    steps = (
        *_flat_stretch(manubrium, body, width, 0.5 * (length4 + length5), length5 - length4, rng),
        *rib_bending(np.array([0.0, 0.0, -40.0]), np.array([2.0, -31.0, -62.0, -98.0]), 2.2, 14.0, rng),
        Roll(normal(125.0, 8.0), normal(2.0e-3, 4e-4)),
        # The manubrium leans back by what the sternal angle lacks to 180 degrees.
        Ramp(1, 2, -float(np.tan(np.radians(180 - normal(STERNAL_ANGLE_DEG, 5.0)))), 0.0, 3.0),
        _bend(normal(0.0, 3.0), normal(0.0, 3.0)),
        # The sternum's lower end lies farther forward; the rest is how the person lies on the table.
        Affine.motion(np.array([normal(18.0, 3.0), 0.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, -40.0])),
        *breathing(np.array([0.0, 0.0, -45.0]), rng),
        Affine.motion(rng.normal(scale=2.0, size=3), rng.normal(scale=10.0, size=3), np.array([0.0, 0.0, -40.0])),
    )
    return Subject(name, seed, Deformation(steps), normal(10.0, 2.5), normal(0.0, 1.0))


def _flat_stretch(
    manubrium: float, body: float, width: float, length: float, excess_5: float, rng: np.random.Generator
) -> tuple[Affine | Ramp | Bumps, ...]:
    """Stretch of the flat wall: sternum by part, then cartilages by side and level."""
    edge = 18.0 * width
    sides = length / width * (1 + 0.02 * np.clip(rng.normal(size=2), -2, 2)) - 1
    # The lower cartilages share `length`; the 5th differs from the 4th and the upper two by bands across the wall.
    heights = np.array([3.0 * rng.normal(), 3.0 * rng.normal(), 0, 30.0 * excess_5]).clip(-6, 6)
    levels_z = body * np.array([2.0, -31.0, -62.0, -100.0])
    centres = np.column_stack([np.full(8, 75.0), np.zeros(8), np.tile(levels_z, 2)])
    centres[4:, 0] *= -1
    widths = np.tile([22.0, np.inf, 14.0], (8, 1))
    return (
        Affine.stretch(np.array([width, normal_thickness(rng), body]), np.zeros(3)),
        Ramp(2, 2, manubrium / body - 1, 0.0, 4.0),
        Ramp(0, 0, sides[0], edge, 4.0),
        Ramp(0, 0, -sides[1], -edge, 4.0, direction=-1),
        *(
            Bumps(0, centres[k : k + 1], widths[k : k + 1], np.array([heights[k % 4] * (1 if k < 4 else -1)]))
            for k in range(8)
        ),
    )


def normal_thickness(rng: np.random.Generator) -> float:
    """Stretch of the wall's thickness."""
    return 1 + 0.06 * float(np.clip(rng.normal(), -1.8, 1.8))


def _bend(sternum_mm: float, bulge_mm: float) -> Bumps:
    """Bow the sternum's body, and the front across."""
    return Bumps(
        1,
        np.array([[0, 0, -45.0], [0, 0, 0]]),
        np.array([[np.inf, np.inf, 35.0], [45.0, np.inf, np.inf]]),
        np.array([sternum_mm, bulge_mm]),
    )


# ---------------------------------------------------------------------------------------------------------- truth


def truth_map(source: Subject, target: Subject, points: Floats) -> Floats:
    """Where (n, 3) mm places of one subject are in another: φ_target ∘ φ_source⁻¹, exact."""
    return target.phi.apply(source.phi.inverse(points))


def waypoints(subject: Subject) -> Waypoints:
    """The 20 waypoints: midpoints of corresponding places on neighbouring cartilages (sec. IV-B), 3, 3, 4 a side.

    Each cartilage is cut into equal parts; the midpoint of the parts' middles is a canonical place in the intercostal
    space and φ takes it to the subject, so row i is the same place in every subject.
    """
    lines = _lines()
    points, labels = [], []
    for side, name in ((1, "R"), (-1, "L")):
        for upper, count in ((2, 3), (3, 3), (4, 4)):
            middles = []
            for level in (upper, upper + 1):
                mine = (lines.level == level) & (lines.side == side)
                wanted = (np.arange(count) + 0.5) / count * _COURSES[level][0]
                middles.append(lines.xz[mine][np.searchsorted(lines.arc[mine], wanted)])
            x, z = np.mean(middles, axis=0).T
            points.append(np.column_stack([x, np.zeros(count), z]))
            labels += [f"{name}{upper}-{upper + 1}.{k + 1}" for k in range(count)]
    return Waypoints(subject.phi.apply(np.concatenate(points)), tuple(labels))


def reference_cloud(subject: Subject, n: int, rng: np.random.Generator) -> PointCloud:
    """``n`` points, uniform by area, of the whole surface of cut sternum and cartilages 2-5, with parts; mm, RAS+."""
    points, parts, _ = _sample(subject, n, rng, None)
    return PointCloud(subject.phi.apply(points), f"phantom:{subject.name}", parts)


def anterior_cloud(
    subject: Subject, n: int, noise_mm: float, n_missing_strips: int, rng: np.random.Generator
) -> PointCloud:
    """``n`` points of the surface that a probe on the skin sees, with noise and without some strips; mm, RAS+.

    A strip is missing across the sweep: 4-8 mm wide and straight on the chest wall, 30-60 mm long.

    Args:
        subject: whose surface.
        n: number of points.
        noise_mm: standard deviation of isotropic noise per axis.
        n_missing_strips: how many strips are missing.
    """
    middles = _surface().vertices[_surface().faces].mean(axis=1)
    visible = _surface().normals[:, 1] > 0.35 * np.linalg.norm(_surface().normals, axis=1)
    for _ in range(n_missing_strips):
        middle = middles[rng.integers(len(middles)), [0, 2]]
        angle, half_width, half_length = rng.uniform([0, 2, 15], [np.pi, 4, 30])
        along = np.array([np.cos(angle), np.sin(angle)])
        offset = middles[:, [0, 2]] - middle
        strip = (np.abs(offset @ along) < half_length) & (np.abs(offset @ [-along[1], along[0]]) < half_width)
        visible &= ~strip
    points, parts, _ = _sample(subject, n, rng, visible)
    points = subject.phi.apply(points)
    return PointCloud(points + rng.normal(scale=noise_mm, size=points.shape), f"phantom-us:{subject.name}", parts)


def _sample(subject: Subject, n: int, rng: np.random.Generator, keep: np.ndarray | None) -> tuple[Floats, Ints, Ints]:
    """Canonical surface points (n, 3), uniform by the subject's own area, their parts and faces."""
    surface = _surface()
    corners = subject.phi.apply(surface.vertices)[surface.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if keep is not None:
        area = np.where(keep, area, 0.0)
    # Evenly spread draws over the faces' cumulated area give fewer clumps than independent ones.
    cumulated = np.cumsum(area)
    face = np.searchsorted(cumulated, (np.arange(n) + rng.random(n)) / n * cumulated[-1], side="right")
    weights = rng.dirichlet(np.ones(3), size=n)
    points = np.einsum("nk,nki->ni", weights, surface.vertices[surface.faces[face]])
    return _on_surface(points), surface.parts[face], face
