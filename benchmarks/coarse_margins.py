"""How sure the coarse alignment is of itself: right, wrong or refused on development people, and by how much.

    python benchmarks/coarse_margins.py [--seeds 8]

Phantoms of the development seeds 101, 102, ... (none is reported), each as a CT cloud and as virtual sweeps with every
error on, without and with the latency left in; and as a CT cloud and a sweep with one part torn out, which must be
refused. Right means as in pose_rate.py. The last lines are what the limits of `study.alignment` stand between, how far
a sweep lies from the surface that a probe can see.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import asdict, replace

import numpy as np
from joblib import Parallel, delayed
from pose_rate import is_right

from study import phantom
from study.alignment.chest import find_chest
from study.data.manifest import load_manifest
from study.datasets.people import FRONT, make_patient
from study.datasets.phantoms import PhantomDataset
from study.errors import StudyError
from study.geometry.rays import surface_distance_mm
from study.params import find_profile
from study.seeds import named_rng
from study.types import Part, PointCloud, RigidTransform
from study.ultrasound.sweep_errors import LATENCY_S, SweepErrors
from study.ultrasound.visible import visible_mesh

FIRST_SEED = 101
PARTS = [part for part in Part if part != Part.UNKNOWN]


def outcomes(name: str, seed: int) -> tuple[list[tuple[str, str]], list[dict[str, float]], float]:
    """(kind, outcome) of every cloud of one person; margins of the whole ones; mm from sweep to visible surface."""
    params = replace(find_profile("full"), ct_points=4000)
    rng = named_rng(seed, f"margins/{name}")
    anatomy = PhantomDataset("phantom", params, 0, load_manifest(), cohort_seed=seed).anatomy(name)
    late = replace(SweepErrors(), latency_uncorrected_s=LATENCY_S)
    swept, shifted = make_patient(anatomy, params, seed), make_patient(anatomy, params, seed, late)
    clouds = {
        "CT": (anatomy.cloud, RigidTransform()),
        "sweep": (swept.labelled, swept.T_us_ras),
        "sweep, latency left in": (shifted.labelled, shifted.T_us_ras),
    }
    found, margins = [], []
    for kind, (cloud, T_cloud_ras) in clouds.items():
        try:
            chest = find_chest(PointCloud(cloud.points, cloud.name))
        except StudyError:
            found.append((kind, "refused"))
            continue
        found.append((kind, "right" if is_right(cloud, T_cloud_ras) else "WRONG"))
        if kind != "sweep, latency left in":
            more = {"length_ratio": chest.length_ratio, "overlap": chest.sternum_overlap, "bulge_mm": chest.bulge_mm}
            margins.append(asdict(chest.search.roots) | more)
    for kind in ("CT", "sweep"):
        cloud = clouds[kind][0]
        torn = cloud.points[cloud.parts != PARTS[rng.integers(len(PARTS))]]
        try:
            find_chest(PointCloud(torn, "torn"))
            found.append((f"{kind}, torn", "ACCEPTED"))
        except StudyError:
            found.append((f"{kind}, torn", "refused"))
    points = swept.T_us_ras.inverse.apply(swept.cloud.points)
    return found, margins, float(surface_distance_mm(points, visible_mesh(anatomy.mesh, FRONT)).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    options = parser.parse_args()
    people = [(name, FIRST_SEED + k) for k in range(options.seeds) for name in phantom.SUBJECTS]
    answers = Parallel(n_jobs=2)(delayed(outcomes)(*person) for person in people)
    for (kind, outcome), count in sorted(Counter(pair for found, _, _ in answers for pair in found).items()):
        print(f"{kind:24s} {outcome:9s} {count:4d} of {len(people)}")
    margins = [row for _, rows, _ in answers for row in rows]
    print(f"\nwhole clouds that were not refused, n = {len(margins)}: smallest, median, largest")
    for key in margins[0]:
        low, middle, high = np.quantile([row[key] for row in margins], [0, 0.5, 1])
        print(f"  {key:14s} {low:8.2f} {middle:8.2f} {high:8.2f}")
    distance = np.array([mm for _, _, mm in answers])
    print(
        f"\nsweeps with every error, mean distance to the visible surface: {distance.mean():.2f} mm, "
        f"largest {distance.max():.2f} mm, {np.sum(distance > 1.5)} of {len(distance)} above 1.5 mm"
    )


if __name__ == "__main__":
    main()
