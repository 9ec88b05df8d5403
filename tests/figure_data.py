"""What the tests of figures draw: a stick chest, its graph and waypoints, a table of metrics."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.text import Text

from study.skeleton.graph import SkeletonGraph
from study.types import CARTILAGES, Mesh, PointCloud, Waypoints

METHODS = ("icp", "nonrigid_icp", "cpd", "skeleton_graph")
SOURCES = ("ct1", "ct2", "ct10")


def texts(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def chest_points(n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A stick chest in RAS+: a sternum and eight straight branches, with parts."""
    along = np.linspace(0, 1, n)
    points = [np.column_stack([0 * along, 0 * along, 40 - 80 * along])]
    parts = [np.zeros(n)]
    for part in CARTILAGES:
        side = 1 if part.side == "right" else -1
        z = 60 - 20 * part.level
        points.append(np.column_stack([side * (15 + 50 * along), -10 * along, z - 10 * along]))
        parts.append(np.full(n, int(part)))
    return np.concatenate(points), np.concatenate(parts).astype(np.int64)


POINTS, PARTS = chest_points()
FRONT = np.array([0.0, 1.0, 0.0])
CLOUD = PointCloud(POINTS, "chest", PARTS)
TETRAHEDRON = Mesh(
    np.array([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [0, 0, 30]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    np.array([0, 1, 5, 8]),
)
LABELS = tuple(f"{s}{k}-{k + 1}.{i + 1}" for s in "RL" for k, count in ((2, 3), (3, 3), (4, 4)) for i in range(count))
WAYPOINTS = Waypoints(POINTS[np.linspace(60, len(POINTS) - 1, 20).astype(int)], LABELS)
GRAPH = SkeletonGraph(POINTS[::90], np.array([[0, 1], [1, 0], [1, 2], [3, 2]]), PARTS[::90])
PAPER = pd.DataFrame({"mean": [17.35, 9.48], "sd": [3.54, 0.27]}, index=["icp", "skeleton_graph"])


def metrics(methods: tuple[str, ...] = METHODS, n_targets: int = 1) -> pd.DataFrame:
    rng = np.random.default_rng(0)
    rows = []
    for source in SOURCES:
        for target in range(n_targets):
            for method in methods:
                case = {"dataset": "phantom", "source": source, "target": f"p{target}", "method": method, "seed": 0}
                values = [("waypoint_error", i, rng.gamma(4.0)) for i in range(20)] + [("hd", 0, rng.uniform(8, 12))]
                rows += [
                    {**case, "metric": m, "index": i, "value": v, "unit": "mm", "status": "ok"} for m, i, v in values
                ]
    return pd.DataFrame(rows)


def failing(source: str = "ct2", method: str = "cpd") -> pd.DataFrame:
    """`metrics` in which one case failed."""
    whole = metrics()
    lost = (whole["source"] == source) & (whole["method"] == method)
    row = whole[lost].head(1).assign(metric="case", index=0, value=np.nan, unit="", status="failed: no sternum")
    return pd.concat([whole[~lost], row], ignore_index=True)
