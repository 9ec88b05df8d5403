"""The surface of the canonical wall that a study sees: cut sternum and cartilages 2-5, with their parts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from skimage.measure import marching_cubes

from study.phantom.wall import (
    CARTILAGE,
    COURSES,
    HALF_WIDTH_MM,
    centrelines,
    sternum_distance,
    tube_distance,
    wall_distance,
)
from study.types import Floats, Ints, Part

SURFACE_SPACING_MM = 1.75  # of the grid on which the triangles are made


@dataclass(frozen=True)
class Surface:
    """Triangles of the canonical surface.

    Attributes:
        vertices: (v, 3) mm, canonical.
        faces: (f, 3) rows of ``vertices``.
        normals: (f, 3) outwards, not of unit length.
        parts: (f,) int64 of `Part`.
    """

    vertices: Floats
    faces: Ints
    normals: Floats
    parts: Ints


@lru_cache(maxsize=1)
def canonical_surface() -> Surface:
    """The surface of the sternum (cut to levels 2-5) and of cartilages 2-5 up to the junction with bone.

    Made once a process, in seconds, and shared: do not write to it.
    """
    low, high = np.array([-115.0, -9.0, -125.0]), np.array([115.0, 9.0, 30.0])
    axes = [np.arange(a, b, SURFACE_SPACING_MM) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = wall_distance(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(SURFACE_SPACING_MM,) * 3)
    vertices = onto_surface(vertices + low)
    middle = vertices[faces].mean(axis=1)
    parts = _parts(middle)
    keep = parts != Part.UNKNOWN
    normals = _gradient(middle[keep])
    return Surface(vertices, faces[keep].astype(np.int64), normals, parts[keep])


def onto_surface(points: Floats) -> Floats:
    """Canonical points (n, 3) mm that lie near the surface, moved onto it."""
    points = points.copy()
    for _ in range(4):
        slope = _gradient(points)
        points -= (wall_distance(points) / np.maximum(np.einsum("ni,ni->n", slope, slope), 0.25))[:, None] * slope
    return points


def _gradient(points: Floats) -> Floats:
    """Gradient (n, 3) of `wall_distance` by central differences."""
    step = 0.02
    offsets = step * np.eye(3)
    rows = [(wall_distance(points + offset) - wall_distance(points - offset)) / (2 * step) for offset in offsets]
    return np.stack(rows, axis=-1)


def _parts(points: Floats) -> Ints:
    """Part (n,) of canonical points; UNKNOWN for bone beyond the junction, other levels, bridges, uncut sternum."""
    lines = centrelines()
    tube, index = tube_distance(points)
    level, side = lines.level[index], lines.side[index]
    wanted = (level >= 2) & (level <= 5) & (lines.tissue[index] == CARTILAGE)
    cartilage = np.where(wanted, level - 1 + np.where(side > 0, 0, 4), int(Part.UNKNOWN))
    low, high = _span_z()
    span = (points[:, 2] >= low) & (points[:, 2] <= high)
    return np.where(sternum_distance(points) <= tube, np.where(span, int(Part.STERNUM), int(Part.UNKNOWN)), cartilage)


def _span_z() -> tuple[float, float]:
    """Canonical heights of the sternum's cut, from the lower edge of the 5th cartilage to the upper of the 2nd."""
    (_, fifth), (_, second) = COURSES[5], COURSES[2]
    return fifth[0][1] - HALF_WIDTH_MM[5], second[0][1] + HALF_WIDTH_MM[2]
