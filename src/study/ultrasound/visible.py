"""What ultrasound can see of a known surface, and the true part of each point of a cloud: truth to judge by."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from study.errors import StudyError
from study.geometry.points import nearest, unit
from study.geometry.rays import first_hits
from study.types import Floats, Ints, Mesh, PointCloud
from study.ultrasound.probe import Probe
from study.ultrasound.skin import Skin


def true_parts(points: Floats, mesh: Mesh) -> Ints:
    """The `Part` (n,) of the vertex of the true surface nearest to each point (n, 3) mm, both in one frame.

    For judging a cloud, never for making one.
    """
    return mesh.parts[nearest(points, mesh.vertices)[1]]


def visible_mesh(
    mesh: Mesh, front: ArrayLike, *, up: ArrayLike = (0.0, 0.0, 1.0), skin_mm: float | None = None, step_mm: float = 0.5
) -> Mesh:
    """The faces that a probe on the skin can see: those its beams, along the skin's normals, meet first.

    Args:
        mesh: the anatomy, mm.
        front: (3,) direction towards the skin, in the mesh's frame.
        up: (3,) direction towards the head.
        skin_mm: tissue in front of the bone; the default probe's when None.
        step_mm: distance between beams on the skin.

    Returns:
        A part of the surface, in its frame.

    Raises:
        StudyError: directions that are none, or a surface that is not seen at all.
    """
    skin = Skin(mesh, front, up, Probe.skin_mm if skin_mm is None else skin_mm)
    a, b = (np.arange(skin.low[i] - 40, skin.high[i] + 40, step_mm) for i in range(2))
    ab = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
    points, normals = skin.points(ab)
    distance, face = first_hits(mesh, points, -normals)
    kept = mesh.faces[np.unique(face[distance <= Probe.depth_mm])]
    if not len(kept):
        raise StudyError(f"{mesh.name}: expected a surface that is visible, got none; check the front direction")
    vertices, renumbered = np.unique(kept, return_inverse=True)
    return Mesh(mesh.vertices[vertices], renumbered.reshape(-1, 3), mesh.parts[vertices], name=f"{mesh.name} (visible)")


def visible_surface(mesh: Mesh, front: ArrayLike, spacing_mm: float, rng: np.random.Generator) -> PointCloud:
    """The points that parallel beams from the front meet first, evenly spread and free of error: a test fixture.

    Args:
        mesh: the anatomy, mm.
        front: (3,) direction towards the skin.
        spacing_mm: typical distance between neighbouring points.
        rng: draws the beams.

    Returns:
        A cloud in the mesh's frame, labelled with the true parts.

    Raises:
        StudyError: a direction that is none, or too few points in view.
    """
    if not spacing_mm > 0:
        raise StudyError(f"expected a spacing above 0 mm, got {spacing_mm!r}")
    beam = -unit(front, "front")
    candidates = _first_met(mesh, _draw_facing(mesh, beam, spacing_mm, rng), beam)
    # One candidate a cube, the first drawn, keeps the density even.
    cells = np.floor((candidates - candidates.min(axis=0)) / spacing_mm).astype(np.int64)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    points = candidates[first]
    return PointCloud(points, f"{mesh.name} (visible)", true_parts(points, mesh))


def _draw_facing(mesh: Mesh, beam: Floats, spacing_mm: float, rng: np.random.Generator) -> Floats:
    """Points (n, 3) mm on the faces turned towards the beam, about four to a square of ``spacing_mm``."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1) / 2
    # Points spread over the surface, not beams over the plane: beams would leave the sides of a tube bare.
    facing = np.flatnonzero(normals @ beam < 0)
    if not len(facing):
        raise StudyError(f"{mesh.name}: expected a surface that faces the front, got none; check the direction")
    n = round(4 * float(area[facing].sum()) / spacing_mm**2)
    chosen = rng.choice(facing, size=max(n, 1), p=area[facing] / area[facing].sum())
    u = np.sort(rng.random((len(chosen), 2)), axis=1)
    weights = np.column_stack([u[:, 0], u[:, 1] - u[:, 0], 1 - u[:, 1]])
    drawn: Floats = np.einsum("nk,nki->ni", weights, corners[chosen])
    return drawn


def _first_met(mesh: Mesh, candidates: Floats, beam: Floats) -> Floats:
    """Those of the points (n, 3) mm on a surface that nothing else hides from the beam."""
    back_off = 2 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    distance, _ = first_hits(mesh, candidates - back_off * beam, np.broadcast_to(beam, candidates.shape))
    candidates = candidates[np.abs(distance - back_off) < 1e-2]
    if not len(candidates):
        raise StudyError(f"{mesh.name}: expected a surface to be seen from the front, got none; check the direction")
    return candidates
