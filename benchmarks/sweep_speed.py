"""Seconds of processor time from a virtual sweep of 2,000 frames to its cloud, and for the simulation itself.

    python benchmarks/sweep_speed.py [MESH.npz]

The mesh (``vertices``, ``faces``, RAS mm) stands for a chest; without one a wavy plate of 160 x 130 mm does.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from study.geometry.rays import surface_distance_mm
from study.types import Floats, Mesh
from study.ultrasound.cloud import sweep_cloud
from study.ultrasound.probe import Probe
from study.ultrasound.sweep_errors import SweepErrors
from study.ultrasound.virtual_sweep import simulate_sweep
from study.ultrasound.visible import visible_mesh

FRONT = (0.0, 1.0, 0.0)


def wavy_plate(step_mm: float = 1.0) -> Mesh:
    x, z = np.meshgrid(np.arange(-80, 81, step_mm), np.arange(-65, 66, step_mm), indexing="ij")
    y = -30 * (x / 80) ** 2 + 4 * np.cos(z / 5)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.vstack([np.column_stack([a, c, b]), np.column_stack([a, d, c])])
    vertices: Floats = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    return Mesh(vertices, faces, np.zeros(len(vertices)), name="plate")


def main() -> None:
    if len(sys.argv) > 1:
        with np.load(sys.argv[1]) as data:
            mesh = Mesh(data["vertices"], data["faces"], np.zeros(len(data["vertices"])), name="mesh")
    else:
        mesh = wavy_plate()
    seen = visible_mesh(mesh, FRONT)
    speed = Probe.speed_mm_s
    usual = simulate_sweep(mesh, FRONT, SweepErrors(), np.random.default_rng(0)).n_frames
    # A slower hand, so that the same anatomy takes 2,000 frames.
    probe = Probe(speed_mm_s=speed * usual / 2000)
    for what, errors in (("no errors", SweepErrors.none()), ("all errors", SweepErrors())):
        start = time.process_time()
        sweep = simulate_sweep(mesh, FRONT, errors, np.random.default_rng(0), probe=probe)
        simulated = time.process_time()
        cloud = sweep_cloud(sweep).cloud
        done = time.process_time()
        error_mm = surface_distance_mm(cloud.points, seen).mean()
        print(
            f"{what}: {sweep.n_frames} frames simulated in {simulated - start:.2f} s, {len(cloud)} points in"
            f" {done - simulated:.2f} s (target 10 s), {error_mm:.3f} mm from the visible surface"
        )


if __name__ == "__main__":
    main()
