"""From CT labels to the parts of the region of interest (sec. II-C.1).

The paper cuts the cartilages of ribs 2-5 and the sternum between them out of a surface by hand. Here the same
region of interest comes from label volumes: a cartilage starts at its rib's bone-cartilage junction, the 5th is cut
from the arch of ribs 6-10, and the sternum spans from the upper edge of the 2nd cartilages to the lower edge of the
5th. A mask of parts is a `Volume` whose values are `Part`s, `Part.UNKNOWN` outside.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.graph import MCP_Geometric
from skimage.segmentation import watershed

from study.errors import StudyError
from study.geometry.points import largest_component
from study.types import Bools, Floats, Ints, Part, Volume

SIDES = ("right", "left")
JUNCTION_GAP_MM = 5.0  # label sets leave up to two voxels between a rib's end and its cartilage
STERNUM_GAP_MM = 15.0  # beyond this a cartilage does not reach the sternum: it is cut off or mislabelled
ATTACHMENT_MM = 3.0  # a cartilage's sternal end: its voxels this close to the nearest one
MIN_CONTACT = 10  # voxels; fewer is a stray touch of two labels, not a junction


def rib_name(side: str, level: int) -> str:
    """The name of a rib in label maps: ``"rib_left_5"``."""
    return f"rib_{side}_{level}"


def parts_from_labels(labels: Volume, ids: Mapping[str, int]) -> Volume:
    """The region of interest of sec. II-C.1 from a label volume.

    Args:
        labels: integer ids on the CT's grid.
        ids: ids of ``sternum``, ``costal_cartilages`` and ``rib_<side>_<level>`` (2-5 needed; 6-10 cut off the arch).

    Returns:
        int8 `Part` values, cropped to the anterior chest; `Part.UNKNOWN` outside the region of interest.

    Raises:
        StudyError: a name missing from ``ids`` or from the volume, sides or levels swapped, a cartilage that is
            missing, does not reach the sternum, or is cut off by the field of view: the message names which.
    """
    check_rib_labels(labels, ids, ("sternum", "costal_cartilages"))
    wanted = np.isin(labels.values, [ids["sternum"], ids["costal_cartilages"]])
    box = [np.flatnonzero(wanted.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    margin = np.ceil(10.0 / labels.spacing_mm).astype(int)
    roi = labels.crop([b[0] for b in box] - margin, [b[-1] + 1 for b in box] + margin)
    parts = np.full(roi.shape, int(Part.UNKNOWN), dtype=np.int8)
    sternum = roi.values == ids["sternum"]
    cartilage = roi.values == ids["costal_cartilages"]
    to_sternum = ndimage.distance_transform_edt(~sternum, sampling=roi.spacing_mm)
    for side in SIDES:
        for level, voxels in _split_by_rib(roi, ids, cartilage, to_sternum, side).items():
            part = Part.cartilage(side, level)
            gap = to_sternum[tuple(voxels.T)].min()
            if gap > STERNUM_GAP_MM:
                raise StudyError(
                    f"{labels.name}: expected the cartilage of {side} rib {level} to reach the sternum, got a gap of "
                    f"{gap:.0f} mm; it is cut off by the field of view or mislabelled"
                )
            parts[tuple(voxels.T)] = part
    parts[span_sternum(roi, sternum, parts, to_sternum)] = Part.STERNUM
    mask = Volume(parts, roi.spacing_mm, roi.T_ras_index, labels.name)
    check_field_of_view(mask, labels)
    return mask


def check_rib_labels(labels: Volume, ids: Mapping[str, int], also: Sequence[str] = ()) -> None:
    """Ribs 2-5 of both sides are there, and lie where an RAS+ chest has them.

    Raises:
        StudyError: names missing from the map or the volume; left and right, or up and down, swapped.
    """
    ribs = [rib_name(side, level) for side in SIDES for level in (2, 3, 4, 5)]
    needed = [*also, *ribs]
    unmapped = [name for name in needed if name not in ids]
    if unmapped:
        raise StudyError(f"{labels.name}: expected label ids of {', '.join(unmapped)}; add them to the label map")
    top = max(ids[name] for name in needed) + 1
    values = np.asarray(labels.values)
    counts = np.bincount(values[(values > 0) & (values < top)].astype(np.int64), minlength=top)
    absent = [name for name in needed if counts[ids[name]] < MIN_CONTACT]
    if absent:
        raise StudyError(
            f"{labels.name}: expected voxels of {', '.join(needed)}, got none of {', '.join(absent)}; "
            "wrong label map, or the field of view ends before"
        )
    boxes = ndimage.find_objects(np.asarray(values, dtype=np.int32), max_label=top)
    centres = labels.to_mm([[(s.start + s.stop - 1) / 2 for s in boxes[ids[name] - 1]] for name in ribs])
    right, left = centres[:4], centres[4:]
    if (right[:, 0] <= left[:, 0]).any():
        raise StudyError(
            f"{labels.name}: expected right ribs at larger x than left ones (RAS+), got them swapped; "
            "wrong label map, or an image with a wrong orientation"
        )
    if (np.diff(right[:, 2]) >= 0).any() or (np.diff(left[:, 2]) >= 0).any():
        raise StudyError(
            f"{labels.name}: expected ribs 2 to 5 from head to feet, got another order; "
            "wrong label map, or an image that is upside down"
        )


def check_field_of_view(mask: Volume, image: Volume) -> None:
    """No part touches the border of the image it was found in.

    Raises:
        StudyError: a part does, and so may be cut off.
    """
    inside = np.argwhere(mask.values > Part.UNKNOWN)
    index = np.rint(image.to_index(mask.to_mm(inside))).astype(np.int64)
    border = ((index <= 0) | (index >= np.array(image.shape) - 1)).any(axis=1)
    if border.any():
        cut = np.unique(mask.values[tuple(inside[border].T)])
        names = ", ".join(Part(value).name.lower() for value in cut)
        raise StudyError(
            f"{image.name}: expected whole parts, got {names} cut off by the field of view; use another scan"
        )


def _split_by_rib(
    roi: Volume, ids: Mapping[str, int], cartilage: Bools, to_sternum: Floats, side: str
) -> dict[int, Ints]:
    """Voxels (n, 3) of the cartilages 2-5 of one side.

    Cartilages 1-4 are pieces of their own; the 5th is often joined to the arch. A joined piece is divided by a
    watershed of its depth, so that it parts at the necks, from one line a rib: the path through the middle of the
    cartilage from the rib's end to the sternum.
    """
    ribs = [level for level in range(1, 11) if rib_name(side, level) in ids]
    values = roi.values
    of_rib = np.zeros(int(values.max()) + 1, dtype=np.int64)
    for level in ribs:
        if ids[rib_name(side, level)] < len(of_rib):
            of_rib[ids[rib_name(side, level)]] = level
    rib = of_rib[values]
    distance, index = ndimage.distance_transform_edt(rib == 0, sampling=roi.spacing_mm, return_indices=True)
    contact = np.where(cartilage & (distance <= JUNCTION_GAP_MM), rib[tuple(index)], 0)
    pieces, _ = ndimage.label(cartilage)
    found: dict[int, Ints] = {}
    touching = {level: np.bincount(pieces[contact == level]) for level in ribs}
    for level in (2, 3, 4, 5):
        counts = touching[level]
        if len(counts) == 0 or counts.max() < MIN_CONTACT:
            raise StudyError(
                f"{roi.name}: expected cartilage at the front end of {side} rib {level}, got none within "
                f"{JUNCTION_GAP_MM:g} mm; the labels miss it or the field of view ends before"
            )
        piece = int(counts.argmax())
        joined = [other for other in ribs if len(touching[other]) > piece and touching[other][piece] >= MIN_CONTACT]
        voxels = pieces == piece
        if joined != [level]:
            voxels = _divide(voxels, {other: (contact == other) & voxels for other in joined}, to_sternum, roi)[level]
        found[level] = np.argwhere(voxels)
    return found


def _divide(piece: Bools, ends: Mapping[int, Bools], to_sternum: Floats, roi: Volume) -> dict[int, Bools]:
    """Divide a joined piece among its ribs; ``ends`` are the voxels at each rib's junction."""
    where = ndimage.find_objects(piece.astype(np.int8))[0]
    piece, to_sternum = piece[where], to_sternum[where]
    spacing = roi.spacing_mm
    depth = ndimage.distance_transform_edt(np.pad(piece, 1), sampling=spacing)[1:-1, 1:-1, 1:-1]
    markers = np.zeros(piece.shape, dtype=np.int32)
    taken = np.zeros_like(piece)  # tubes around the lines found so far: cartilages join, their middles do not cross
    for level in sorted(ends):
        start = np.argwhere(ends[level][where])
        start = start[depth[tuple(start.T)].argmax()]
        free = piece & ~taken
        goals = free & (to_sternum <= to_sternum[free].min() + ATTACHMENT_MM)
        cost = np.where(free, 1.0 / depth.clip(spacing.min()) ** 2, np.where(piece, 1e3, np.inf))
        mcp = MCP_Geometric(cost, sampling=tuple(spacing))
        reach, _ = mcp.find_costs([tuple(start)])
        goal = np.unravel_index(np.where(goals, reach, np.inf).argmin(), piece.shape)
        line = np.array(mcp.traceback(goal)).T
        line = line[:, markers[tuple(line)] == 0]
        markers[tuple(line)] = level
        near, index = ndimage.distance_transform_edt(markers != level, sampling=spacing, return_indices=True)
        taken |= near <= depth[tuple(index)]
    divided = watershed(-depth, markers, mask=piece)
    result = {}
    for level in ends:
        whole = np.zeros(roi.shape, dtype=bool)
        whole[where] = largest_component(divided == level)
        result[level] = whole
    return result


def span_sternum(roi: Volume, sternum: Bools, parts: NDArray[Any], to_sternum: Floats) -> Bools:
    """The sternum from the upper edge of the 2nd cartilages' attachments to the lower edge of the 5th's.

    Args:
        roi: the grid.
        sternum: the whole sternum on it.
        parts: `Part` values of the cartilages on it.
        to_sternum: mm from each voxel to the sternum.
    """
    bone = roi.to_mm(np.argwhere(sternum))
    centre = bone.mean(axis=0)
    axis = np.linalg.svd(bone - centre, full_matrices=False)[2][0]
    axis = axis * np.sign(axis[2])
    edges = {}
    for level, edge in ((2, np.max), (5, np.min)):
        heights = []
        for side in SIDES:
            part = parts == Part.cartilage(side, level)
            end = part & (to_sternum <= to_sternum[part].min() + ATTACHMENT_MM)
            heights.append(edge((roi.to_mm(np.argwhere(end)) - centre) @ axis))
        edges[level] = edge(heights)
    height = (bone - centre) @ axis
    span = np.zeros_like(sternum)
    span[sternum] = (height <= edges[2]) & (height >= edges[5])
    return largest_component(span)


def on_grid(mask: Volume, like: Volume) -> Volume:
    """The parts at the voxel centres of another volume: the nearest voxel's, `Part.UNKNOWN` outside the mask.

    Args:
        mask: `Part` values.
        like: gives the grid; its axes are the mask's.

    Raises:
        StudyError: axes that are not parallel.
    """
    if not np.allclose(mask.T_ras_index.rotation, like.T_ras_index.rotation, atol=1e-4):
        raise StudyError(f"{mask.name}: expected the axes of {like.name}, got others; resample one of them first")
    values = ndimage.affine_transform(
        np.asarray(mask.values, dtype=np.int8),
        like.spacing_mm / mask.spacing_mm,
        offset=mask.to_index(like.to_mm(np.zeros((1, 3))))[0],
        output_shape=like.shape,
        order=0,
        mode="grid-constant",  # "constant" would cut half a voxel off every side
        cval=int(Part.UNKNOWN),
    )
    return Volume(values, like.spacing_mm, like.T_ras_index, mask.name)
