"""Which CT points explain which US points: an E-step one way, so that a missed strip costs nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from study.errors import StudyError
from study.types import Floats, Ints

_CUT = 4.0  # widths beyond which a CT point explains nothing
_NEAR = 64  # CT points that may explain one US point: all within three widths of the widest
_VOLUME_MM3 = 1.2e6  # over which outliers are spread: 20 × 15 × 4 cm about a chest wall


@dataclass(frozen=True)
class OneWayShares:
    """A mixture of Gaussians at the CT points and a uniform density, of which the US points are draws.

    The US points are what is explained: a strip that the sweep missed leaves CT points without any, and that costs
    nothing. The uniform density fills a fixed volume; pycpd's depends on the unit of the data.

    Attributes:
        outlier_share: of the US points, explained by no CT point.
        other_part: weight of a CT point for a US point of another part, beside 1 for its own.
    """

    outlier_share: float = 0.02
    other_part: float = 0.1

    def __post_init__(self) -> None:
        if not (0 < self.outlier_share < 1 and 0 < self.other_part <= 1):
            raise StudyError(
                "one-way shares: expected 0 < outlier_share < 1 and 0 < other_part <= 1, "
                f"got {self.outlier_share} and {self.other_part}; at 1 parts do not count"
            )

    def between(
        self, moved: Floats, target: Floats, width_mm: float, moved_parts: Ints, target_parts: Ints
    ) -> csr_array:
        """Shares (n, m) of the CT points in the US points; a row sums to 1, less what is taken for an outlier.

        Args:
            moved: (m, 3) mm, where the CT points lie now.
            target: (n, 3) mm, US points.
            width_mm: standard deviation of each Gaussian.
            moved_parts, target_parts: (m,) and (n,).
        """
        m, n = len(moved), len(target)
        near = min(_NEAR, m)
        distance, index = KDTree(moved).query(target, k=range(1, near + 1), distance_upper_bound=_CUT * width_mm)
        row, rank = np.nonzero(index < m)  # beyond the cut the index is m
        column = index[row, rank]
        density = np.exp(-((distance[row, rank] / width_mm) ** 2) / 2)
        density[moved_parts[column] != target_parts[row]] *= self.other_part
        outlier = self.outlier_share / _VOLUME_MM3 * m * (2 * np.pi * width_mm**2) ** 1.5 / (1 - self.outlier_share)
        shares = density / (np.bincount(row, density, n) + outlier)[row]
        return csr_array((shares, (row, column)), shape=(n, m))
