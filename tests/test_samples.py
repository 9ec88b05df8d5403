"""The sample pair is small, is what its page says, and its waypoints pair with the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from study.files import read_ply, read_timed_ply, read_waypoints

SAMPLES = Path(__file__).parents[1] / "samples"


def test_the_samples_are_small_and_say_their_licence() -> None:
    sizes = {path.name: path.stat().st_size for path in SAMPLES.iterdir()}
    assert {"README.md", "ct.ply", "us.ply", "waypoints.csv", "waypoints_true.csv"} == set(sizes)
    assert max(sizes.values()) < 300_000
    page = (SAMPLES / "README.md").read_text(encoding="utf-8")
    assert all(word in page for word in ("Licence: MIT", "synthetic", "simulated", *(set(sizes) - {"README.md"})))


def test_the_sample_pair_is_a_chest_in_two_frames_with_paired_waypoints() -> None:
    ct, (us, times) = read_ply(SAMPLES / "ct.ply"), read_timed_ply(SAMPLES / "us.ply")
    assert len(ct) == 6000
    assert times is not None
    assert len(times) == len(us) > 2000
    for points in (ct, us):
        assert (np.linalg.norm(points - points.mean(axis=0), axis=1) < 200.0).all()
    waypoints, truth = (read_waypoints(SAMPLES / f"{name}.csv") for name in ("waypoints", "waypoints_true"))
    assert waypoints.labels == truth.labels
    assert len(waypoints) == 20
    # Waypoints lie between the cartilages, so near their own cloud: a file of the other frame would lie far off.
    for places, points in ((waypoints.points, ct), (truth.points, us)):
        nearest = np.linalg.norm(places[:, None] - points[None], axis=2).min(axis=1)
        assert nearest.max() < 30.0
