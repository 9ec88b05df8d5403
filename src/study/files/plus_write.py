"""Writing PLUS sequence metafiles, so that a sweep opens in 3D Slicer and comes back as it was."""

from __future__ import annotations

import math
import os
import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from study.errors import StudyError
from study.files.atomic import write_bytes
from study.files.plus import ELEMENT_TYPES
from study.ultrasound.tracked import TrackedSweep

Content = Literal["masks", "images"]


def write_plus(
    path: str | os.PathLike[str],
    sweep: TrackedSweep,
    *,
    content: Content | None = None,
    compress: bool = True,
) -> None:
    """Write a sweep as a PLUS sequence metafile, which 3D Slicer opens.

    A frame's transform is the pose at the moment the frame shows, so other programs place it correctly. What
    PLUS has no field for (poses between the frames, latency, exact spacing) goes into fields named ``Study_…``.

    Args:
        path: ends in ``.igs.mha`` or ``.seq.mha``.
        sweep: what to write.
        content: which stack to write where the sweep has both; a file holds one.
        compress: deflate the pixels.

    Raises:
        StudyError: another ending, a stack the sweep lacks, or pixels of a type a metafile cannot hold.
    """
    path = Path(path)
    if not path.name.endswith((".igs.mha", ".seq.mha")):
        raise StudyError(f"{path.name}: expected a name ending in .igs.mha or .seq.mha, or no program will know it")
    content = content or _only_content(path, sweep)
    pixels = _pixels(path, sweep, content)
    data = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).tobytes()
    if compress:
        data = zlib.compress(data, 6)
    lines = [
        *_image_lines(pixels, len(data) if compress else None),
        *_study_lines(sweep, content),
        *_pose_lines(sweep),
        *_frame_lines(sweep),
        "ElementDataFile = LOCAL\n",
    ]
    write_bytes(path, "\n".join(lines).encode() + data)


def _only_content(path: Path, sweep: TrackedSweep) -> Content:
    if sweep.masks is not None and sweep.images is not None:
        raise StudyError(f"{path.name}: expected content='masks' or 'images', got both in the sweep; write two files")
    return "images" if sweep.masks is None else "masks"


def _pixels(path: Path, sweep: TrackedSweep, content: Content) -> NDArray[Any]:
    """The stack (f, h, w) to write; masks as 0 and 255, which other programs show as black and white."""
    stack = sweep.masks if content == "masks" else sweep.images
    if stack is None:
        raise StudyError(f"{path.name}: expected {content} in the sweep, got none; write what it has")
    pixels = stack.astype(np.uint8) * 255 if content == "masks" else stack
    kinds = _kinds()
    if pixels.dtype not in kinds:
        raise StudyError(
            f"{path.name}: expected pixels of {', '.join(map(str, kinds))}, got {pixels.dtype}; convert them"
        )
    return pixels


def _kinds() -> dict[np.dtype[Any], str]:
    return {np.dtype(code): name for name, code in ELEMENT_TYPES.items()}


def _image_lines(pixels: NDArray[Any], n_compressed: int | None) -> list[str]:
    """The metafile's own fields."""
    f, h, w = pixels.shape
    return [
        "ObjectType = Image",
        "NDims = 3",
        "AnatomicalOrientation = RAI",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CenterOfRotation = 0 0 0",
        f"CompressedData = {n_compressed is not None}",
        *([] if n_compressed is None else [f"CompressedDataSize = {n_compressed}"]),
        f"DimSize = {w} {h} {f}",
        "Kinds = domain domain list",
        "ElementNumberOfChannels = 1",
        "ElementSpacing = 1 1 1",
        f"ElementType = {_kinds()[pixels.dtype]}",
        "Offset = 0 0 0",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
        "UltrasoundImageOrientation = MF",
        "UltrasoundImageType = BRIGHTNESS",
    ]


def _study_lines(sweep: TrackedSweep, content: Content) -> list[str]:
    """What PLUS has no field for, the poses apart."""
    lines = [
        f"Study_Name = {' '.join(sweep.name.split())}",
        f"Study_Content = {content}",
        f"Study_LatencyS = {_text(sweep.latency_s)}",
    ]
    if sweep.pixel_spacing_mm is not None:
        lines.append(f"Study_PixelSpacingMm = {_text(*sweep.pixel_spacing_mm)}")
    if sweep.T_probe_image is not None:
        lines.append(f"Study_ProbeImageTransform = {_text(*sweep.T_probe_image.matrix.ravel())}")
    return lines


def _pose_lines(sweep: TrackedSweep) -> list[str]:
    """Every pose with its own time: a frame's transform is an interpolation between two of them."""
    return [
        f"Study_Pose{i:06d} = {_text(time)} {'OK' if valid else 'INVALID'} {_text(*pose.ravel())}"
        for i, (time, valid, pose) in enumerate(zip(sweep.pose_times_s, sweep.pose_valid, sweep.poses, strict=True))
    ]


def _frame_lines(sweep: TrackedSweep) -> list[str]:
    """The fields of each frame as PLUS names them."""
    image_to_probe = _image_to_probe(sweep)
    lines = []
    poses, _, tracked = sweep.frame_poses()
    for i in range(sweep.n_frames):
        pose, status = (poses[i], "OK") if tracked[i] else (np.eye(4), "INVALID")
        lines += [
            f"Seq_Frame{i:04d}_ProbeToTrackerTransform = {_text(*pose.ravel())}",
            f"Seq_Frame{i:04d}_ProbeToTrackerTransformStatus = {status}",
        ]
        if image_to_probe is not None:
            lines += [
                f"Seq_Frame{i:04d}_ImageToProbeTransform = {image_to_probe}",
                f"Seq_Frame{i:04d}_ImageToProbeTransformStatus = OK",
            ]
        lines += [
            f"Seq_Frame{i:04d}_Timestamp = {_text(sweep.frame_times_s[i])}",
            f"Seq_Frame{i:04d}_ImageStatus = OK",
        ]
    return lines


def _image_to_probe(sweep: TrackedSweep) -> str | None:
    """``ImageToProbeTransform``, image in pixels; None before calibration."""
    if sweep.T_probe_image is None or sweep.pixel_spacing_mm is None:
        return None
    # PLUS counts image positions in pixels; out of plane there is none, any scale will do.
    scale = np.diag([*sweep.pixel_spacing_mm, math.sqrt(math.prod(sweep.pixel_spacing_mm)), 1.0])
    return _text(*(sweep.T_probe_image.matrix @ scale).ravel())


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
