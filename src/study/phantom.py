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
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from study.deform import Affine, Bumps, Deformation, Ramp, Roll, breathing, rib_bending
from study.errors import StudyError
from study.types import Bools, Floats, Ints, Part, PointCloud, RigidTransform, Volume, Waypoints

SUBJECTS = ("ct1", "ct2", "ct3", "ct4", "ct5", "patient")

# Label ids of the volumes, those of TotalSegmentator 2.
STERNUM_ID, CARTILAGE_ID = 116, 117
LEFT_RIB_ID, RIGHT_RIB_ID = 91, 103  # plus the level

# Published sizes, mean and SD in mm: (female, male), and both together.
MANUBRIUM_MM = ((46.7, 5.1), (51.2, 6.0))
BODY_MM = ((86.6, 9.7), (102.4, 13.3))
CARTILAGE_MM = {4: (55.8, 9.8), 5: (70.0, 10.8)}
STERNAL_ANGLE_DEG = 163.0
# What no publication gives, measured on the four people of the open cohort (results/anatomy.csv, mean and population SD
# over people of the mean of both sides).
MEASURED_LENGTH_MM = {2: (40.1, 7.0), 3: (47.2, 3.8)}
MEASURED_WIDTH_MM = {2: 10.6, 3: 11.7, 4: 12.0, 5: 12.3}
MEASURED_THICKNESS_MM = (8.6, 1.15)  # of all eight cartilages
MEASURED_STERNUM_MM = ((24.0, 2.2), 10.7)  # width and its SD, thickness
MEASURED_HU = (101.7, 5.0)
# Curvature across the front, 1/m: the upper part of the -0.8 to 6.3 measured. Whether the flattest are seen from the
# front or from behind, nothing in a cloud could tell.
WALL_PER_M = (4.3, 1.5)
MAX_SD = 1.3  # draws are cut there: different people, no outliers

# The canonical course of the right side's cartilages and ribs on the flat wall, x and z in mm, z = 0 at the sternal
# angle; the cartilage takes the first `length` mm from the edge of the sternum, bone follows.
_COURSES: Mapping[int, tuple[float, tuple[tuple[float, float], ...]]] = {
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
_HALF_WIDTH_MM = {1: 7.0, **{level: width / 2 for level, width in MEASURED_WIDTH_MM.items()}, 6: 6.0, 7: 6.0, 8: 5.5}
_HALF_THICKNESS_MM = MEASURED_THICKNESS_MM[0] / 2
_RIB_HALF_MM = (6.5, 4.0)
_BRIDGE_HALF_MM = (5.0, 4.0)

# Sternum outline: half width over z, from the xiphoid's tip to the jugular notch.
_STERNUM_Z = (-128, -120, -108, -99, -92, -78, -62, -45, -28, -12, 0, 10, 22, 36, 45, 49)
_STERNUM_HALF_WIDTH = (3, 5.5, 7, 8, 10.5, 13, 13.5, 13, 12, 11.5, 12, 13.5, 17, 24, 23, 19)
_STERNUM_TOP, _STERNUM_BOTTOM, _BODY_BOTTOM = 49.0, -128.0, -95.0
_STERNUM_HALF_THICKNESS_MM = MEASURED_STERNUM_MM[1] / 2
_EDGE_RADIUS_MM = 3.0

# Canonical, mm: the deformations must be invertible in all of ROI, and a CT shows all of VIEW.
ROI_LOW, ROI_HIGH = (-150.0, -75.0, -175.0), (150.0, 30.0, 75.0)
_VIEW_LOW, _VIEW_HIGH = (-118.0, -18.0, -158.0), (118.0, 24.0, 58.0)
_SURFACE_SPACING_MM = 1.75
_SAMPLE_MM = 0.25  # spacing of centreline samples: the surface ripples by less than 2 µm

_LATTICE_MM = 6.0
NOISE_HU = 12.0

_BONE, _CARTILAGE = 1, 2


@dataclass(frozen=True)
class Subject:
    """One synthetic person.

    Attributes:
        name: one of `SUBJECTS`.
        seed: the cohort's seed.
        phi: from the flat canonical wall to the subject's RAS+ frame, mm.
        fat_mm: thickness of the fat under the skin.
        cartilage_hu: mean of the cartilage; it calcifies with age.
    """

    name: str
    seed: int
    phi: Deformation
    fat_mm: float
    cartilage_hu: float


# ---------------------------------------------------------------------------------------------- canonical anatomy


@dataclass(frozen=True)
class _Lines:
    """Samples of all centrelines on the flat wall."""

    xz: Floats  # (n, 2) mm
    tangent: Floats  # (n, 2)
    arc: Floats  # (n,) mm from the sternum's edge
    half: Floats  # (n, 2) half width and half thickness, mm
    level: Ints  # (n,) 1-8, 0 for a bridge
    side: Ints  # (n,) +1 right, -1 left
    tissue: Ints  # (n,)
    trees: tuple[tuple[int, KDTree], ...]  # first row and tree of the ribs, then of the bridges between them


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
    xz, tangent, arc, half, levels, tissue = (np.concatenate(column) for column in zip(*rows, strict=True))
    mirror = np.array([-1.0, 1.0])
    both = np.concatenate([xz, xz * mirror])
    order = np.argsort(np.tile(levels, 2) == 0, kind="stable")  # ribs, then bridges
    n_ribs = int(2 * np.count_nonzero(levels))
    return _Lines(
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


def _sternum_half_width(z: Floats) -> Floats:
    return _sternum_spline()(np.clip(z, _STERNUM_BOTTOM, _STERNUM_TOP))


@lru_cache(maxsize=1)
def _sternum_edge() -> KDTree:
    z = np.arange(_STERNUM_BOTTOM, _STERNUM_TOP, _SAMPLE_MM)
    edge = [np.column_stack([_sternum_half_width(z), z])]
    for end in (_STERNUM_BOTTOM, _STERNUM_TOP):
        x = np.arange(0, _sternum_half_width(np.array([end]))[0], _SAMPLE_MM)
        edge.append(np.column_stack([x, np.full(len(x), end)]))
    return KDTree(np.concatenate(edge))


def _sternum_distance(points: Floats) -> Floats:
    """Signed distance (n,) mm to the sternum, a plate with rounded edges."""
    x, y, z = np.abs(points[:, 0]), np.abs(points[:, 1]), points[:, 2]
    inside = (x < _sternum_half_width(z)) & (z > _STERNUM_BOTTOM) & (z < _STERNUM_TOP)
    edge = _sternum_edge().query(np.column_stack([x, z]))[0] * np.where(inside, -1, 1) + _EDGE_RADIUS_MM
    face = y - _STERNUM_HALF_THICKNESS_MM + _EDGE_RADIUS_MM
    return np.minimum(np.maximum(edge, face), 0) + np.hypot(np.maximum(edge, 0), np.maximum(face, 0)) - _EDGE_RADIUS_MM


def _tube_distance(points: Floats) -> tuple[Floats, Ints]:
    """Signed distance (n,) mm to the nearest flattened tube, and the index (n,) of its nearest centreline sample."""
    plane = points[:, [0, 2]]
    ribs, bridges = (first + tree.query(plane)[1] for first, tree in _lines().trees)
    to_rib, to_bridge = _ellipse_distance(points, ribs), _ellipse_distance(points, bridges)
    is_rib = to_rib <= to_bridge
    return np.where(is_rib, to_rib, to_bridge), np.where(is_rib, ribs, bridges)


def _ellipse_distance(points: Floats, index: Ints) -> Floats:
    """Signed distance (n,) mm to the tube around the centreline sample ``index`` (n,); exact on the surface."""
    lines = _lines()
    offset = points[:, [0, 2]] - lines.xz[index]
    along = np.abs(np.einsum("ni,ni->n", offset, lines.tangent[index]))
    across = np.sqrt(np.maximum(np.einsum("ni,ni->n", offset, offset) - along**2, 0))
    # Between two samples only the distance across counts; beyond the last one the end is round.
    across = np.where(along < _SAMPLE_MM, across, np.hypot(across, along))
    half_width, half_thickness = lines.half[index].T
    scaled = np.hypot(across / half_width, points[:, 1] / half_thickness)
    slope = np.hypot(across / half_width**2, points[:, 1] / half_thickness**2)
    # First-order distance to the ellipse; at its very centre the slope vanishes.
    return scaled * (scaled - 1) / np.maximum(slope, 1e-6) + np.where(scaled < 1e-6, -half_thickness, 0)


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

    Lengths of manubrium, body and the 4th and 5th cartilage are drawn from published means and SDs; lengths of the 2nd
    and 3rd, thickness, the sternum's width and the cartilage's density from those measured on the open cohort; all cut
    at 1.3 SD, the wall's curvature from the upper part of the measured range.

    Raises:
        StudyError: a name that is not in `SUBJECTS`.
    """
    if name not in SUBJECTS:
        raise StudyError(f"expected a phantom subject of {', '.join(SUBJECTS)}, got {name!r}")
    rng = np.random.default_rng([seed, crc32(name.encode())])

    def normal(mean: float, sd: float) -> float:
        return mean + sd * float(np.clip(rng.normal(), -MAX_SD, MAX_SD))

    sex = int(rng.integers(2))
    lean_deg = 180 - normal(STERNAL_ANGLE_DEG, 4.0)
    middle = np.array([0.0, 0.0, -40.0])
    steps = (
        *_flat_stretch(
            manubrium=normal(*MANUBRIUM_MM[sex]) / _STERNUM_TOP * np.cos(np.radians(lean_deg)),
            body=normal(*BODY_MM[sex]) / -_BODY_BOTTOM,
            width=normal(1.0, MEASURED_STERNUM_MM[0][1] / MEASURED_STERNUM_MM[0][0]),
            thickness=normal(1.0, MEASURED_THICKNESS_MM[1] / MEASURED_THICKNESS_MM[0]),
            rng=rng,
        ),
        *rib_bending(middle, np.array([2.0, -29.0, -60.0, -97.0]), 2.2, 14.0, rng),
        Roll(1000.0 / normal(*WALL_PER_M), normal(2.0e-3, 4e-4)),
        # The manubrium leans back by what the sternal angle lacks to 180 degrees.
        Ramp(1, 2, -float(np.tan(np.radians(lean_deg))), 0.0, 3.0),
        _bend(normal(0.0, 3.0), normal(1.5, 2.5)),
        # The sternum's lower end lies farther forward; the last motion is how the person lies on the table.
        Affine.motion(np.array([normal(14.0, 3.0), 0.0, 0.0]), np.zeros(3), middle),
        *breathing(middle, rng),
        Affine.motion(rng.normal(scale=2.0, size=3), rng.normal(scale=10.0, size=3), middle),
    )
    return Subject(name, seed, Deformation(steps), fat_mm=normal(10.0, 2.5), cartilage_hu=normal(*MEASURED_HU))


def _flat_stretch(
    manubrium: float, body: float, width: float, thickness: float, rng: np.random.Generator
) -> tuple[Affine | Ramp | Bumps, ...]:
    """Stretch of the flat wall: sternum by part, then cartilages by side and level; factors of the canonical size."""
    # The cartilages of one person go together (correlation 0.8), the sides nearly so.
    z4 = float(np.clip(rng.normal(), -MAX_SD, MAX_SD))
    lengths = []
    for level, (mean, sd) in sorted((MEASURED_LENGTH_MM | CARTILAGE_MM).items()):
        own = 0.8 * z4 + 0.6 * float(np.clip(rng.normal(), -MAX_SD, MAX_SD))
        lengths.append(mean + sd * float(np.clip(z4 if level == 4 else own, -MAX_SD, MAX_SD)))
    canonical = np.array([_COURSES[level][0] for level in (2, 3, 4, 5)])
    common = float((lengths / canonical).mean())
    sides = common / width * (1 + 0.02 * np.clip(rng.normal(size=2), -MAX_SD, MAX_SD)) - 1
    edge = 13.5 * width
    # What is left of each level's own length is a push along it, centred where its cartilage ends.
    push = lengths - canonical * common
    ends = edge + common * canonical * 0.95
    heights_z = body * np.array([3.0, -29.0, -60.0, -98.0])
    pushes = [
        Bumps.one(0, (side * x, 0, z), (20.0, np.inf, 13.0), side * np.clip(h, -8, 8))
        for side in (1, -1)
        for x, z, h in zip(ends, heights_z, push, strict=True)
    ]
    return (
        Affine.stretch(np.array([width, thickness, body]), np.zeros(3)),
        Ramp(2, 2, manubrium / body - 1, 0.0, 4.0),
        Ramp(0, 0, sides[0], edge, 4.0),
        Ramp(0, 0, -sides[1], -edge, 4.0, direction=-1),
        *pushes,
    )


def _bend(sternum_mm: float, bulge_mm: float) -> Bumps:
    """Bow the sternum's body, and the front across."""
    return Bumps(
        1,
        np.array([[0, 0, -45.0], [0, 0, 0.0]]),
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
    points, parts = _sample(subject, n, rng, None)
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
    points, parts = _sample(subject, n, rng, visible)
    points = subject.phi.apply(points)
    return PointCloud(points + rng.normal(scale=noise_mm, size=points.shape), f"phantom-us:{subject.name}", parts)


def _sample(subject: Subject, n: int, rng: np.random.Generator, keep: Bools | None) -> tuple[Floats, Ints]:
    """Canonical surface points (n, 3), uniform by the subject's own area, and their parts."""
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
    return _on_surface(points), surface.parts[face]


def measures(subject: Subject) -> dict[str, float]:
    """Sizes of a subject as an anatomist measures them.

    Returns:
        ``manubrium_mm``, ``body_mm``, ``sternum_width_mm`` (at levels 3-4), ``sternal_angle_deg``, and
        ``cartilage_<side>_<level>_mm`` along the middle of the cartilage from sternum to bone.
    """

    def length(canonical: Floats) -> float:
        return float(np.linalg.norm(np.diff(subject.phi.apply(canonical), axis=0), axis=1).sum())

    def midline(*z: float) -> Floats:
        return np.column_stack([np.zeros(len(z)), np.zeros(len(z)), z])

    half = float(_sternum_half_width(np.array([-45.0]))[0])
    top, upper, lower, bottom = subject.phi.apply(midline(45.0, 8.0, -8.0, -85.0))
    lean = (top - upper) / np.linalg.norm(top - upper) @ ((bottom - lower) / np.linalg.norm(bottom - lower))
    sizes = {
        "manubrium_mm": length(midline(*np.linspace(0, _STERNUM_TOP, 50))),
        "body_mm": length(midline(*np.linspace(_BODY_BOTTOM, 0, 50))),
        "sternum_width_mm": length(np.array([[-half, 0, -45.0], [half, 0, -45.0]])),
        "sternal_angle_deg": float(np.degrees(np.arccos(lean))),
    }
    lines = _lines()
    for side, sign in (("right", 1), ("left", -1)):
        for level in (2, 3, 4, 5):
            mine = (lines.level == level) & (lines.side == sign) & (lines.arc >= 0) & (lines.tissue == _CARTILAGE)
            x, z = lines.xz[mine].T
            sizes[f"cartilage_{side}_{level}_mm"] = length(np.column_stack([x, np.zeros(len(x)), z]))
    return sizes


# ------------------------------------------------------------------------------------------------------------- CT


def ct_volume(subject: Subject, spacing_mm: float, rng: np.random.Generator) -> tuple[Volume, Volume]:
    """A CT of the front of the chest and its labels, both on the same isotropic grid along R, A, S.

    Voxel centres are taken back to the canonical wall by φ⁻¹; a voxel that a surface cuts gets the mixture of both
    sides. Only voxels near bone or cartilage are taken back one by one: elsewhere a coarse lattice is interpolated,
    which moves the skin and the lungs by less than 0.1 mm.

    Args:
        subject: who.
        spacing_mm: about 1.5; 2.5 for a quick look.
        rng: the scanner's noise.

    Returns:
        int16 Hounsfield units, and uint8 labels with the ids of TotalSegmentator 2: 116 sternum, 117 costal
        cartilages (all of them), 92-103 left ribs 1-12, 104-115 right ribs 1-12.

    Raises:
        StudyError: a spacing that cannot show a cartilage.
    """
    if not 0.5 <= spacing_mm <= 4.0:
        raise StudyError(f"expected a spacing of 0.5-4 mm, got {spacing_mm:g}; a cartilage is only 10 mm thick")
    box = np.stack(np.meshgrid(*np.linspace(_VIEW_LOW, _VIEW_HIGH, 7).T, indexing="ij"), axis=-1).reshape(-1, 3)
    box = subject.phi.apply(box)
    origin = np.floor(box.min(axis=0))
    shape = tuple(int(n) for n in np.ceil((box.max(axis=0) - origin) / spacing_mm) + 1)
    canonical = _canonical_coordinates(subject, origin, shape, spacing_mm)

    x, y, z = canonical
    hu = _soft_tissue_hu(x, y, z, subject.fat_mm, spacing_mm)
    labels = np.zeros(shape, dtype=np.uint8)
    near = np.argwhere(np.abs(y) < _STERNUM_HALF_THICKNESS_MM + 3)
    approximate = canonical[:, near[:, 0], near[:, 1], near[:, 2]].T
    near = near[_distance(approximate) < 1.5 + spacing_mm]
    exact = subject.phi.inverse(origin + spacing_mm * near)
    i, j, k = near.T
    hard, share, ids = _hard_tissue(exact, subject.cartilage_hu, spacing_mm)
    hu[i, j, k] += share * (hard - hu[i, j, k])
    labels[i, j, k] = ids

    noise = gaussian_filter(rng.standard_normal(shape, dtype=np.float32), 0.6)  # a scanner's noise is not white
    hu += (NOISE_HU / noise.std()) * noise
    grid = RigidTransform(translation=origin)
    spacing = np.full(3, float(spacing_mm))
    return (
        Volume(np.clip(np.round(hu), -1024, 3071).astype(np.int16), spacing, grid, f"phantom:{subject.name}"),
        Volume(labels, spacing, grid, f"labels of phantom:{subject.name}"),
    )


def _canonical_coordinates(subject: Subject, origin: Floats, shape: tuple[int, ...], spacing_mm: float) -> Floats:
    """Approximate φ⁻¹ (3, i, j, k) of all voxel centres, from a lattice of 6 mm."""
    step = _LATTICE_MM / spacing_mm
    counts = [int(np.ceil((n - 1) / step)) + 1 for n in shape]
    lattice = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    values = subject.phi.inverse(origin + _LATTICE_MM * lattice).reshape(*counts, 3)
    for axis, n in enumerate(shape):
        place = np.arange(n) / step
        below = np.minimum(place.astype(int), counts[axis] - 2)
        weight = (place - below).reshape([-1 if a == axis else 1 for a in range(4)])
        values = np.take(values, below, axis) * (1 - weight) + np.take(values, below + 1, axis) * weight
    return np.moveaxis(values, -1, 0)


def _soft_tissue_hu(x: Floats, y: Floats, z: Floats, fat_mm: float, spacing_mm: float) -> Floats:
    """Hounsfield units of air, skin, fat, muscle, lung and what lies between and below the lungs."""

    def beyond(distance: Floats) -> Floats:
        return np.clip(distance / spacing_mm + 0.5, 0, 1)

    muscle = 6.5 + 5 * (1 - np.exp(-((x / 25) ** 2)))  # next to none in front of the sternum
    skin = muscle + fat_mm
    dome = -95 - 0.004 * (np.abs(x) - 75) ** 2  # of the diaphragm
    # Behind the sternum the lungs leave room that widens with depth, more on the left, where the heart lies.
    straight, depth = x * (1 + y / 125), np.maximum(-y - 10, 0)
    heart = np.where(x < 0, 25 * np.clip((-20 - z) / 40, 0, 1), 0)
    lung = beyond(-y - 10) * beyond(z - dome) * beyond(np.abs(straight) - 12 - 0.4 * np.minimum(depth, 40) - heart)
    hu = np.full(x.shape, 50.0)
    hu += lung * (-850 - hu)
    for front, value in ((muscle, -100), (skin, 30), (skin + 2, -1000)):  # fat, skin, air
        hu += beyond(y - front) * (value - hu)
    return hu


def _hard_tissue(canonical: Floats, cartilage_hu: float, spacing_mm: float) -> tuple[Floats, Floats, Ints]:
    """Hounsfield units (n,) of bone or cartilage, its share (n,) of the voxel, and label ids (n,), 0 outside."""
    lines = _lines()
    sternum = _sternum_distance(canonical)
    tube, index = _tube_distance(canonical)
    distance = np.minimum(sternum, tube)
    is_sternum = sternum <= tube
    is_bone = is_sternum | (lines.tissue[index] == _BONE)
    cortex = np.clip((distance + 1.5) / spacing_mm + 0.5, 0, 1)  # the outer 1.5 mm of bone
    marrow = np.where(is_sternum, 110.0, 220.0)
    hu = np.where(is_bone, marrow + cortex * (550.0 - marrow), cartilage_hu)
    rib = lines.level[index] + np.where(lines.side[index] > 0, RIGHT_RIB_ID, LEFT_RIB_ID)
    ids = np.where(is_sternum, STERNUM_ID, np.where(is_bone, rib, CARTILAGE_ID))
    return hu, np.clip(0.5 - distance / spacing_mm, 0, 1), np.where(distance < 0, ids, 0)
