"""Clouds sampled from a subject's own surface: all of it, or what a probe on the skin sees."""

from __future__ import annotations

import numpy as np

from study.phantom.subject import SyntheticSubject
from study.phantom.surface import canonical_surface, onto_surface
from study.types import Bools, Floats, Ints, PointCloud

MIN_FACING = 0.35  # cosine between a normal and the wall's front from which a probe sees the surface


def reference_cloud(subject: SyntheticSubject, n: int, rng: np.random.Generator) -> PointCloud:
    """``n`` points, uniform by area, of the whole surface of cut sternum and cartilages 2-5, with parts; mm, RAS+."""
    points, parts = _sample(subject, n, rng, None)
    return PointCloud(subject.phi.apply(points), f"phantom:{subject.name}", parts)


def anterior_cloud(
    subject: SyntheticSubject, n: int, noise_mm: float, n_missing_strips: int, rng: np.random.Generator
) -> PointCloud:
    """``n`` points of the surface that a probe on the skin sees, with noise and without some strips; mm, RAS+.

    A strip is missing across the sweep: 4-8 mm wide and straight on the chest wall, 30-60 mm long.

    Args:
        subject: whose surface.
        n: number of points.
        noise_mm: standard deviation of isotropic noise per axis.
        n_missing_strips: how many strips are missing.
        rng: draws the strips, the points and the noise.
    """
    points, parts = _sample(subject, n, rng, _seen_faces(n_missing_strips, rng))
    points = subject.phi.apply(points)
    return PointCloud(points + rng.normal(scale=noise_mm, size=points.shape), f"phantom-us:{subject.name}", parts)


def _seen_faces(n_missing_strips: int, rng: np.random.Generator) -> Bools:
    """Which faces (f,) of the canonical surface look to the front and lie in no missing strip."""
    surface = canonical_surface()
    middles = surface.vertices[surface.faces].mean(axis=1)
    visible: Bools = surface.normals[:, 1] > MIN_FACING * np.linalg.norm(surface.normals, axis=1)
    for _ in range(n_missing_strips):
        middle = middles[rng.integers(len(middles)), [0, 2]]
        angle, half_width, half_length = rng.uniform([0, 2, 15], [np.pi, 4, 30])
        along = np.array([np.cos(angle), np.sin(angle)])
        offset = middles[:, [0, 2]] - middle
        strip = (np.abs(offset @ along) < half_length) & (np.abs(offset @ [-along[1], along[0]]) < half_width)
        visible &= ~strip
    return visible


def _sample(subject: SyntheticSubject, n: int, rng: np.random.Generator, keep: Bools | None) -> tuple[Floats, Ints]:
    """Canonical surface points (n, 3), uniform by the subject's own area, and their parts."""
    surface = canonical_surface()
    corners = subject.phi.apply(surface.vertices)[surface.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if keep is not None:
        area = np.where(keep, area, 0.0)
    # Evenly spread draws over the faces' cumulated area give fewer clumps than independent ones.
    cumulated = np.cumsum(area)
    face = np.searchsorted(cumulated, (np.arange(n) + rng.random(n)) / n * cumulated[-1], side="right")
    weights = rng.dirichlet(np.ones(3), size=n)
    points = np.einsum("nk,nki->ni", weights, surface.vertices[surface.faces[face]])
    return onto_surface(points), surface.parts[face]
