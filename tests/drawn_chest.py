"""A chest drawn voxel by voxel: a CT of it, its rib labels, its parts and its landmarks."""

from __future__ import annotations

import numpy as np

from study.ct.landmarks import Landmarks
from study.ct.parts import rib_name
from study.data.manifest import load_manifest
from study.types import CARTILAGES, Part, RigidTransform, Volume

IDS = load_manifest().label_ids("ribseg_v2")
SPACING = np.array([1.4, 1.4, 2.0])
SHAPE = (150, 90, 84)
FRAME = RigidTransform(translation=np.array([-105.0, -85.0, -85.0]))
HEIGHTS = {2: (45.0, 5.0), 3: (20.0, -4.0), 4: (-5.0, -10.0), 5: (-28.0, -22.0)}  # sternal end, drop to the rib


def junction(part: Part) -> np.ndarray:
    height, drop = HEIGHTS[part.level]
    return np.array([(1 if part.side == "right" else -1) * 62.0, 2.0, height + drop])


def attachment(part: Part) -> np.ndarray:
    return np.array([(1 if part.side == "right" else -1) * 15.0, 10.0, HEIGHTS[part.level][0]])


def tube(grid: np.ndarray, a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    along = np.clip(((grid - a) @ (b - a)) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(grid - a - along[..., None] * (b - a), axis=-1) < radius


def draw() -> tuple[Volume, Volume, np.ndarray]:
    """A CT (fat, lung, muscle, cartilage, bone, noise), its rib labels, and the true parts."""
    blank = Volume(np.zeros(SHAPE, np.int16), SPACING, FRAME, "drawn")
    grid = blank.to_mm(np.moveaxis(np.indices(SHAPE), 0, -1).reshape(-1, 3)).reshape(*SHAPE, 3)
    x, y, _ = np.moveaxis(grid, -1, 0)
    wall = 10.0 - 8.0 * (x / 62.0) ** 2  # middle of the sheet
    hu = np.full(SHAPE, -1000.0)
    hu[y < wall + 25] = -100.0
    hu[(y > wall + 5.5) & (y < wall + 10)] = 55.0
    hu[(y < wall - 8) & (np.abs(x) > 25)] = -850.0
    parts = np.full(SHAPE, int(Part.UNKNOWN))
    labels = np.zeros(SHAPE, np.int16)
    for part in CARTILAGES:
        end = junction(part)
        cartilage = tube(grid, attachment(part) * (0.7, 1, 1), end, 5.5)
        hu[cartilage] = 95.0
        parts[cartilage] = part
        rib = tube(grid, end, end + np.array([np.sign(end[0]) * 30.0, -45.0, 6.0]), 5.0)
        hu[rib] = 450.0
        labels[rib] = IDS[rib_name(part.side, part.level)]
        parts[rib] = Part.UNKNOWN
    sternum = (np.abs(x) < 14) & (np.abs(y - 10) < 6.5) & (grid[..., 2] > -60) & (grid[..., 2] < 70)
    marrow = (np.abs(x) < 11) & (np.abs(y - 10) < 3.5) & (grid[..., 2] > -57) & (grid[..., 2] < 67)
    hu[sternum], parts[sternum] = 400.0, Part.STERNUM
    hu[marrow] = 20.0
    parts[(parts == Part.STERNUM) & ((grid[..., 2] > 50.5) | (grid[..., 2] < -33.5))] = Part.UNKNOWN
    hu += np.random.default_rng(0).normal(scale=12.0, size=SHAPE)
    return blank.with_values(hu.astype(np.float32)), blank.with_values(labels), parts


def drawn_landmarks() -> Landmarks:
    return Landmarks(
        "drawn",
        {part: junction(part) for part in CARTILAGES},
        {part: attachment(part) for part in CARTILAGES},
        np.array([[0.0, 10.0, 55.0], [0.0, 10.0, -40.0]]),
        "test",
        "drawn",
    )
