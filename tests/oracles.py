"""Literal, slow, obviously right counterparts of the package's fast code, and small planted shapes."""

from __future__ import annotations

import numpy as np

from study.types import CARTILAGES, Floats, Part, PointCloud


def hausdorff_literal(a: Floats, b: Floats) -> float:
    """Eq. 5 as it is written, every pair of points at once."""
    distances = np.linalg.norm(a[:, None] - b[None], axis=2)
    return float(max(distances.min(axis=1).max(), distances.min(axis=0).max()))


def centreline(part: Part, t: Floats) -> Floats:
    """Middle of a toy cartilage at t in [0, 1], medial to lateral, (n, 3) mm RAS+."""
    side = 1.0 if part.side == "right" else -1.0
    length = {2: 45.0, 3: 55.0, 4: 65.0, 5: 80.0}[part.level]
    top = {2: 60.0, 3: 25.0, 4: -5.0, 5: -30.0}[part.level]
    sag = {2: 0.0, 3: 6.0, 4: 22.0, 5: 34.0}[part.level]
    # Down first, up again at the lateral end; the chest falls back sideways.
    return np.column_stack([side * (20 + length * t), -(20 * t**2), top - 4 * sag * t * (1 - 0.6 * t)])


def toy_chest(rng: np.random.Generator, n: int = 4000, *, anterior: bool = False) -> PointCloud:
    """A plate with eight bent tubes, labelled; ``anterior`` keeps the surface a probe in front would see.

    Row order is random in the parts' shares, so nothing may depend on it.
    """
    points, parts = [], []
    share = max(n // 10, 1)
    u, v = rng.uniform(-1, 1, (2, 2 * share))
    front = rng.random(2 * share) < 0.5
    depth = np.where(front | anterior, 5.0, -5.0)
    points.append(np.column_stack([20 * u, depth, 15 + 65 * v]))
    parts.append(np.full(2 * share, Part.STERNUM))
    for part in CARTILAGES:
        t = rng.random(share)
        angle = rng.uniform(0, np.pi if anterior else 2 * np.pi, share)
        ring = np.column_stack([np.zeros(share), 5 * np.sin(angle), 7 * np.cos(angle)])
        points.append(centreline(part, t) + ring)
        parts.append(np.full(share, part))
    order = rng.permutation(10 * share)
    return PointCloud(np.vstack(points)[order], name="toy", parts=np.concatenate(parts)[order].astype(np.int64))


def bend(points: Floats, size: float = 1.0) -> Floats:
    """A smooth planted deformation of a chest: stretch, twist-free bend and a breath; ``size`` 1 is some 6 mm."""
    x, y, z = points.T
    return np.column_stack([
        x * (1 + 0.05 * size),
        y + size * (4 * np.cos(x / 60) - 2),
        z + size * (6 * np.sin(x / 50) + 0.04 * (z - 15)),
    ])
