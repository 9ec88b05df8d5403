"""Shared clouds, made once a session: the phantom's surface takes seconds to build."""

import numpy as np
import pytest

from study import phantom
from study.alignment.frame import ChestFrame
from study.types import Part, PointCloud

US_NOISE_MM = 0.5


@pytest.fixture(scope="session")
def ct_clouds() -> dict[str, PointCloud]:
    """The whole surface of every phantom subject, labelled; its canonical pose is RAS+."""
    return {
        name: phantom.reference_cloud(phantom.draw_subject(name, 0), 4000, np.random.default_rng(0))
        for name in phantom.SUBJECTS
    }


@pytest.fixture(scope="session")
def us_cloud() -> PointCloud:
    """What a probe sees of the phantom's patient, labelled, with three strips missing."""
    return phantom.anterior_cloud(phantom.draw_subject("patient", 0), 3000, US_NOISE_MM, 3, np.random.default_rng(1))


@pytest.fixture(scope="session")
def chest() -> ChestFrame:
    """A chest of round numbers in RAS+."""
    heights = {2: 40.0, 3: 10.0, 4: -15.0, 5: -35.0}
    reaches = {2: 40.0, 3: 50.0, 4: 60.0, 5: 70.0}
    parts = [part for part in Part if part > 0]
    return ChestFrame(
        origin=np.array([1.0, 2.0, 3.0]),
        left=np.array([-1.0, 0, 0]),
        up=np.array([0, 0, 1.0]),
        front=np.array([0, 1.0, 0]),
        width_mm=30.0,
        root_mm={part: heights[part.level] for part in parts},
        reach_mm={part: reaches[part.level] for part in parts},
    )
