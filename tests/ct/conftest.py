from __future__ import annotations

import numpy as np
import pytest
from drawn_chest import draw, drawn_landmarks

from study.ct.landmarks import Landmarks
from study.types import Volume


@pytest.fixture(scope="session")
def drawn() -> tuple[Volume, Volume, np.ndarray]:
    return draw()


@pytest.fixture
def landmarks() -> Landmarks:
    return drawn_landmarks()
