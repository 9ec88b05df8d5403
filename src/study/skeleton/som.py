"""Self-organising map on graph distance (sec. III-B, Eq. 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from study.errors import StudyError
from study.skeleton.graph import SkeletonGraph
from study.types import Floats, Ints, Part, PointCloud

RateSchedule = Literal["constant", "linear", "compounding"]
RadiusSchedule = Literal["linear", "compounding"]
Winners = Literal["any", "own_part"]

N_CHECKS = 20  # of the quantisation error along the schedule
MAX_FALL = 0.02  # of it over the last two checks of a map at rest; the draws of a constant rate alone make 1 %


@dataclass(frozen=True)
class SomParams:
    """Schedule of one map.

    Attributes:
        epochs: passes after pre-training; the paper states no number.
        samples: points drawn per epoch.
        rate: learning rate l_r of the main epochs (0.1 in the paper).
        rate_schedule: ``"constant"`` (the paper), ``"linear"`` to 0, or ``"compounding"`` (the authors' code).
        radius: start of the neighbourhood radius in hops; it falls to 1 (`radius_at`). The paper states none; 5 is the
            authors' code's.
        radius_schedule: ``"linear"`` in whole hops over the schedule (this study), or ``"compounding"`` (the authors'
            code), at 1 hop after a few epochs.
        winners: ``"any"`` node may win a point (the paper); ``"own_part"`` only those of the point's labelled part.
        pretrain_epochs, pretrain_rate: epochs on the directed graph (3 at 0.02 in the paper).

    Raises:
        StudyError: numbers that make no map, or an unknown choice.
    """

    epochs: int = 1000
    samples: int = 500
    rate: float = 0.1
    rate_schedule: RateSchedule = "constant"
    radius: float = 5.0
    radius_schedule: RadiusSchedule = "linear"
    winners: Winners = "any"
    pretrain_epochs: int = 3
    pretrain_rate: float = 0.02

    def __post_init__(self) -> None:
        if self.epochs < 1 or self.samples < 1 or self.pretrain_epochs < 0:
            raise StudyError(f"expected at least one epoch of one sample, got {self.epochs} of {self.samples}")
        if not (0 < self.rate <= 1 and 0 <= self.pretrain_rate <= 1 and self.radius >= 1):
            raise StudyError(
                f"expected rates in (0, 1] and radius >= 1 hop, got {self.rate}, {self.pretrain_rate}, {self.radius}"
            )
        if self.rate_schedule not in ("constant", "linear", "compounding"):
            raise StudyError(f"expected rate_schedule constant|linear|compounding, got {self.rate_schedule!r}")
        if self.radius_schedule not in ("linear", "compounding"):
            raise StudyError(f"expected radius_schedule linear|compounding, got {self.radius_schedule!r}")
        if self.winners not in ("any", "own_part"):
            raise StudyError(f"expected winners any|own_part, got {self.winners!r}")

    def rate_at(self, epoch: int) -> float:
        """Learning rate of an epoch; the pre-training ones come before 0, from ``-pretrain_epochs`` to -1."""
        if epoch < 0:
            return self.pretrain_rate
        if self.rate_schedule == "constant":
            return self.rate
        if self.rate_schedule == "linear":
            return self.rate * (1 - epoch / self.epochs)
        # The authors' code multiplies the rate by (1 - e/E) at every epoch: prod_{i<=e} (1 - i/E).
        return float(self.rate * np.prod(1 - np.arange(epoch + 1) / self.epochs))

    def radius_at(self, epoch: int) -> float:
        """Neighbourhood radius of an epoch, in hops; the epochs count as in `rate_at`."""
        if self.radius_schedule == "linear":
            return float(int((self.radius - 1) * (1 - max(epoch, 0) / self.epochs)) + 1)
        # The authors' code applies that rule to the radius that it has just reached: every epoch takes a hop off,
        # however long the schedule is, but the first (e = 0, in pre-training and again after it).
        radius = self.radius
        for k in range(-self.pretrain_epochs, epoch + 1):
            if radius == 1:
                break
            e = k if k >= 0 else k + self.pretrain_epochs
            radius = int((radius - 1) * (1 - e / self.epochs)) + 1
        return float(radius)


def neighbourhood(hops: Ints, radius: float) -> Floats:
    """theta of Eq. 2: (m, m), row = winner; ``exp(-hops² / (2 radius²))`` within ``radius`` hops, 0 beyond.

    The paper calls it a restriction function; as in its authors' code it ends at the radius. Without that end a winner
    drags nodes of the neighbouring branches along, and branches swap.
    """
    reached = (hops <= radius) & (hops < len(hops))  # pairs without a path have len(hops)
    return np.where(reached, np.exp(-(hops.astype(np.float64) ** 2) / (2 * radius**2)), 0.0)


@njit(cache=True)
def _epoch(nodes, points, drawn, classes, barred, first, near, theta, rate):  # type: ignore[no-untyped-def]
    """One epoch of Eq. 2 in place: nodes (3, m), rows drawn (k,) of points (n, 3) with classes (n,) into barred (c, m).

    Winner w pulls the nodes ``near[first[w] : first[w + 1]]`` by ``theta`` of the same rows: theta is 0 elsewhere.
    """
    # Nodes lie as (3, m): one coordinate after the other lets the compiler take several nodes at a time.
    m = nodes.shape[1]
    x, y, z = nodes[0], nodes[1], nodes[2]
    apart = np.empty(m)
    # Floats of 0 or more are ordered as the integers of their bits; unlike the floats' own least, which must mind NaN,
    # that of integers is found several at a time.
    bits = apart.view(np.int64)
    for k in drawn:
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        bar = barred[classes[k]]
        least = np.int64(np.iinfo(np.int64).max)
        for s in range(m):
            apart[s] = (px - x[s]) ** 2 + (py - y[s]) ** 2 + (pz - z[s]) ** 2 + bar[s]
            least = min(least, bits[s])
        winner = 0
        while bits[winner] != least:
            winner += 1
        for j in range(first[winner], first[winner + 1]):  # Eq. 2
            s, step = near[j], theta[j] * rate
            x[s] += step * (px - x[s])
            y[s] += step * (py - y[s])
            z[s] += step * (pz - z[s])


def fit_som(
    graph: SkeletonGraph, cloud: PointCloud, params: SomParams, rng: np.random.Generator
) -> tuple[SkeletonGraph, tuple[float, ...]]:
    """The graph pulled onto a cloud by Eq. 2, one drawn point at a time (sec. III-B).

    Pre-training runs on the directed graph, the rest on the undirected one.

    Args:
        graph: start positions and topology, mm.
        cloud: (n, 3) mm, same frame; labelled where ``params.winners`` asks for parts.
        params: the schedule.
        rng: draws the points.

    Returns:
        the fitted graph, and the quantisation error (mean distance from points to their nearest node, mm)
        at ``N_CHECKS`` even steps (every epoch of a shorter schedule) and at the last epoch.

    Raises:
        StudyError: winners ``"own_part"`` of a cloud without parts.
    """
    nodes = np.array(graph.nodes.T, order="C")
    points = cloud.points
    classes, barred = _barred(graph, cloud, params.winners)
    hops, radius, history = graph.hops(directed=True), np.nan, []
    for epoch in range(-params.pretrain_epochs, params.epochs):
        if epoch == 0:
            hops, radius = graph.hops(directed=False), np.nan
        if params.radius_at(epoch) != radius:
            radius = params.radius_at(epoch)
            theta = csr_array(neighbourhood(hops, radius))
        drawn = rng.integers(len(points), size=params.samples)
        pull = theta.indptr, theta.indices, theta.data
        _epoch(nodes, points, drawn, classes, barred, *pull, params.rate_at(epoch))
        if epoch >= 0 and (epoch % max(1, params.epochs // N_CHECKS) == 0 or epoch == params.epochs - 1):
            history.append(quantisation_error_mm(nodes.T, points))
    return graph.with_nodes(nodes.T), tuple(history)


def late_fall(history: tuple[float, ...]) -> float:
    """Share by which the quantisation error still fell from the third last check of `fit_som` to the last.

    A map at rest has less than ``MAX_FALL``. The schedule's length is fixed, so this is the test of convergence: one
    too short ends while its error falls. A map whose rate has died is at rest, too, wherever it lies.
    """
    return 1 - history[-1] / history[-3] if len(history) >= 3 else 1.0


def _barred(graph: SkeletonGraph, cloud: PointCloud, winners: Winners) -> tuple[Ints, Floats]:
    """Class (n,) of each point and, by class, infinity (m,) at the nodes that may not win it."""
    if winners == "any":
        return np.zeros(len(cloud), dtype=np.int64), np.zeros((1, len(graph)))
    if cloud.parts is None:
        raise StudyError(f"{cloud.name}: expected labelled parts for winners 'own_part', got none; align first")
    barred = np.where(graph.parts[None] == np.arange(len(Part) - 1)[:, None], 0.0, np.inf)
    free = np.zeros((1, len(graph)))  # a point of unknown part may be won by any node
    return np.where(cloud.parts == Part.UNKNOWN, len(barred), cloud.parts), np.vstack([barred, free])


def quantisation_error_mm(nodes: Floats, points: Floats) -> float:
    """Mean distance (mm) from points (n, 3) mm to their nearest node (m, 3) mm."""
    return float(KDTree(nodes).query(points)[0].mean())
