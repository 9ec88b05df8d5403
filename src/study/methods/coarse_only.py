"""No refinement: the coarse alignment that every method starts from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from study.registration import Registration
from study.types import PointCloud, RigidTransform


@dataclass(frozen=True)
class CoarseOnly:
    """The starting point, so that tables show what each method adds to it."""

    name: ClassVar[str] = "coarse"

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """Leave the source where the coarse alignment put it."""
        return Registration(
            source=source.points,
            warped=source.points,
            T_us_ct=RigidTransform(),
            converged=True,
            n_iterations=0,
            stop_reason="nothing to iterate",
        )
