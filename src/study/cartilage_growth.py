"""Cartilage out of a CT alone (sec. II-C.1 without hands): landmarks → sternum → middle lines → cartilages.

Cartilage is barely denser than muscle (about 90 against 55 HU), so a threshold alone floods the chest wall. What
finds it is where it must be: a tube about 10 mm thick from the end of a bony rib to the edge of the sternum. The
ends come from per-rib labels (`landmarks_from_ribs`) or from a recorded file (`study.data.landmarks`); then

1. the sternum is the bone around the midline, its shell filled slice by slice;
2. a cartilage's middle line is the cheapest path between its ends, where fat, lung and muscle cost more;
3. its wall is, in every direction across that line, the steepest fall in density near the radius of a flat tube.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree
from skimage.graph import MCP_Geometric
from skimage.morphology import disk

from study.ct import check_field_of_view, check_rib_labels, rib_name, span_sternum
from study.data.landmarks import Landmarks
from study.errors import StudyError
from study.types import CARTILAGES, Bools, Floats, Part, RigidTransform, Volume

GRID_MM = 1.0  # all of this is done on an isotropic grid, so that voxels are millimetres
MARGIN_MM = 25.0  # around the landmarks
AIR_HU = -200.0  # a chest CT in Hounsfield units has lung and room air far below this
JOINT_MM = 4.0  # a line's last cross-section runs on this far, to meet the sternum all around
ATTACHED_MM = 8  # a recorded attachment is that close to the bone it belongs to
MAX_LENGTH_MM = 130.0  # of a cartilage, end to end
AHEAD_MM = (0.0, 10.0, 20.0)  # of the plane through the rib ends lies the sternum: the rounder the chest, the more
N_RAYS = 36
RAY_MM = np.arange(0.5, 12.01, 0.5)


@dataclass(frozen=True)
class Growth:
    """What the growth assumes of adult anatomy and of Hounsfield units.

    Attributes:
        bone_hu: the sternum's shell is denser than this, uncalcified cartilage (92 ± 25) is not.
        sternum_depth_mm: bone farther than this from the midline, front or back, is no sternum.
        sternum_half_width_mm: the same to the sides.
        sternum_reach_mm: slices whose shell is open, at the joints, borrow their outline from this far up and down.
        muscle_hu: on the middle line, tissue below this is expensive; muscle is about 55.
        window_hu: densities outside are clipped before edges are sought: calcification and lung are no steeper than
            muscle.
        edge_hu_per_mm: slope that counts as much as lying one ``shape_sd_mm`` off the expected radius.
        shape_sd_mm: see there.
        half_thickness_mm: expected radius across the chest wall.
        half_width_mm: expected radius along it.
    """

    bone_hu: float = 150.0
    sternum_depth_mm: float = 14.0
    sternum_half_width_mm: float = 28.0
    sternum_reach_mm: float = 10.0
    muscle_hu: float = 60.0
    window_hu: tuple[float, float] = (20.0, 120.0)
    edge_hu_per_mm: float = 20.0
    shape_sd_mm: float = 4.0
    half_thickness_mm: float = 5.0
    half_width_mm: float = 6.5


def parts_from_ribs(ct: Volume, labels: Volume, ids: Mapping[str, int], growth: Growth | None = None) -> Volume:
    """Sternum and cartilages 2-5 from a CT and rib labels (RibSeg's, or any with a label map).

    Args:
        ct: Hounsfield units.
        labels: rib labels on the CT's grid; cartilage and sternum labels are not used.
        ids: label ids of ``rib_<side>_<level>``, 2-5 at least.
        growth: assumptions; the defaults when None.

    Returns:
        int8 `Part` values on a 1 mm grid along the CT's axes, `Part.UNKNOWN` outside.

    Raises:
        StudyError: as `landmarks_from_ribs` and `parts_from_landmarks`.
    """
    growth = growth or Growth()
    landmarks = landmarks_from_ribs(ct, labels, ids, growth)
    return _grow(ct, landmarks, growth, _rib_mask(labels, ids))


def parts_from_landmarks(ct: Volume, landmarks: Landmarks, growth: Growth | None = None) -> Volume:
    """Sternum and cartilages 2-5 from a CT and recorded landmarks; the same growth as `parts_from_ribs`.

    Raises:
        StudyError: not in Hounsfield units; a landmark outside the image, or not in tissue; no bone along the
            sternum; a part cut off by the field of view. The message names which.
    """
    return _grow(ct, landmarks, growth or Growth(), None)


def landmarks_from_ribs(ct: Volume, labels: Volume, ids: Mapping[str, int], growth: Growth | None = None) -> Landmarks:
    """Junctions, sternal attachments and the sternum's midline from a CT and rib labels.

    A junction is the end of a rib farthest from the spine. The sternum lies half-way between the junctions of the
    two sides; a cartilage is attached where the cheapest path from its junction reaches the sternum.

    Raises:
        StudyError: labels missing or swapped (`study.ct.check_rib_labels`), not in Hounsfield units, no bone between
            the ribs' ends, or a rib from whose end no path reaches the sternum.
    """
    growth = growth or Growth()
    check_rib_labels(labels, ids)
    junctions = rib_ends(labels, ids)
    ends = np.array([junctions[part] for part in CARTILAGES])
    middle = (ends[:4] + ends[4:]) / 2
    line_x = np.polyfit(middle[:, 2], middle[:, 0], 1)
    plane = np.linalg.lstsq(np.c_[np.ones(8), ends[:, [0, 2]]], ends[:, 1], rcond=None)[0]
    heights = np.array([ends[:, 2].max() + 20.0, ends[:, 2].min() - 5.0])  # the attachments are higher than the ends
    line = np.stack([np.polyval(line_x, heights), np.zeros(2), heights], axis=1)
    line[:, 1] = np.c_[np.ones(2), line[:, [0, 2]]] @ plane
    lines = [line + np.array([0.0, ahead, 0.0]) for ahead in AHEAD_MM]
    image = _isotropic(ct, np.vstack([ends, *lines]))
    line, sternum = _first_sternum(image, lines, growth)
    cost = _path_cost(image, _on_grid(_rib_mask(labels, ids), image), growth)
    attachments = {}
    for part in CARTILAGES:
        path = _cheapest_path(image, cost, junctions[part], sternum, part)
        attachments[part] = image.to_mm(path[-1:])[0]
    return Landmarks(ct.name, junctions, attachments, line, "landmarks_from_ribs", "from rib labels")


def _first_sternum(image: Volume, lines: list[Floats], growth: Growth) -> tuple[Floats, Bools]:
    """The first midline (p, 3) mm around which there is a sternum, and that sternum."""
    for line in lines[:-1]:
        with suppress(StudyError):
            return line, find_sternum(image, line, growth)
    return lines[-1], find_sternum(image, lines[-1], growth)


def rib_ends(labels: Volume, ids: Mapping[str, int]) -> dict[Part, Floats]:
    """The bone-cartilage junction (3,) mm of ribs 2-5: the end farthest from the spine along the rib."""
    boxes = ndimage.find_objects(np.asarray(labels.values, dtype=np.int32))
    ends = {}
    for part in CARTILAGES:
        label = ids[rib_name(part.side, part.level)]
        box = boxes[label - 1]
        one = labels.crop([s.start - 1 for s in box], [s.stop + 1 for s in box])
        rib = _largest(one.values == label)
        voxels = np.argwhere(rib)
        points = one.to_mm(voxels)
        mcp = MCP_Geometric(np.where(rib, 1.0, np.inf), sampling=tuple(one.spacing_mm))
        along = mcp.find_costs([tuple(voxels[points[:, 1].argmin()])])[0][rib]  # from the hindmost voxel
        ends[part] = points[along > along.max() - 4.0].mean(axis=0)
    return ends


def find_sternum(image: Volume, line: Floats, growth: Growth) -> Bools:
    """The sternum around its midline.

    Each slice's shell of bone is filled. Where the shell is open (at the joints) or runs on into calcified
    cartilage, the median outline of the slices up and down is right, so it is taken everywhere.

    Args:
        image: Hounsfield units on a 1 mm grid.
        line: (p, 3) mm, from top to bottom.
        growth: assumptions.

    Raises:
        StudyError: no closed outline of bone in a fifth of the slices between the line's ends.
    """
    path = image.to_index(line)[::-1]
    k = np.arange(image.shape[2])
    x, y = (np.interp(k, path[:, 2], path[:, axis]) for axis in (0, 1))
    low, high = max(0, int(path[0, 2]) - 5), min(image.shape[2], int(path[-1, 2]) + 6)
    smooth = ndimage.gaussian_filter(image.values, 0.7)
    i, j = np.ogrid[: image.shape[0], : image.shape[1]]
    outline = np.full(image.shape, np.nan, dtype=np.float32)
    for slice_ in range(low, high):
        near = (np.abs(i - x[slice_]) < growth.sternum_half_width_mm) & (
            np.abs(j - y[slice_]) < growth.sternum_depth_mm
        )
        bone = ndimage.binary_closing((smooth[:, :, slice_] > growth.bone_hu) & near, disk(2))
        bone = _largest(ndimage.binary_opening(ndimage.binary_fill_holes(bone), disk(3)))
        if bone.sum() > 100:  # mm²; the sternum is about 30 x 12 mm
            outline[:, :, slice_] = ndimage.distance_transform_edt(bone) - ndimage.distance_transform_edt(~bone)
    closed = np.flatnonzero(np.isfinite(outline[0, 0]))
    if len(closed) < 0.2 * (high - low):
        raise StudyError(
            f"{image.name}: expected a sternum (a closed shell above {growth.bone_hu:g} HU) along its midline, got "
            f"one in {len(closed)} of {high - low} mm; check the landmarks, and that the image is in Hounsfield units"
        )
    field = np.full(image.shape, -9.0, dtype=np.float32)
    reach = int(growth.sternum_reach_mm)
    for slice_ in range(low, high):
        rows = closed[np.abs(closed - slice_) <= reach]
        if len(rows) < 3:
            rows = closed[np.abs(closed - slice_).argsort()[:3]]
        field[:, :, slice_] = np.median(outline[:, :, rows], axis=2)
    return _largest(ndimage.gaussian_filter(field, (1.0, 1.0, 3.0)) > 0)


def _grow(ct: Volume, landmarks: Landmarks, growth: Growth, ribs: Volume | None) -> Volume:
    points = np.vstack([*landmarks.junctions.values(), *landmarks.attachments.values(), landmarks.sternum])
    image = _isotropic(ct, points)
    _check_in_tissue(image, landmarks)
    sternum = find_sternum(image, landmarks.sternum, growth)
    bone = np.zeros(image.shape, dtype=bool) if ribs is None else _on_grid(ribs, image)
    cost = _path_cost(image, bone, growth)
    ends = np.array([[*landmarks.junctions[p], *landmarks.attachments[p]] for p in CARTILAGES]).reshape(-1, 3)
    ends = image.to_index(ends)
    plane = np.linalg.lstsq(np.c_[np.ones(len(ends)), ends[:, [0, 2]]], ends[:, 1], rcond=None)[0]
    front = np.array([-plane[1], 1.0, -plane[2]]) / np.linalg.norm([plane[1], 1.0, plane[2]])
    parts = np.full(image.shape, int(Part.UNKNOWN), dtype=np.int8)
    low, high = growth.window_hu
    soft = ndimage.gaussian_filter(image.values.clip(low, high), 0.7)
    for part in CARTILAGES:
        end = np.rint(image.to_index(landmarks.attachments[part])).astype(int)
        goal = np.zeros(image.shape, dtype=bool)
        near = tuple(slice(max(i - ATTACHED_MM, 0), i + ATTACHED_MM + 1) for i in end)
        goal[near] = sternum[near]
        goal[tuple(end)] |= not goal.any()
        line = _cheapest_path(image, cost, landmarks.junctions[part], goal, part)
        tube = _tube(soft, line, front, growth) & ~sternum & ~bone & (parts == Part.UNKNOWN)
        parts[_largest(ndimage.binary_opening(tube))] = part
    to_sternum = ndimage.distance_transform_edt(~sternum)
    parts[span_sternum(image, sternum, parts, to_sternum) & (parts == Part.UNKNOWN)] = Part.STERNUM
    mask = Volume(parts, image.spacing_mm, image.T_ras_index, ct.name)
    check_field_of_view(mask, ct)
    return mask


def _tube(soft: Floats, line: Floats, front: Floats, growth: Growth) -> Bools:
    """Voxels inside the tube around ``line`` (n, 3) whose wall has the steepest fall outwards.

    Radii are found on rays across the line and smoothed along and around it, so that no single voxel decides.
    """
    turns = np.arange(N_RAYS) * (2 * np.pi / N_RAYS)
    expected = 1 / np.hypot(np.cos(turns) / growth.half_thickness_mm, np.sin(turns) / growth.half_width_mm)
    shape = ((RAY_MM[None, :] - expected[:, None]) / growth.shape_sd_mm) ** 2
    for again in (True, False):  # the second time from the centre of the first tube
        along, across, outwards = _line_frame(line, front)
        rays = np.cos(turns)[:, None] * outwards[:, None] + np.sin(turns)[:, None] * across[:, None]  # (n, rays, 3)
        places = line[:, None, None] + rays[:, :, None] * RAY_MM[:, None]
        density = ndimage.map_coordinates(soft, places.reshape(-1, 3).T, order=1, mode="nearest").reshape(
            places.shape[:3]
        )
        density = gaussian_filter1d(gaussian_filter1d(density, 2, axis=0, mode="nearest"), 1, axis=1, mode="wrap")
        fall = -np.gradient(density, RAY_MM, axis=2) / growth.edge_hu_per_mm
        radius = RAY_MM[(fall - shape).argmax(axis=2)]
        wrapped = np.concatenate([radius[:, -3:], radius, radius[:, :3]], axis=1)
        radius = ndimage.median_filter(wrapped, size=(7, 5), mode="nearest")[:, 3:-3]
        radius = gaussian_filter1d(gaussian_filter1d(radius, 1.5, axis=0, mode="nearest"), 1, axis=1, mode="wrap")
        if again:
            shift = (rays * radius[..., None] ** 3).sum(axis=1) / (1.5 * (radius**2).sum(axis=1)[:, None])
            line = _even(
                gaussian_filter1d(
                    line + gaussian_filter1d(shift, 4, axis=0, mode="nearest"), 1.5, axis=0, mode="nearest"
                )
            )
    low = np.maximum(np.floor(line.min(axis=0)).astype(int) - 13, 0)
    high = np.minimum(np.ceil(line.max(axis=0)).astype(int) + 14, soft.shape)
    voxels = np.stack(
        np.meshgrid(*[np.arange(a, b) for a, b in zip(low, high, strict=True)], indexing="ij"), -1
    ).reshape(-1, 3)
    _, at = KDTree(line).query(voxels)
    offset = voxels - line[at]
    depth, width, beyond = (np.einsum("ij,ij->i", offset, axis[at]) for axis in (outwards, across, along))
    turn = np.arctan2(width, depth) % (2 * np.pi) * N_RAYS / (2 * np.pi)
    wall = ndimage.map_coordinates(np.concatenate([radius, radius[:, :1]], axis=1), [at, turn], order=1)
    past_end = ((at == 0) & (beyond < -0.5)) | ((at == len(line) - 1) & (beyond > JOINT_MM))
    inside = np.zeros(soft.shape, dtype=bool)
    inside[tuple(voxels[(np.hypot(depth, width) < wall) & ~past_end].T)] = True
    return inside


def _line_frame(line: Floats, front: Floats) -> tuple[Floats, Floats, Floats]:
    """Unit vectors (n, 3) along a line, across it in the chest wall, and out of the wall."""
    along = gaussian_filter1d(np.gradient(line, axis=0), 4, axis=0, mode="nearest")
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, front)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return along, across, np.cross(across, along)


def _check_in_tissue(image: Volume, landmarks: Landmarks) -> None:
    """A cartilage's ends lie in tissue, not in fat, lung or air."""
    smooth = ndimage.gaussian_filter(image.values.clip(-200, 400), 3.0)
    for what, points in (("junction", landmarks.junctions), ("attachment", landmarks.attachments)):
        for part, point in points.items():
            density = ndimage.map_coordinates(smooth, image.to_index(point)[:, None], order=1, mode="nearest")[0]
            if density < 0.0:
                raise StudyError(
                    f"{image.name}: expected cartilage or bone at the {what} of {part.name.lower()}, got {density:.0f} "
                    f"HU at {np.round(point, 1).tolist()} mm (fat or lung); check the landmark and the orientation"
                )


def _path_cost(image: Volume, ribs: Bools, growth: Growth) -> Floats:
    smooth = ndimage.gaussian_filter(image.values.clip(-200, 400), 2.0)
    cost = 1 + 30 / (1 + np.exp((smooth - growth.muscle_hu + 20) / 10))
    cost[smooth < 0] = 100.0  # fat and lung
    cost[ribs] = 5.0
    return cost


def _cheapest_path(image: Volume, cost: Floats, start_mm: Floats, goal: Bools, part: Part) -> Floats:
    """Middle line (n, 3), voxels of the grid, 1 mm apart, from a rib's end to the cheapest goal voxel."""
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


def _even(line: Floats) -> Floats:
    """The same line with points 1 mm apart."""
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    steps = np.arange(0.0, length[-1], 1.0)
    return np.stack([np.interp(steps, length, line[:, axis]) for axis in range(3)], axis=1)


def _isotropic(ct: Volume, points: Floats) -> Volume:
    """The box around ``points`` on a 1 mm grid along the CT's axes.

    Raises:
        StudyError: not in Hounsfield units, or points outside the image.
    """
    index = ct.to_index(points)
    outside = ((index < -0.5) | (index > np.array(ct.shape) - 0.5)).any(axis=1)
    if outside.any():
        first = points[outside][0].round(1).tolist()
        raise StudyError(
            f"{ct.name}: expected every landmark inside the image, got {outside.sum()} outside (first {first} mm); "
            "the field of view ends before, or they belong to another scan"
        )
    margin = MARGIN_MM / ct.spacing_mm
    low, high = np.floor(index.min(axis=0) - margin), np.ceil(index.max(axis=0) + margin) + 1
    box = ct.crop(low.astype(int), high.astype(int))
    shape = tuple(int(n) for n in np.floor((np.array(box.shape) - 1) * box.spacing_mm / GRID_MM) + 1)
    step = GRID_MM / box.spacing_mm
    values = ndimage.affine_transform(box.values, step, output_shape=shape, order=1, output=np.float32)
    if values.min() > AIR_HU:
        raise StudyError(
            f"{ct.name}: expected Hounsfield units, with lung below {AIR_HU:g}, got a minimum of {values.min():.0f} "
            "in the chest; subtract the scanner's offset"
        )
    return Volume(
        values, np.full(3, GRID_MM), RigidTransform(box.T_ras_index.rotation, box.to_mm([[0, 0, 0]])[0]), ct.name
    )


def _rib_mask(labels: Volume, ids: Mapping[str, int]) -> Volume:
    return labels.with_values(
        np.isin(labels.values, [value for name, value in ids.items() if name.startswith("rib_")]).astype(np.uint8)
    )


def _on_grid(mask: Volume, image: Volume) -> Bools:
    """A 0/1 mask, whose axes are the image's, on its grid."""
    start = mask.to_index(image.to_mm([[0, 0, 0]]))[0]
    step = image.spacing_mm / mask.spacing_mm
    low = np.maximum(np.floor(start).astype(int) - 1, 0)
    high = np.ceil(start + step * np.array(image.shape)).astype(int) + 2
    box = mask.crop(low, high).values.astype(np.float32)
    return ndimage.affine_transform(box, step, offset=start - low, output_shape=image.shape, order=1) > 0.5


def _largest(mask: Bools) -> Bools:
    pieces, n = ndimage.label(mask)
    return mask if n <= 1 else pieces == np.bincount(pieces.ravel())[1:].argmax() + 1
