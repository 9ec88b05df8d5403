"""How often coarse alignment is right from a random pose: det +1, sternum, sides, levels.

    python benchmarks/pose_rate.py [--poses 200] [--dataset phantom --dataset open]

Both clouds of every subject, CT and virtual sweep, are put into uniform random SO(3) poses. Right means: the axes
(left, up, front) agree with the anatomy's within 25° each, and at least four in five points carry their own part. A
mirrored chest, a swapped level or a swapped side fails both.
"""

from __future__ import annotations

import argparse

import numpy as np
from joblib import Parallel, delayed

from study.coarse import find_chest
from study.cohorts import Anatomy, load_anatomy, make_patient, pairs
from study.errors import StudyError
from study.params import find_profile
from study.pipeline import named_rng
from study.types import PointCloud, RigidTransform

MAX_ANGLE_DEG, MIN_PARTS = 25.0, 0.8
CHEST_IN_RAS = np.column_stack([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])  # left, up, front


def is_right(cloud: PointCloud, T_cloud_ras: RigidTransform) -> bool:
    try:
        chest = find_chest(PointCloud(cloud.points, cloud.name))  # neither parts nor front are given away
    except StudyError:
        return False
    axes = T_cloud_ras.rotation.T @ chest.T_cloud_chest.rotation
    off = RigidTransform(axes @ CHEST_IN_RAS.T).angle_deg
    return off < MAX_ANGLE_DEG and float(np.mean(chest.cloud.parts == cloud.parts)) >= MIN_PARTS


def clouds_of(dataset: str, name: str) -> list[tuple[PointCloud, RigidTransform]]:
    params = find_profile("full")
    anatomy: Anatomy = load_anatomy(dataset, name, params)
    patient = make_patient(anatomy, params)
    return [(anatomy.cloud, RigidTransform()), (patient.labelled, patient.T_us_ras)]


def rate(cloud: PointCloud, T_cloud_ras: RigidTransform, poses: int) -> float:
    rng = named_rng(0, f"pose_rate/{cloud.name}")
    draws = [RigidTransform.random(rng) for _ in range(poses)]
    return float(np.mean([is_right(cloud.moved(pose), pose @ T_cloud_ras) for pose in draws]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=200)
    parser.add_argument("--dataset", action="append")
    options = parser.parse_args()
    for dataset in options.dataset or ["phantom", "open"]:
        names = list(dict.fromkeys(n for pair in pairs(dataset, find_profile("full")) for n in pair))
        clouds = [entry for name in names for entry in clouds_of(dataset, name)]
        rates = Parallel(n_jobs=2)(delayed(rate)(cloud, T, options.poses) for cloud, T in clouds)
        for (cloud, _), value in zip(clouds, rates, strict=True):
            print(f"{dataset:8s} {cloud.name:22s} {100 * value:6.1f} % of {options.poses} poses right", flush=True)


if __name__ == "__main__":
    main()
