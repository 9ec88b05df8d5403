"""Whether the coarse alignment took a cloud for the chest it is (sec. III-A), in whatever pose it came."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from study.alignment.chest import Chest, find_chest
from study.errors import StudyError
from study.seeds import named_rng
from study.types import Ints, Part, PointCloud, RigidTransform

# Chest coordinates, x to the patient's left, y up, z to the front, in RAS+.
T_RAS_CHEST = RigidTransform(np.column_stack([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
# The feature plane leans with the wall by up to 15°; a swap of sides, head and foot or front and back turns by 180°.
MAX_AXES_OFF_DEG = 25.0
MIN_RIGHT_PARTS = 0.8  # the border between bone and cartilage is a straight line; a swapped level leaves far fewer


@dataclass(frozen=True)
class PoseCheck:
    """A chest that was found, against the one that is there.

    Attributes:
        axes_off_deg: angle between the chest axes that were found and the body's, 0-180.
        right_parts: share of the labelled points with their own part, 0-1.
        worst_part: the same of the part with the lowest share.
    """

    axes_off_deg: float
    right_parts: float
    worst_part: float

    @property
    def is_right(self) -> bool:
        """Front, head, sides and levels are the true ones; a mirrored or shifted anatomy is not right."""
        return self.axes_off_deg < MAX_AXES_OFF_DEG and self.right_parts >= MIN_RIGHT_PARTS


def check_pose(chest: Chest, true_parts: Ints, T_cloud_ras: RigidTransform) -> PoseCheck:
    """Judge a chest that was found in a cloud whose parts and pose are known.

    Args:
        chest: as `study.alignment.chest.find_chest` gives it.
        true_parts: (n,) of `Part`, of the cloud's points.
        T_cloud_ras: RAS+ of the body to the cloud's frame.

    Raises:
        StudyError: parts that are not one a point, or none of some part.
    """
    found, true = chest.cloud.parts, np.asarray(true_parts)
    if found is None or found.shape != true.shape:
        raise StudyError(
            f"{chest.cloud.name}: expected a true part for each of {len(chest.cloud)} points, got {true.shape}"
        )
    missing = [part.name.lower() for part in Part if part != Part.UNKNOWN and not (true == part).any()]
    if missing:
        raise StudyError(f"{chest.cloud.name}: expected points of all nine parts, got none of {', '.join(missing)}")
    same = found == true
    T_ras_chest = T_cloud_ras.inverse @ chest.T_cloud_chest
    return PoseCheck(
        axes_off_deg=(T_RAS_CHEST.inverse @ T_ras_chest).angle_deg,
        right_parts=float(same[true >= 0].mean()),
        worst_part=float(min(same[true == part].mean() for part in Part if part != Part.UNKNOWN)),
    )


@dataclass(frozen=True)
class PoseTrial:
    """One cloud in one pose.

    Attributes:
        cloud: which one, by its name among those tried.
        pose: how it was moved from RAS+.
        chest: what the coarse alignment found in it.
        check: how that compares with the truth.
    """

    cloud: str
    pose: RigidTransform
    chest: Chest
    check: PoseCheck


def random_pose(seed: int, name: str, shift_mm: float = 300.0) -> RigidTransform:
    """A uniform random rotation and a normal shift of ``shift_mm`` per axis, drawn by a seed and a name."""
    return RigidTransform.random(named_rng(seed, name), shift_mm)


def try_poses(clouds: Mapping[str, PointCloud], n: int, seed: int) -> list[PoseTrial]:
    """Find the chest of each cloud in random poses, from its points alone.

    Args:
        clouds: labelled with the true parts, RAS+, by name.
        n: poses of each.
        seed: of the poses.

    Raises:
        StudyError: a cloud without parts, or one that the coarse alignment refuses.
    """
    trials = []
    for number in range(n):
        rng = named_rng(seed, f"coarse/pose{number}")
        poses = {name: RigidTransform.random(rng) for name in clouds}
        for name, pose in poses.items():
            cloud = clouds[name]
            if cloud.parts is None:
                raise StudyError(
                    f"{cloud.name}: expected a cloud with its true parts, got none; there is nothing to check"
                )
            # Neither the parts nor the front are given away.
            chest = find_chest(PointCloud(pose.apply(cloud.points), cloud.name))
            trials.append(PoseTrial(name, pose, chest, check_pose(chest, cloud.parts, pose)))
    return trials
