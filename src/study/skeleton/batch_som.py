"""A self-organising map that sees every point at once, with its neighbourhood in millimetres along the graph (Eq. 2).

The paper draws one point at a time. Where all points have had their say, a node rests at the mean of the points around
it, each weighed by theta of its winner; taking that mean outright needs no rate, no draws, and some 30 passes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import KDTree

from study.errors import StudyError
from study.skeleton.graph import SkeletonGraph
from study.skeleton.som import Winners
from study.types import Floats, Ints, Part, PointCloud

Lengths = Literal["geodesic", "hops"]

CUT = 3.0  # radii beyond which theta is 0: a node that the sweep missed is not drawn to points far from it


@dataclass(frozen=True)
class BatchSomParams:
    """Schedule of one map.

    Attributes:
        epochs: passes over which the radius falls, by the same factor each.
        start_radius_mm, end_radius_mm: standard deviation of theta along the graph.
        winners: ``"own_part"`` only nodes of the point's labelled part may win it; ``"any"`` node may (the paper).
        lengths: ``"geodesic"`` the edges' own lengths; ``"hops"`` each edge counts their mean, so that places one hop
            apart are neighbours however long the hop is (the paper).
        at_rest_mm: after the fall the map goes on until its nodes move less in the mean,
        max_rest: but no longer than this many epochs.

    Raises:
        StudyError: numbers that make no map, or an unknown choice.
    """

    epochs: int = 20
    start_radius_mm: float = 20.0
    end_radius_mm: float = 2.0
    winners: Winners = "own_part"
    lengths: Lengths = "geodesic"
    at_rest_mm: float = 0.05
    max_rest: int = 30

    def __post_init__(self) -> None:
        if not (self.epochs >= 2 and self.max_rest >= 0 and self.at_rest_mm >= 0):
            raise StudyError(
                "batch map: expected epochs >= 2, max_rest >= 0 and at_rest_mm >= 0, "
                f"got {self.epochs}, {self.max_rest} and {self.at_rest_mm}; a map needs some 20 epochs"
            )
        if not self.start_radius_mm >= self.end_radius_mm > 0:
            raise StudyError(
                "batch map: expected start_radius_mm >= end_radius_mm > 0, "
                f"got {self.start_radius_mm} and {self.end_radius_mm}; the nodes are some 7 mm apart"
            )
        if self.winners not in ("any", "own_part"):
            raise StudyError(f"batch map: expected winners any|own_part, got {self.winners!r}; the paper's is any")
        if self.lengths not in ("geodesic", "hops"):
            raise StudyError(f"batch map: expected lengths geodesic|hops, got {self.lengths!r}; the paper's are hops")

    def radius_mm(self, epoch: int) -> float:
        """Radius of theta in an epoch."""
        fallen = min(epoch / (self.epochs - 1), 1.0)
        return float(self.start_radius_mm * (self.end_radius_mm / self.start_radius_mm) ** fallen)

    def lengths_mm(self, graph: SkeletonGraph) -> Floats:
        """(m, m) mm from node to node along a graph."""
        if self.lengths == "geodesic":
            return graph.geodesics_mm()
        hops = graph.hops(directed=False)
        return np.where(hops == len(graph), np.inf, hops * graph.edge_lengths_mm().mean())


@dataclass(frozen=True)
class FittedMap:
    """A map at its end.

    Attributes:
        nodes: (m, 3) mm, the means; where a smoother is given, before it.
        history: mean distance from the points to their winners after each epoch, mm.
        moved_mm: mean motion of the nodes in the last epoch.
    """

    nodes: Floats
    history: tuple[float, ...]
    moved_mm: float


def fit_batch_som(
    graph: SkeletonGraph, cloud: PointCloud, params: BatchSomParams, smoother: Floats | None = None
) -> FittedMap:
    """The graph pulled onto a cloud, all points at a time.

    Args:
        graph: start positions and topology, mm; the lengths along it are those before the map.
        cloud: (n, 3) mm, same frame; labelled where ``params.winners`` asks for parts.
        params: the schedule.
        smoother: (m, m), takes the nodes' displacements from the start to smooth ones before each epoch, so that the
            points are shared out among nodes that moved coherently. A node without points follows the others.

    Raises:
        StudyError: winners ``"own_part"`` of a cloud without parts.
    """
    lengths = params.lengths_mm(graph)
    owners = _owners(graph, cloud, params.winners)
    nodes = placed = graph.nodes
    history: list[float] = []
    moved_mm = np.inf
    while len(history) < params.epochs or (
        moved_mm >= params.at_rest_mm and len(history) < params.epochs + params.max_rest
    ):
        radius = params.radius_mm(len(history))
        theta = np.where(lengths <= CUT * radius, np.exp(-(lengths**2) / (2 * radius**2)), 0.0)
        distances, winners = _win(placed, cloud.points, owners)
        won = np.bincount(winners, minlength=len(graph))
        sums = np.column_stack([np.bincount(winners, axis, minlength=len(graph)) for axis in cloud.points.T])
        pull = theta @ won  # theta is symmetric: row or column is the winner
        nodes = np.where(pull[:, None] > 0, theta @ sums / np.maximum(pull, np.finfo(float).tiny)[:, None], placed)
        before, placed = placed, nodes if smoother is None else graph.nodes + smoother @ (nodes - graph.nodes)
        history.append(float(distances.mean()))
        moved_mm = float(np.linalg.norm(placed - before, axis=1).mean())
    return FittedMap(nodes, tuple(history), moved_mm)


def _owners(graph: SkeletonGraph, cloud: PointCloud, winners: Winners) -> list[tuple[Ints, Ints]]:
    """Groups of points (rows) and the nodes that may win them."""
    everywhere = np.arange(len(graph))
    if winners == "any":
        return [(np.arange(len(cloud)), everywhere)]
    if cloud.parts is None:
        raise StudyError(f"{cloud.name}: expected labelled parts for winners 'own_part', got none; align first")
    return [
        (
            np.flatnonzero(cloud.parts == part),
            everywhere if part == Part.UNKNOWN else np.flatnonzero(graph.parts == part),
        )
        for part in np.unique(cloud.parts)
    ]


def _win(nodes: Floats, points: Floats, owners: list[tuple[Ints, Ints]]) -> tuple[Floats, Ints]:
    """Distance (n,) mm of each point to the nearest node that may win it, and which (n,) that is."""
    distances, winners = np.empty(len(points)), np.empty(len(points), dtype=np.int64)
    for rows, allowed in owners:
        distances[rows], local = KDTree(nodes[allowed]).query(points[rows])
        winners[rows] = allowed[local]
    return distances, winners
