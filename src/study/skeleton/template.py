"""The numbered template graph of sec. III-B, in the chest frame."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from study.alignment.frame import ChestFrame
from study.skeleton.graph import SkeletonGraph
from study.types import Floats, Part

# Rows from the head down, columns of the sternum from right to left and of the branches outwards.
STERNUM_SHAPE = (18, 5)
BRANCH_ROWS = {2: (0, 1, 2), 3: (6, 7, 8), 4: (11, 12, 13), 5: (15, 16, 17)}  # by level
BRANCH_COLUMNS = {2: 5, 3: 6, 4: 7, 5: 8}  # by level
ONE_WAY_LEVELS = (4, 5)  # of the vertical links
N_NODES = STERNUM_SHAPE[0] * STERNUM_SHAPE[1] + 2 * sum(len(BRANCH_ROWS[k]) * BRANCH_COLUMNS[k] for k in BRANCH_ROWS)

_Place = tuple[Part, int, int]  # part, row and column in the grid


def template_graph(frame: ChestFrame) -> SkeletonGraph:
    """The 246-node template in a chest's frame: a sternum grid with eight three-row branches (sec. III-B).

    The paper counts 245 nodes; its authors' template, which this grid reproduces, has 246 nodes and 774
    directed edges. The vertical links of the 4th and 5th branches run one way, from the lower to the upper
    row: a winner below pulls the row above down, never the reverse.

    Args:
        frame: where the sternum lies and how far the cartilages reach, in the cloud's frame.

    Returns:
        the graph with nodes in the cloud's frame, mm.
    """
    heights = {side: _row_heights_mm(frame, (side,)) for side in ("right", "left")}
    heights[""] = _row_heights_mm(frame, ("right", "left"))
    across = _columns_mm(frame)
    nodes = [
        frame.origin + left_mm * frame.left + heights[part.side][row] * frame.up
        for (part, row, _), left_mm in across.items()
    ]
    parts = np.array([int(part) for part, _, _ in across], dtype=np.int64)
    edges = _links({place: node for node, place in enumerate(across)})
    return SkeletonGraph(np.array(nodes), np.array(edges, dtype=np.int64), parts)


def _columns_mm(frame: ChestFrame) -> dict[_Place, float]:
    """Every place of the grid in the order of the nodes, and how far left of the origin it lies, mm."""
    rows, columns = STERNUM_SHAPE
    pitch_left = frame.width_mm / columns
    across: dict[_Place, float] = {}
    for row in range(rows):
        for column in range(columns):
            across[Part.STERNUM, row, column] = (column + 0.5) * pitch_left - frame.width_mm / 2
    for side, sign in (("right", -1.0), ("left", 1.0)):
        for level, branch_rows in BRANCH_ROWS.items():
            part, count = Part.cartilage(side, level), BRANCH_COLUMNS[level]
            for row in branch_rows:
                for column in range(count):
                    reach = (column + 0.5) / count * frame.reach_mm[part]
                    across[part, row, column] = sign * (frame.width_mm / 2 + reach)
    return across


def _links(numbers: Mapping[_Place, int]) -> list[tuple[int, int]]:
    """Directed edges between the numbered places: along the rows, up the columns, and from branch to sternum."""
    edges: list[tuple[int, int]] = []
    for (part, row, column), node in numbers.items():
        if part == Part.STERNUM or column > 0:
            medial = numbers.get((part, row, column - 1))
        else:  # a branch starts at the sternum's edge column of its side
            medial = numbers[Part.STERNUM, row, 0 if part.side == "right" else STERNUM_SHAPE[1] - 1]
        if medial is not None:
            edges += [(medial, node), (node, medial)]
        above = numbers.get((part, row - 1, column))
        if above is not None:
            edges.append((node, above))
            if part.level not in ONE_WAY_LEVELS:
                edges.append((above, node))
    return edges


def _row_heights_mm(frame: ChestFrame, sides: tuple[str, ...]) -> Floats:
    """Height of every grid row: each level's middle row at the measured root of its cartilage, the others between."""
    middle = np.array([rows[1] for rows in BRANCH_ROWS.values()], dtype=np.float64)
    roots = np.array([np.mean([frame.root_mm[Part.cartilage(side, level)] for side in sides]) for level in BRANCH_ROWS])
    pitch = (roots[-1] - roots[0]) / (middle[-1] - middle[0])
    rows = np.arange(STERNUM_SHAPE[0], dtype=np.float64)
    heights: Floats = np.interp(rows, middle, roots)
    heights += pitch * (np.minimum(rows - middle[0], 0.0) + np.maximum(rows - middle[-1], 0.0))
    return heights
