"""Writing PLUS sequence files, so that a sweep opens in 3D Slicer and comes back as it was."""

from __future__ import annotations

import gzip
import math
import os
import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from study.errors import StudyError
from study.files.atomic import write_bytes
from study.files.sequences import ELEMENT_TYPES
from study.ultrasound.tracked import TrackedSweep

Content = Literal["masks", "images"]


def write_plus(
    path: str | os.PathLike[str],
    sweep: TrackedSweep,
    *,
    content: Content | None = None,
    compress: bool = True,
) -> None:
    """Write a sweep as a PLUS sequence file, metafile or NRRD, which 3D Slicer opens.

    A frame's transform is the pose at the moment the frame shows, so other programs place it correctly. What
    PLUS has no field for (poses between the frames, latency, exact spacing) goes into fields named ``Study_…``; what
    the recording said of other tools is written as it was.

    Args:
        path: ends in ``.igs.mha``, ``.seq.mha`` or ``.nrrd``.
        sweep: what to write.
        content: which stack to write where the sweep has both; a file holds one.
        compress: deflate the pixels.

    Raises:
        StudyError: another ending, a stack the sweep lacks, or pixels of a type a metafile cannot hold.
    """
    path = Path(path)
    if not path.name.endswith((".igs.mha", ".seq.mha", ".nrrd")):
        raise StudyError(
            f"{path.name}: expected a name ending in .igs.mha, .seq.mha or .nrrd, or no program will know it"
        )
    content = content or _only_content(path, sweep)
    pixels = _pixels(path, sweep, content)
    data = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).tobytes()
    fields = [*_study_fields(sweep, content), *_pose_fields(sweep), *_frame_fields(sweep)]
    if path.name.endswith(".nrrd"):
        write_bytes(
            path, _nrrd_head(pixels, fields, compress) + (gzip.compress(data, 6, mtime=0) if compress else data)
        )
        return
    if compress:
        data = zlib.compress(data, 6)
    lines = [
        *_image_lines(pixels, len(data) if compress else None),
        *(f"{key} = {value}" for key, value in fields),
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


def _nrrd_head(pixels: NDArray[Any], fields: list[tuple[str, str]], compress: bool) -> bytes:
    """The header of an NRRD file as PLUS lays it out: a list of flat frames."""
    f, h, w = pixels.shape
    kind = {"u": "uint", "i": "int"}.get(pixels.dtype.kind, "")
    lines = [
        "NRRD0004",
        f"type: {kind}{8 * pixels.dtype.itemsize}" if kind else "type: float",
        "dimension: 3",
        f"sizes: {w} {h} {f}",
        "kinds: domain domain list",
        "space dimension: 2",
        "space directions: (1,0) (0,1) none",
        "space origin: (0,0)",
        "endian: little",
        f"encoding: {'gzip' if compress else 'raw'}",
        "ultrasound image orientation:=MF",
        "ultrasound image type:=BRIGHTNESS",
        # PLUS calls a frame's status by another name here than in a metafile.
        *(f"{key.replace('_ImageStatus', '_Status')}:={value}" for key, value in fields),
    ]
    return "\n".join([*lines, "", ""]).encode()


def _study_fields(sweep: TrackedSweep, content: Content) -> list[tuple[str, str]]:
    """What PLUS has no field for, the poses apart."""
    fields = [
        ("Study_Name", " ".join(sweep.name.split())),
        ("Study_Content", content),
        ("Study_LatencyS", _text(sweep.latency_s)),
        ("Study_Frames", " ".join(sweep.frame_names)),
    ]
    if sweep.pixel_spacing_mm is not None:
        fields.append(("Study_PixelSpacingMm", _text(*sweep.pixel_spacing_mm)))
    if sweep.T_probe_image is not None:
        fields.append(("Study_ProbeImageTransform", _text(*sweep.T_probe_image.matrix.ravel())))
    return fields + [(f"Study_Note{i:02d}", " ".join(note.split())) for i, note in enumerate(sweep.notes)]


def _pose_fields(sweep: TrackedSweep) -> list[tuple[str, str]]:
    """Every pose with its own time: a frame's transform is an interpolation between two of them."""
    return [
        (f"Study_Pose{i:06d}", f"{_text(time)} {'OK' if valid else 'INVALID'} {_text(*pose.ravel())}")
        for i, (time, valid, pose) in enumerate(zip(sweep.pose_times_s, sweep.pose_valid, sweep.poses, strict=True))
    ]


def _frame_fields(sweep: TrackedSweep) -> list[tuple[str, str]]:
    """The fields of each frame as PLUS names them, and those the recording had."""
    probe, base = sweep.frame_names
    over = f"{base}ToTrackerTransform"
    # A recording's own way round: probe and base each over the tracker. A third transform would close a ring.
    by_tracker = any(over in fields for fields in sweep.frame_fields.values())
    key = f"{probe}To{'Tracker' if by_tracker else base}Transform"
    image_to_probe = _image_to_probe(sweep)
    written = []
    poses, _, tracked = sweep.frame_poses()
    for i, time in enumerate(sweep.frame_times_s.tolist()):
        others = sweep.frame_fields.get(time, {})
        pose, ok = (poses[i], True) if tracked[i] else (np.eye(4), False)
        if by_tracker:
            ok = ok and over in others and others.get(f"{over}Status", "OK") == "OK"
            pose = np.array(others[over].split(), dtype=np.float64).reshape(4, 4) @ pose if ok else np.eye(4)
        fields = {key: _text(*pose.ravel()), f"{key}Status": "OK" if ok else "INVALID"}
        if image_to_probe is not None:
            fields |= {f"ImageTo{probe}Transform": image_to_probe, f"ImageTo{probe}TransformStatus": "OK"}
        fields = {**others, **fields, "Timestamp": _text(time), "ImageStatus": "OK"}
        written += [(f"Seq_Frame{i:04d}_{name}", value) for name, value in fields.items()]
    return written


def _image_to_probe(sweep: TrackedSweep) -> str | None:
    """``ImageToProbeTransform``, image in pixels; None before calibration."""
    if sweep.T_probe_image is None or sweep.pixel_spacing_mm is None:
        return None
    # PLUS counts image positions in pixels; out of plane there is none, any scale will do.
    scale = np.diag([*sweep.pixel_spacing_mm, math.sqrt(math.prod(sweep.pixel_spacing_mm)), 1.0])
    return _text(*(sweep.T_probe_image.matrix @ scale).ravel())


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
