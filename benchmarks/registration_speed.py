"""The compiled SOM kernel against literal Eq. 2; `scale.py` has what whole registrations cost.

    python benchmarks/registration_speed.py

Times are processor time of one thread after a first run (which compiles); the ratio is measured in the same process.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from threadpoolctl import threadpool_limits

from study import phantom
from study.params import PHANTOM_SEED
from study.skeleton.graph import SkeletonGraph
from study.skeleton.som import SomParams, fit_som, neighbourhood
from study.types import PointCloud


def processor_seconds(run: Callable[[], object], repeats: int = 3) -> float:
    """The median processor time (s) of some calls, after one that compiles and loads."""
    run()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return float(np.median(times))


def literal_epoch(nodes: np.ndarray, points: np.ndarray, theta: np.ndarray, rate: float) -> None:
    for point in points:
        winner = np.argmin(((point - nodes) ** 2).sum(axis=1))
        nodes += theta[winner][:, None] * rate * (point - nodes)  # Eq. 2


def main() -> None:
    ct = phantom.reference_cloud(phantom.draw_subject("ct1", PHANTOM_SEED), 9000, np.random.default_rng(0))
    with threadpool_limits(1):
        rng = np.random.default_rng(2)
        nodes, hops = rng.normal(scale=40.0, size=(246, 3)), rng.integers(0, 20, (246, 246))
        graph = SkeletonGraph(nodes, np.array([[i, i + 1] for i in range(245)]), np.zeros(246, dtype=np.int64))
        params = SomParams(epochs=400, samples=500, pretrain_epochs=0)
        drawn = ct.points[rng.integers(len(ct), size=(400, 500))]
        theta = neighbourhood(hops, 3.0)

        def literal() -> None:
            moving = nodes.copy()
            for epoch in drawn:
                literal_epoch(moving, epoch, theta, 0.1)

        fast = processor_seconds(lambda: fit_som(graph, PointCloud(ct.points), params, np.random.default_rng(3)))
        slow = processor_seconds(literal, 1)
    print(f"200,000 updates of Eq. 2: literal {slow:.2f} s, compiled {fast:.3f} s, ratio {slow / fast:.0f}")


if __name__ == "__main__":
    main()
