"""Cartilage out of a CT alone (sec. II-C.1 without hands): landmarks → sternum → middle lines → cartilages.

Cartilage is barely denser than muscle (about 90 against 55 HU), so a threshold alone floods the chest wall. What
finds it is where it must be: a tube about 10 mm thick from the end of a bony rib to the edge of the sternum. The
ends come from per-rib labels (`landmarks_from_ribs`) or from a recorded file (`study.files.landmarks`); then

1. the sternum is the bone around the midline, its shell filled slice by slice;
2. a cartilage's middle line is the cheapest path between its ends, where fat, lung and muscle cost more;
3. its wall is, in every direction across that line, the steepest fall in density near the radius of a flat tube.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

import numpy as np
from scipy import ndimage
from skimage.graph import MCP_Geometric
from skimage.morphology import disk

from study.ct.landmarks import Landmarks
from study.ct.parts import check_field_of_view, check_rib_labels, rib_name, span_sternum
from study.ct.tissue import Growth, check_in_tissue, isotropic, path_cost
from study.ct.tube import cheapest_path, fill_tube
from study.errors import StudyError
from study.geometry.points import largest_component
from study.types import CARTILAGES, Bools, Floats, Part, Volume

ATTACHED_MM = 8  # a recorded attachment is that close to the bone it belongs to
AHEAD_MM = (0.0, 10.0, 20.0)  # of the plane through the rib ends lies the sternum: the rounder the chest, the more


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
        StudyError: labels missing or swapped (`study.ct.parts.check_rib_labels`), not in Hounsfield units, no bone
            between the ribs' ends, or a rib from whose end no path reaches the sternum.
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
    image = isotropic(ct, np.vstack([ends, *lines]))
    line, sternum = _first_sternum(image, lines, growth)
    cost = path_cost(image, _mask_on_grid(_rib_mask(labels, ids), image), growth)
    attachments = {}
    for part in CARTILAGES:
        path = cheapest_path(image, cost, junctions[part], sternum, part)
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
        rib = largest_component(one.values == label)
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
        bone = largest_component(ndimage.binary_opening(ndimage.binary_fill_holes(bone), disk(3)))
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
    return largest_component(ndimage.gaussian_filter(field, (1.0, 1.0, 3.0)) > 0)


def _grow(ct: Volume, landmarks: Landmarks, growth: Growth, ribs: Volume | None) -> Volume:
    points = np.vstack([*landmarks.junctions.values(), *landmarks.attachments.values(), landmarks.sternum])
    image = isotropic(ct, points)
    check_in_tissue(image, landmarks)
    sternum = find_sternum(image, landmarks.sternum, growth)
    bone = np.zeros(image.shape, dtype=bool) if ribs is None else _mask_on_grid(ribs, image)
    cost = path_cost(image, bone, growth)
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
        line = cheapest_path(image, cost, landmarks.junctions[part], goal, part)
        inside = fill_tube(soft, line, front, growth) & ~sternum & ~bone & (parts == Part.UNKNOWN)
        parts[largest_component(ndimage.binary_opening(inside))] = part
    to_sternum = ndimage.distance_transform_edt(~sternum)
    parts[span_sternum(image, sternum, parts, to_sternum) & (parts == Part.UNKNOWN)] = Part.STERNUM
    mask = Volume(parts, image.spacing_mm, image.T_ras_index, ct.name)
    check_field_of_view(mask, ct)
    return mask


def _rib_mask(labels: Volume, ids: Mapping[str, int]) -> Volume:
    return labels.with_values(
        np.isin(labels.values, [value for name, value in ids.items() if name.startswith("rib_")]).astype(np.uint8)
    )


def _mask_on_grid(mask: Volume, image: Volume) -> Bools:
    """A 0/1 mask, whose axes are the image's, on its grid; smooth edges, unlike the nearest voxels of `on_grid`."""
    start = mask.to_index(image.to_mm([[0, 0, 0]]))[0]
    step = image.spacing_mm / mask.spacing_mm
    low = np.maximum(np.floor(start).astype(int) - 1, 0)
    high = np.ceil(start + step * np.array(image.shape)).astype(int) + 2
    box = mask.crop(low, high).values.astype(np.float32)
    inside: Bools = ndimage.affine_transform(box, step, offset=start - low, output_shape=image.shape, order=1) > 0.5
    return inside
