"""The numbered graph that is pulled onto a chest: nodes, directed links and graph distance (sec. III-B)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import shortest_path

from study.types import Floats, Ints, as_points


@dataclass(frozen=True)
class SkeletonGraph:
    """The numbered graph of sec. III-B.

    Attributes:
        nodes: (m, 3) mm.
        edges: (e, 2) directed edges ``from, to``; a bidirectional link is two rows.
        parts: (m,) int64 of `Part`.

    Raises:
        StudyError: nodes that are no finite (m, 3) points.
    """

    nodes: Floats
    edges: Ints
    parts: Ints

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", as_points(self.nodes, "graph nodes"))

    def __len__(self) -> int:
        return len(self.nodes)

    def with_nodes(self, nodes: Floats) -> SkeletonGraph:
        """The same topology at other positions (m, 3) mm."""
        return replace(self, nodes=nodes)

    def hops(self, *, directed: bool) -> Ints:
        """(m, m) graph distance in edges from row to column node; unreachable pairs are ``len(self)``."""
        m = len(self)
        weights = csr_array((np.ones(len(self.edges)), (self.edges[:, 0], self.edges[:, 1])), shape=(m, m))
        lengths = shortest_path(weights, directed=directed, unweighted=True)
        return np.where(np.isinf(lengths), m, lengths).astype(np.int64)

    def edge_lengths_mm(self) -> Floats:
        """(e,) mm from end to end of each edge."""
        ends = self.nodes[self.edges]
        lengths: Floats = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        return lengths

    def geodesics_mm(self) -> Floats:
        """(m, m) mm from node to node along the links, either way; infinity without a path."""
        links = csr_array((self.edge_lengths_mm(), (self.edges[:, 0], self.edges[:, 1])), shape=(len(self), len(self)))
        lengths: Floats = shortest_path(links, directed=False)
        return lengths
