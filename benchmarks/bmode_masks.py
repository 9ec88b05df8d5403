"""What masks found in B-mode cost against perfect ones: contour error and cloud error, on simulated frames.

    python benchmarks/bmode_masks.py [--people 1]

Phantoms of the development seeds 101, 102, ... (none is reported) under a virtual sweep. Masks are perfect, drawn by
the hand that `SweepErrors` assumes (0.4 mm of jitter), or found by `find_bone_surface` in frames that `simulate_bmode`
draws over the perfect ones: over bone, and over cartilage that lets the beam through. First with no other error, then
with all of them. **Simulated throughout**: speckle, shadow, reflections and sheets of tissue are a model's, so these
are lower bounds of what a real chest will show. Columns: error of the found contour where both masks have one (bias,
mean, share beyond 1 mm), the share of the true contour that was found, and of what was found that is none; then the
cloud, its mean distance from the surface that a probe can see and the share of that surface within 2 mm of a point.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import pandas as pd

from study import phantom
from study.data.manifest import load_manifest
from study.datasets.people import FRONT
from study.datasets.phantoms import PhantomDataset
from study.evaluation.distances import directed_distances_mm
from study.geometry.rays import surface_distance_mm
from study.params import find_profile
from study.seeds import named_rng
from study.types import Floats, Mesh
from study.ultrasound import (
    BONE,
    CARTILAGE,
    Probe,
    SweepErrors,
    TrackedSweep,
    find_bone_surface,
    simulate_bmode,
    simulate_sweep,
    sweep_cloud,
    visible_mesh,
)

FIRST_SEED = 101
SPACING_MM = 1.5
PROBE = Probe(frames_per_s=6.0)  # a fifth of the sweep's frames: one costs a tenth of a second
CASES = {"no other error": SweepErrors.none(), "every other error": replace(SweepErrors(), contour_mm=0.0)}


def contour_errors(rows: Floats, sweep: TrackedSweep) -> dict[str, float]:
    """Of the found rows (f, w) against the upper edge of the sweep's masks."""
    seen = sweep.masks.any(axis=1)
    error = (rows - (sweep.masks.argmax(axis=1) - 0.5)) * sweep.pixel_spacing_mm[1]
    found = np.isfinite(rows)
    both = error[found & seen]
    return {
        "bias (mm)": both.mean(),
        "mean (mm)": np.abs(both).mean(),
        "beyond 1 mm (%)": 100 * np.mean(np.abs(both) > 1),
        "found (%)": 100 * (found & seen).sum() / seen.sum(),
        "false (%)": 100 * (found & ~seen).sum() / max(found.sum(), 1),
    }


def cloud_errors(sweep: TrackedSweep, visible: Mesh) -> dict[str, float]:
    """Of the sweep's cloud against the surface that a probe can see."""
    points = sweep_cloud(sweep, spacing_mm=SPACING_MM).cloud.points
    near = directed_distances_mm(visible.vertices, points) < 2.0
    return {"cloud (mm)": surface_distance_mm(points, visible).mean(), "covered (%)": 100 * near.mean()}


def rows_of(name: str, seed: int) -> list[dict[str, object]]:
    params = replace(find_profile("full"), ct_points=4000)
    mesh = PhantomDataset("phantom", params, 0, load_manifest(), cohort_seed=seed).anatomy(name).mesh
    visible = visible_mesh(mesh, FRONT)
    rows: list[dict[str, object]] = []
    for case, errors in CASES.items():
        what = {"person": f"{name}, {seed}", "sweep": case}
        draw = f"bmode/{name}"
        perfect = simulate_sweep(mesh, FRONT, errors, named_rng(seed, draw), probe=PROBE)
        rows.append({**what, "masks": "perfect", **cloud_errors(perfect, visible)})
        drawn = simulate_sweep(
            mesh, FRONT, replace(errors, contour_mm=SweepErrors.contour_mm), named_rng(seed, draw), probe=PROBE
        )
        rows.append({**what, "masks": "drawn by hand, 0.4 mm", **cloud_errors(drawn, visible)})
        for kind, echo in (("bone", BONE), ("cartilage", CARTILAGE)):
            images = simulate_bmode(
                perfect.masks, perfect.pixel_spacing_mm, named_rng(seed, f"{draw}/{kind}"), echo=echo
            )
            found = find_bone_surface(images, perfect.pixel_spacing_mm)
            masked = replace(perfect, masks=found.masks(images.shape[1], 5))
            costs = {**contour_errors(found.rows, perfect), **cloud_errors(masked, visible)}
            rows.append({**what, "masks": f"found in B-mode, {kind}", **costs, "poor frames": int(found.poor.sum())})
            print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=1)
    options = parser.parse_args()
    people = [(name, FIRST_SEED + k) for k in range(options.people) for name in phantom.SUBJECTS]
    table = pd.DataFrame([row for name, seed in people[: options.people] for row in rows_of(name, seed)])
    means = table.drop(columns="person").groupby(["sweep", "masks"], sort=False).mean()
    print(f"\nmeans over {options.people} people, simulated\n{means.round(2).reset_index().to_markdown(index=False)}")


if __name__ == "__main__":
    main()
