"""The numbered template graph of sec. III-B, in the chest frame."""

from __future__ import annotations

import numpy as np

from study.types import ChestFrame, Floats, Part, SkeletonGraph

STERNUM_SHAPE = (18, 5)
BRANCH_ROWS = {2: (0, 1, 2), 3: (6, 7, 8), 4: (11, 12, 13), 5: (15, 16, 17)}
BRANCH_COLUMNS = {2: 5, 3: 6, 4: 7, 5: 8}
ONE_WAY_LEVELS = (4, 5)


def template_graph(frame: ChestFrame) -> SkeletonGraph:
    """The 246-node template: a sternum grid with eight three-row branches (sec. III-B).

    The paper counts 245 nodes; its authors' template, which this grid reproduces, has 246 nodes and 774
    directed edges. The vertical links of the 4th and 5th branches run one way, from the lower to the upper
    row: a winner below pulls the row above down, never the reverse.
    """
    numbers: dict[tuple[Part, int, int], int] = {}
    nodes: list[Floats] = []
    rows, columns = STERNUM_SHAPE
    pitch_left = frame.width_mm / columns
    heights = {side: _row_heights_mm(frame, (side,)) for side in ("right", "left")}
    heights[""] = _row_heights_mm(frame, ("right", "left"))

    def add(part: Part, row: int, column: int, left_mm: float) -> None:
        numbers[part, row, column] = len(nodes)
        nodes.append(frame.origin + left_mm * frame.left + heights[part.side][row] * frame.up)

    for row in range(rows):
        for column in range(columns):
            add(Part.STERNUM, row, column, (column + 0.5) * pitch_left - frame.width_mm / 2)
    for side, sign in (("right", -1.0), ("left", 1.0)):
        for level, branch_rows in BRANCH_ROWS.items():
            part, count = Part.cartilage(side, level), BRANCH_COLUMNS[level]
            for row in branch_rows:
                for column in range(count):
                    reach = (column + 0.5) / count * frame.reach_mm[part]
                    add(part, row, column, sign * (frame.width_mm / 2 + reach))

    edges: list[tuple[int, int]] = []
    for (part, row, column), node in numbers.items():
        if part == Part.STERNUM or column > 0:
            medial = numbers.get((part, row, column - 1))
        else:  # a branch starts at the sternum's edge column of its side
            medial = numbers[Part.STERNUM, row, 0 if part.side == "right" else columns - 1]
        if medial is not None:
            edges += [(medial, node), (node, medial)]
        above = numbers.get((part, row - 1, column))
        if above is not None:
            edges.append((node, above))
            if part.level not in ONE_WAY_LEVELS:
                edges.append((above, node))
    parts = np.array([int(part) for part, _, _ in numbers], dtype=np.int64)
    return SkeletonGraph(np.array(nodes), np.array(edges, dtype=np.int64), parts)


def _row_heights_mm(frame: ChestFrame, sides: tuple[str, ...]) -> Floats:
    """Height of every grid row: each level's middle row at the measured root of its cartilage, the others between."""
    middle = np.array([rows[1] for rows in BRANCH_ROWS.values()], dtype=np.float64)
    roots = np.array([np.mean([frame.root_mm[Part.cartilage(side, level)] for side in sides]) for level in BRANCH_ROWS])
    pitch = (roots[-1] - roots[0]) / (middle[-1] - middle[0])
    rows = np.arange(STERNUM_SHAPE[0], dtype=np.float64)
    heights = np.interp(rows, middle, roots)
    heights += pitch * (np.minimum(rows - middle[0], 0.0) + np.maximum(rows - middle[-1], 0.0))
    return heights
