"""The population SD, as the paper prints it; intervals are in `study.evaluation.intervals`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def population_sd(values: ArrayLike) -> float:
    """Standard deviation with ``ddof=0``: the paper's Table I divides by n, pandas by n - 1."""
    return float(np.std(np.asarray(values, dtype=np.float64)))
