"""Statistics over pairs: population SD as the paper prints it, and a paired test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import wilcoxon

from study.errors import StudyError

MIN_PAIRS = 6  # two-sided, 5 pairs cannot give less than p = 2 / 2**5 = 0.0625


def population_sd(values: ArrayLike) -> float:
    """Standard deviation with ``ddof=0``: the paper's Table I divides by n, pandas by n - 1."""
    return float(np.std(np.asarray(values, dtype=np.float64)))


@dataclass(frozen=True)
class PairedTest:
    """Two methods on the same subjects.

    Attributes:
        n: pairs compared.
        mean_difference: first minus second, mean over the pairs.
        p_value: Wilcoxon signed-rank, two-sided, exact where there are no ties; None with fewer than 6 pairs.
        note: what the p-value is, or why there is none.
    """

    n: int
    mean_difference: float
    p_value: float | None
    note: str


def paired_wilcoxon(first: ArrayLike, second: ArrayLike) -> PairedTest:
    """Compare two methods on the same subjects; entry i of both is subject i.

    A subject is one observation: its 20 waypoints share one registration, so pass their mean.

    Raises:
        StudyError: sequences that do not pair, or values that are not finite.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 1 or not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise StudyError(
            f"expected two lists of finite values, one pair a subject, got {a.shape} and {b.shape}; leave failures out"
        )
    difference = a - b
    n, mean = len(difference), float(difference.mean()) if len(difference) else float("nan")
    if n < MIN_PAIRS:
        return PairedTest(n, mean, None, f"n = {n} < {MIN_PAIRS}: no test can reach p < 0.05")
    if not difference.any():
        return PairedTest(n, mean, 1.0, f"n = {n}, all pairs equal")
    return PairedTest(n, mean, float(wilcoxon(a, b).pvalue), f"Wilcoxon signed-rank, two-sided, n = {n}")
