"""How often coarse alignment is right from a random pose: det +1, sternum, sides, levels.

Right means: the recovered axes lie within 15° of those from the canonical pose and at least 80 % of the points get
their own part, so a mirrored anatomy or a swapped level or side cannot pass.
"""

import sys
import time

import numpy as np
from tqdm import tqdm

from study.coarse import find_chest
from study.errors import StudyError
from study.types import PointCloud, RigidTransform


def is_right(cloud: PointCloud, pose: RigidTransform) -> bool:
    try:
        chest = find_chest(PointCloud(pose.apply(cloud.points), cloud.name))
    except StudyError:
        return False
    axes = pose.rotation.T @ chest.T_cloud_chest.rotation  # chest axes (left, up, front) back in RAS
    expected = np.array([[-1.0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]]).T
    aligned = float((axes * expected).sum(axis=0).min())
    known = cloud.parts >= 0
    right_part = np.mean(chest.cloud.parts[known] == cloud.parts[known])
    return np.linalg.det(axes) > 0 and aligned > np.cos(np.radians(40)) and right_part > 0.8


if __name__ == "__main__":
    import glob
    n=int(sys.argv[1])
    for f in sorted(glob.glob("/tmp/phantom_*.npz"))+["/tmp/lidc_cloud.npz"]:
        d=np.load(f); c=PointCloud(d["points"],f,d["parts"]); rng=np.random.default_rng(0)
        t=time.time(); ok=[is_right(c,RigidTransform.random(rng)) for _ in range(n)]
        print(f, np.mean(ok), (time.time()-t)/n)
