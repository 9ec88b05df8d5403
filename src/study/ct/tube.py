"""A cartilage as a tube: a middle line, the cheapest path between its ends, and a wall, the steepest fall around it."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree
from skimage.graph import MCP_Geometric

from study.ct.tissue import Growth
from study.errors import StudyError
from study.types import Bools, Floats, Part, Volume

JOINT_MM = 4.0  # a line's last cross-section runs on this far, to meet the sternum all around
MAX_LENGTH_MM = 130.0  # of a cartilage, end to end
N_RAYS = 36
RAY_MM = np.arange(0.5, 12.01, 0.5)


def cheapest_path(image: Volume, cost: Floats, start_mm: Floats, goal: Bools, part: Part) -> Floats:
    """Middle line (n, 3), voxels of the 1 mm grid, 1 mm apart, from a rib's end to the cheapest goal voxel.

    Args:
        image: Hounsfield units on that grid.
        cost: of a step in each voxel; see `study.ct.tissue.path_cost`.
        start_mm: (3,) the rib's end.
        goal: where the line may end.
        part: the cartilage, for messages.

    Raises:
        StudyError: no goal within `MAX_LENGTH_MM`, or a line that does not run in cartilage.
    """
    start = np.rint(image.to_index(start_mm)).astype(int)
    goals = np.argwhere(goal)
    goals = goals[np.linalg.norm(goals - start, axis=1) < MAX_LENGTH_MM]
    if len(goals) == 0:
        raise StudyError(
            f"{image.name}: expected the sternum within {MAX_LENGTH_MM:g} mm of the rib's end of {part.name.lower()}, "
            "got none; check its landmarks or labels"
        )
    low = np.maximum(np.minimum(goals.min(axis=0), start) - 15, 0)
    high = np.maximum(goals.max(axis=0), start) + 16
    mcp = MCP_Geometric(cost[tuple(slice(a, b) for a, b in zip(low, high, strict=True))])
    reach, _ = mcp.find_costs([tuple(start - low)], goals - low, find_all_ends=False)  # stops at the first goal
    end = goals[reach[tuple((goals - low).T)].argmin()]
    path = np.array(mcp.traceback(tuple(end - low)), dtype=np.float64) + low
    smooth = gaussian_filter1d(path, 5, axis=0, mode="nearest")
    smooth[[0, -1]] = path[[0, -1]]
    core = np.rint(smooth[len(path) // 5 : -max(len(path) // 5, 1)]).astype(int)
    density = float(np.median(image.values[tuple(core.T)]))
    if density < 30.0:
        raise StudyError(
            f"{image.name}: expected cartilage (about 90 HU) between the ends of {part.name.lower()}, got a median of "
            f"{density:.0f} HU; check its landmarks and the image's orientation"
        )
    return _even(smooth)


def fill_tube(soft: Floats, line: Floats, front: Floats, growth: Growth) -> Bools:
    """Voxels inside the tube around ``line`` (n, 3) whose wall has the steepest fall outwards.

    Radii are found on rays across the line and smoothed along and around it, so that no single voxel decides.

    Args:
        soft: densities of the 1 mm grid, clipped to the window of soft tissue, HU.
        line: middle line, voxels.
        front: (3,) unit normal of the chest wall, voxels.
        growth: assumptions.
    """
    turns = np.arange(N_RAYS) * (2 * np.pi / N_RAYS)
    expected = 1 / np.hypot(np.cos(turns) / growth.half_thickness_mm, np.sin(turns) / growth.half_width_mm)
    shape = ((RAY_MM[None, :] - expected[:, None]) / growth.shape_sd_mm) ** 2
    for again in (True, False):  # the second time from the centre of the first tube
        along, across, outwards = _line_frame(line, front)
        rays = np.cos(turns)[:, None] * outwards[:, None] + np.sin(turns)[:, None] * across[:, None]  # (n, rays, 3)
        radius = _wall_radius(soft, line, rays, shape, growth)
        if again:
            shift = (rays * radius[..., None] ** 3).sum(axis=1) / (1.5 * (radius**2).sum(axis=1)[:, None])
            line = _even(
                gaussian_filter1d(
                    line + gaussian_filter1d(shift, 4, axis=0, mode="nearest"), 1.5, axis=0, mode="nearest"
                )
            )
    return _voxels_inside(line, (along, across, outwards), radius, soft.shape)


def _wall_radius(soft: Floats, line: Floats, rays: Floats, shape: Floats, growth: Growth) -> Floats:
    """Radius (n, rays) mm of the steepest fall in density along each ray, less what an odd ``shape`` costs."""
    places = line[:, None, None] + rays[:, :, None] * RAY_MM[:, None]
    density = ndimage.map_coordinates(soft, places.reshape(-1, 3).T, order=1, mode="nearest").reshape(places.shape[:3])
    density = gaussian_filter1d(gaussian_filter1d(density, 2, axis=0, mode="nearest"), 1, axis=1, mode="wrap")
    fall = -np.gradient(density, RAY_MM, axis=2) / growth.edge_hu_per_mm
    radius = RAY_MM[(fall - shape).argmax(axis=2)]
    wrapped = np.concatenate([radius[:, -3:], radius, radius[:, :3]], axis=1)
    radius = ndimage.median_filter(wrapped, size=(7, 5), mode="nearest")[:, 3:-3]
    smooth: Floats = gaussian_filter1d(gaussian_filter1d(radius, 1.5, axis=0, mode="nearest"), 1, axis=1, mode="wrap")
    return smooth


def _voxels_inside(line: Floats, frame: tuple[Floats, Floats, Floats], radius: Floats, shape: tuple[int, ...]) -> Bools:
    """Voxels nearer to the line (n, 3) than its wall in their direction, and not past its ends."""
    along, across, outwards = frame
    low = np.maximum(np.floor(line.min(axis=0)).astype(int) - 13, 0)
    high = np.minimum(np.ceil(line.max(axis=0)).astype(int) + 14, shape)
    voxels = np.stack(
        np.meshgrid(*[np.arange(a, b) for a, b in zip(low, high, strict=True)], indexing="ij"), -1
    ).reshape(-1, 3)
    _, at = KDTree(line).query(voxels)
    offset = voxels - line[at]
    depth, width, beyond = (np.einsum("ij,ij->i", offset, axis[at]) for axis in (outwards, across, along))
    turn = np.arctan2(width, depth) % (2 * np.pi) * N_RAYS / (2 * np.pi)
    wall = ndimage.map_coordinates(np.concatenate([radius, radius[:, :1]], axis=1), [at, turn], order=1)
    past_end = ((at == 0) & (beyond < -0.5)) | ((at == len(line) - 1) & (beyond > JOINT_MM))
    inside = np.zeros(shape, dtype=bool)
    inside[tuple(voxels[(np.hypot(depth, width) < wall) & ~past_end].T)] = True
    return inside


def _line_frame(line: Floats, front: Floats) -> tuple[Floats, Floats, Floats]:
    """Unit vectors (n, 3) along a line, across it in the chest wall, and out of the wall."""
    along = gaussian_filter1d(np.gradient(line, axis=0), 4, axis=0, mode="nearest")
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, front)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return along, across, np.cross(across, along)


def _even(line: Floats) -> Floats:
    """The same line with points 1 mm apart."""
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    steps = np.arange(0.0, length[-1], 1.0)
    return np.stack([np.interp(steps, length, line[:, axis]) for axis in range(3)], axis=1)
