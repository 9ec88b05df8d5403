"""How often coarse alignment is right from a random pose: det +1, sternum, sides, levels.

    python benchmarks/pose_rate.py [--poses 200] [--dataset phantom --dataset open]

Both clouds of every subject, CT and virtual sweep, are put into uniform random SO(3) poses. Right is what
`study.evaluation.check_pose` says: the axes (left, up, front) are the anatomy's turned by less than 25°, and at least
four in five points carry their own part. A mirrored chest, a swapped level or a swapped side fails.
"""

from __future__ import annotations

import argparse

import numpy as np
from joblib import Parallel, delayed

from study.alignment.chest import find_chest
from study.datasets import Dataset, find_dataset
from study.errors import StudyError
from study.evaluation.poses import check_pose
from study.seeds import named_rng
from study.types import PointCloud, RigidTransform


def is_right(cloud: PointCloud, T_cloud_ras: RigidTransform) -> bool:
    try:
        chest = find_chest(PointCloud(cloud.points, cloud.name))  # neither parts nor front are given away
    except StudyError:
        return False
    assert cloud.parts is not None
    return check_pose(chest, cloud.parts, T_cloud_ras).is_right


def clouds_of(dataset: Dataset, name: str) -> list[tuple[PointCloud, RigidTransform]]:
    anatomy = dataset.anatomy(name)
    patient = dataset.patient(name, anatomy)
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
    for dataset in map(find_dataset, options.dataset or ["phantom", "open"]):
        clouds = [entry for name in dataset.names() for entry in clouds_of(dataset, name)]
        rates = Parallel(n_jobs=2)(delayed(rate)(cloud, T, options.poses) for cloud, T in clouds)
        for (cloud, _), value in zip(clouds, rates, strict=True):
            print(f"{dataset.name:8s} {cloud.name:22s} {100 * value:6.1f} % of {options.poses} poses right", flush=True)


if __name__ == "__main__":
    main()
