"""Local rigid transforms of the nodes and their blend over the cloud (sec. III-C, Eqs. 3 and 4)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.spatial import KDTree

from study.errors import StudyError
from study.geometry.points import fit_rigid_batch
from study.types import Bools, Floats, Ints

Neighbours = Literal["nodes", "hops"]
BlendWeights = Literal["distance", "inverse_distance"]


def local_transforms(
    ct_nodes: Floats, us_nodes: Floats, hops: Ints, n_reg: int = 3, neighbours: Neighbours = "nodes"
) -> tuple[Floats, Floats]:
    """The rigid motion of each node's neighbourhood from the CT to the US graph (Eq. 3).

    Args:
        ct_nodes: (m, 3) mm.
        us_nodes: (m, 3) mm, row i pairs with ``ct_nodes[i]``.
        hops: (m, m) undirected graph distance.
        n_reg: N_reg.
        neighbours: ``"nodes"``: the ``n_reg`` nodes closest in graph distance, the node itself first, ties by
            Euclidean distance (the paper); ``"hops"``: all within ``n_reg`` hops (the authors' code).

    Returns:
        rotations (m, 3, 3), translations (m, 3) mm.

    Raises:
        StudyError: nodes that do not pair, fewer than 3 neighbours, or an unknown choice of them.
    """
    m = len(ct_nodes)
    if ct_nodes.shape != us_nodes.shape or hops.shape != (m, m):
        raise StudyError(f"expected paired nodes and (m, m) hops, got {ct_nodes.shape}, {us_nodes.shape}, {hops.shape}")
    members = _members(ct_nodes, hops, n_reg, neighbours)
    size = members.sum(axis=1).max()
    index = np.argsort(~members, axis=1, kind="stable")[:, :size]  # members first, padded by weight 0
    weights = np.take_along_axis(members, index, axis=1).astype(np.float64)
    weights /= weights.sum(axis=1, keepdims=True)
    return fit_rigid_batch(ct_nodes[index], us_nodes[index], weights)


def _members(ct_nodes: Floats, hops: Ints, n_reg: int, neighbours: Neighbours) -> Bools:
    """Which nodes (m, m) belong to the neighbourhood of each, row by row."""
    m = len(ct_nodes)
    if neighbours == "hops":
        return hops <= n_reg
    if neighbours == "nodes":
        if not 3 <= n_reg <= m:
            raise StudyError(f"expected 3 <= n_reg <= {m} nodes for a rigid fit, got {n_reg}")
        tie = np.linalg.norm(ct_nodes[:, None] - ct_nodes[None], axis=2)
        order = np.lexsort((tie, hops), axis=1)[:, :n_reg]
        members = np.zeros((m, m), dtype=bool)
        np.put_along_axis(members, order, True, axis=1)
        return members
    raise StudyError(f"expected neighbours nodes|hops, got {neighbours!r}")


def blend(
    points: Floats,
    ct_nodes: Floats,
    rotations: Floats,
    translations: Floats,
    k: int = 3,
    weights: BlendWeights = "distance",
) -> Floats:
    """The points moved by the weighted motions of their ``k`` closest CT nodes (Eq. 4).

    Args:
        points: (n, 3) mm, CT.
        ct_nodes: (m, 3) mm.
        rotations: (m, 3, 3).
        translations: (m, 3) mm.
        k: N of Eq. 4; the paper gives no number, the authors' code 3.
        weights: ``"distance"`` is Eq. 4 as printed, where the farthest node counts most;
            ``"inverse_distance"`` makes the nearest count most.

    Returns:
        (n, 3) mm in the US frame, row i of ``points[i]``.

    Raises:
        StudyError: a ``k`` that the graph has not, or an unknown choice of weights.
    """
    if weights not in ("distance", "inverse_distance"):
        raise StudyError(f"expected weights distance|inverse_distance, got {weights!r}")
    if not 1 <= k <= len(ct_nodes):
        raise StudyError(f"expected 1 <= k <= {len(ct_nodes)} nodes, got {k}")
    distances, index = KDTree(ct_nodes).query(points, k=list(range(1, k + 1)))
    distances = np.maximum(distances, 1e-9)  # a point on a node
    w = distances if weights == "distance" else 1 / distances
    w = w / w.sum(axis=1, keepdims=True)
    moved = np.einsum("nkij,nj->nki", rotations[index], points) + translations[index]
    blended: Floats = np.einsum("nk,nki->ni", w, moved)  # Eq. 4
    return blended
