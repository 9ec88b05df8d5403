"""Sweeps over a small chest, each made once a module."""

from functools import lru_cache

import numpy as np
import pytest
from small_sweeps import FRONT, small_chest

from study.geometry.rays import surface_distance_mm
from study.types import Mesh
from study.ultrasound.cloud import sweep_cloud
from study.ultrasound.sweep_errors import SweepErrors
from study.ultrasound.tracked import TrackedSweep
from study.ultrasound.virtual_sweep import simulate_sweep
from study.ultrasound.visible import visible_mesh


@pytest.fixture(scope="session")
def chest() -> Mesh:
    """A plate and eight tubes, arched like a small chest."""
    return small_chest()


@pytest.fixture(scope="session")
def seen(chest) -> Mesh:
    """What a probe can see of it."""
    return visible_mesh(chest, FRONT)


@pytest.fixture(scope="module")
def record(chest):
    """Sweeps over the chest; the last few are kept, a sweep is tens of megabytes."""

    @lru_cache(maxsize=4)
    def make(errors: SweepErrors, seed: int = 0) -> TrackedSweep:
        return simulate_sweep(chest, FRONT, errors, np.random.default_rng(seed))

    return make


@pytest.fixture(scope="module")
def mean_error_mm(record, seen):
    """Mean distance of a sweep's cloud from the visible surface, by errors and seed."""
    return lambda errors, seed=0: surface_distance_mm(sweep_cloud(record(errors, seed)).cloud.points, seen).mean()
