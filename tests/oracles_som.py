"""Eqs. 2-4 as they are written: one loop for every sum, plain numpy, no shortcut."""

from __future__ import annotations

from collections import deque

import numpy as np

from study.skeleton.graph import SkeletonGraph
from study.skeleton.som import SomParams
from study.types import Floats, Ints


def hops_literal(n: int, edges: Ints, *, directed: bool) -> Ints:
    """Breadth-first search from every node; ``n`` where no path leads."""
    neighbours: list[list[int]] = [[] for _ in range(n)]
    for a, b in edges:
        neighbours[a].append(int(b))
        if not directed:
            neighbours[b].append(int(a))
    hops = np.full((n, n), n)
    for start in range(n):
        hops[start, start] = 0
        queue = deque([start])
        while queue:
            node = queue.popleft()
            for other in neighbours[node]:
                if hops[start, other] == n:
                    hops[start, other] = hops[start, node] + 1
                    queue.append(other)
    return hops


def som_literal(graph: SkeletonGraph, points: Floats, params: SomParams, rng: np.random.Generator) -> Floats:
    """Eq. 2, sample by sample and node by node; what compounds overwrites itself, as in the authors' code."""
    assert params.rate_schedule != "linear"
    nodes = [np.array(node) for node in graph.nodes]
    n = len(nodes)
    directed = hops_literal(n, graph.edges, directed=True)
    undirected = hops_literal(n, graph.edges, directed=False)
    plan, rate, radius = [], params.rate, int(params.radius)
    for hops, epochs in ((directed, params.pretrain_epochs), (undirected, params.epochs)):
        for epoch in range(epochs):
            left = 1 - epoch / params.epochs
            if params.radius_schedule == "compounding":
                radius = int((radius - 1) * left) + 1
            elif hops is undirected:
                radius = int((params.radius - 1) * left) + 1
            if params.rate_schedule == "compounding" and hops is undirected:
                rate = rate * left
            plan.append((hops, radius, params.pretrain_rate if hops is directed else rate))
    for hops, radius, rate in plan:
        for k in rng.integers(len(points), size=params.samples):
            winner = min(range(n), key=lambda s: float(((points[k] - nodes[s]) ** 2).sum()))
            for s in range(n):
                if hops[winner, s] <= radius and hops[winner, s] < n:
                    theta = np.exp(-(hops[winner, s] ** 2) / (2 * radius**2))
                    nodes[s] = nodes[s] + theta * rate * (points[k] - nodes[s])
    return np.array(nodes)


def rigid_literal(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Horn's quaternion solution of least squares, which cannot reflect: another road than the SVD's."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    s = sum(np.outer(p, q) for p, q in zip(a, b, strict=True))
    delta = np.array([s[1, 2] - s[2, 1], s[2, 0] - s[0, 2], s[0, 1] - s[1, 0]])
    n = np.zeros((4, 4))
    n[0, 0] = np.trace(s)
    n[0, 1:] = n[1:, 0] = delta
    n[1:, 1:] = s + s.T - np.trace(s) * np.eye(3)
    w, x, y, z = np.linalg.eigh(n)[1][:, -1]
    rotation = np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    return rotation, target.mean(axis=0) - rotation @ source.mean(axis=0)


def local_transforms_literal(
    ct_nodes: Floats, us_nodes: Floats, hops: Ints, n_reg: int, neighbours: str
) -> list[tuple[Floats, Floats]]:
    """Eq. 3, node by node."""
    answer = []
    for i in range(len(ct_nodes)):
        if neighbours == "hops":
            members = [j for j in range(len(ct_nodes)) if hops[i, j] <= n_reg]
        else:
            far = [(hops[i, j], np.linalg.norm(ct_nodes[j] - ct_nodes[i]), j) for j in range(len(ct_nodes))]
            members = [j for _, _, j in sorted(far)[:n_reg]]
        answer.append(rigid_literal(ct_nodes[members], us_nodes[members]))
    return answer


def blend_literal(
    points: Floats, ct_nodes: Floats, motions: list[tuple[Floats, Floats]], k: int, weights: str
) -> Floats:
    """Eq. 4, point by point."""
    moved = []
    for point in points:
        distance = [float(np.linalg.norm(point - node)) for node in ct_nodes]
        closest = sorted(range(len(ct_nodes)), key=lambda i: distance[i])[:k]
        w = [distance[i] if weights == "distance" else 1 / distance[i] for i in closest]
        total = sum(w)
        there = [motions[i][0] @ point + motions[i][1] for i in closest]
        moved.append(sum(wi / total * place for wi, place in zip(w, there, strict=True)))
    return np.array(moved)
