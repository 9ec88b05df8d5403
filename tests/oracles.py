"""Literal, slow, obviously right counterparts of the package's fast code, and small planted shapes."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from threadpoolctl import threadpool_limits

from study.pipeline import run_method
from study.registration import Method, Registration
from study.types import CARTILAGES, Floats, Part, PointCloud, RigidTransform


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
    return np.column_stack(
        [
            x * (1 + 0.05 * size),
            y + size * (4 * np.cos(x / 60) - 2),
            z + size * (6 * np.sin(x / 50) + 0.04 * (z - 15)),
        ]
    )


def contract_pair(n_source: int = 1500, n_target: int = 1200) -> tuple[PointCloud, PointCloud, Floats]:
    """A chest, the front of the same chest after a planted `bend`, and where each source point truly went."""
    rng = np.random.default_rng(7)
    source, target = toy_chest(rng, n_source), toy_chest(rng, n_target, anterior=True)
    return source, PointCloud(bend(target.points), "toy-us", target.parts), bend(source.points)


def check_contract(method: Method, *, identity_mm: float, pose_mm: float) -> None:
    """What every method promises: row pairing, repeatability, identity, equivariance, inputs left alone.

    Args:
        method: the method.
        identity_mm: mean distance that a cloud registered to itself may move.
        pose_mm: how far the result may change when both clouds are moved together.
    """
    source, target, _ = contract_pair()
    before = source.points.tobytes(), target.points.tobytes()

    def run(a: PointCloud, b: PointCloud, seed: int = 0) -> Registration:
        return run_method(method, a, b, np.random.default_rng(seed))

    first = run(source, target)
    assert not source.points.flags.writeable  # clouds are read-only: a write would have raised
    assert (source.points.tobytes(), target.points.tobytes()) == before
    assert first.source is source.points
    assert first.warped.shape == source.points.shape
    assert np.isfinite(first.warped).all()
    assert first.method == method.name
    assert first.n_iterations == len(first.history) > 0
    assert first.stop_reason
    assert first.seconds > 0

    # The same seed gives the same bytes, whatever the number of threads around it.
    for threads in (1, 2):
        with threadpool_limits(limits=threads):
            again = run(source, target)
        assert again.warped.tobytes() == first.warped.tobytes()
        assert again.history == first.history

    still = run(source, source)
    assert np.linalg.norm(still.warped - source.points, axis=1).mean() < identity_mm

    motion = RigidTransform.random(np.random.default_rng(3))
    moved = run(source.moved(motion), target.moved(motion))
    assert np.linalg.norm(moved.warped - motion.apply(first.warped), axis=1).max() < pose_mm

    # Rows keep their partners: shuffled rows give (nearly) the shuffled answer, never another point's.
    order = np.random.default_rng(5).permutation(len(source))
    shuffled = PointCloud(source.points[order], "shuffled", source.parts[order] if source.parts is not None else None)
    assert np.linalg.norm(run(shuffled, target).warped - first.warped[order], axis=1).mean() < 0.5

    # Labels are there for the methods that use them; these may not.
    bare = run(PointCloud(source.points), PointCloud(target.points))
    assert bare.warped.tobytes() == first.warped.tobytes()


def check_tuned(method: Method, surface: str = "") -> None:
    """The tuned parameters are the best row of the recorded grid, no row of which failed on a case unseen.

    Args:
        method: the tuned one.
        surface: how its table's name ends: ``""`` for the visible surface, ``"_whole"`` for the whole tube.
    """
    table = pd.read_csv(Path(__file__).parents[1] / "results" / "tuning" / f"{method.name}{surface}.csv")
    table["pairs"] = -table["pairs"]  # a row left out early has fewer
    best = table.sort_values(["pairs", "failed", "waypoint_error_mm"], kind="stable").iloc[0]
    assert len(table) > 10
    for name, value in asdict(method).items():  # type: ignore[call-overload]
        assert str(best[name]) == str(value) or float(best[name]) == pytest.approx(float(value)), name
