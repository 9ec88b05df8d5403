"""Tracked sweeps on disk: PLUS sequence metafiles, and folders of PNG masks with a CSV of poses."""

from __future__ import annotations

import json
import math
import os
import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.types import Bools, Floats, RigidTransform, TrackedSweep

MAX_LINE = 1 << 16
MAX_DEFLATE_RATIO = 1032  # zlib cannot do better: a header that asks for more is wrong
ELEMENT_TYPES = {"MET_UCHAR": "u1", "MET_CHAR": "i1", "MET_USHORT": "u2", "MET_SHORT": "i2", "MET_FLOAT": "f4"}
POSE_COLUMNS = ["time_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"]

Header = dict[str, str]


def read_plus(
    path: str | os.PathLike[str],
    *,
    masks: str | os.PathLike[str] | None = None,
    probe: str = "Probe",
    base: str = "Tracker",
    pixel_spacing_mm: tuple[float, float] | None = None,
    T_probe_image: RigidTransform | None = None,
    latency_s: float | None = None,
) -> TrackedSweep:
    """Read a PLUS sequence metafile (``.igs.mha``, ``.seq.mha``), compressed or not.

    Files of `write_plus` come back as they were. In files of other programs every frame carries its own pose,
    frames count as B-mode, and the calibration is ``ImageTo<probe>Transform`` where the file has it. Images are
    turned to the orientation MF (marked side first, transducer on top), to which that transform belongs.

    Args:
        path: the file.
        masks: a second metafile of the same frames that holds their masks.
        probe: the probe's frame in the names of the file's transforms.
        base: the base frame in them; ``<probe>To<base>Transform`` is used, or both over ``Tracker``.
        pixel_spacing_mm: (sx, sy) mm, instead of the file's.
        T_probe_image: image (mm) to probe, instead of the file's.
        latency_s: instead of the file's; files of other programs have none, which is 0.

    Raises:
        StudyError: not a metafile, truncated or mis-sized data, no time stamps, no poses, or values out of range.
    """
    path = Path(path)
    header, pixels = _read_metafile(path)
    frames = _frame_fields(path, header, len(pixels))
    times = np.array([_numbers(path, fields, "Timestamp", 1, f"frame {i}: ")[0] for i, fields in enumerate(frames)])
    poses, valid, pose_times = _own_poses(path, header) or (*_frame_poses(path, frames, probe, base), times)
    spacing, transform = _calibration(path, header, frames, probe)
    if latency_s is None:
        latency_s = float(_numbers(path, header, "Study_LatencyS", 1)[0]) if "Study_LatencyS" in header else 0.0
    # A tracker may go on while the image stops: such a frame has a pose, and pixels that mean nothing.
    shown = np.array([fields.get("ImageStatus", "OK") == "OK" for fields in frames])
    annotated = header.get("Study_Content") == "masks"
    bones = pixels if annotated else None
    if masks is not None:
        bones = _read_metafile(Path(masks))[1]
        if bones.shape != pixels.shape:
            raise StudyError(
                f"{Path(masks).name}: expected masks of the size of the images {pixels.shape}, got {bones.shape};"
                " export all frames alike"
            )
    return TrackedSweep(
        frame_times_s=times[shown],
        poses=poses,
        pose_times_s=pose_times,
        pose_valid=valid,
        masks=None if bones is None else bones[shown] > 0,
        images=None if annotated else pixels[shown],
        pixel_spacing_mm=pixel_spacing_mm or spacing,
        T_probe_image=T_probe_image or transform,
        latency_s=latency_s,
        name=header.get("Study_Name", path.name.split(".")[0]),
    )


def write_plus(
    path: str | os.PathLike[str],
    sweep: TrackedSweep,
    *,
    content: Literal["masks", "images"] | None = None,
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
    if content is None:
        if sweep.masks is not None and sweep.images is not None:
            raise StudyError(
                f"{path.name}: expected content='masks' or 'images', got both in the sweep; write two files"
            )
        content = "images" if sweep.masks is None else "masks"
    stack = sweep.masks if content == "masks" else sweep.images
    if stack is None:
        raise StudyError(f"{path.name}: expected {content} in the sweep, got none; write what it has")
    pixels = stack.astype(np.uint8) * 255 if content == "masks" else stack
    kinds = {np.dtype(code): name for name, code in ELEMENT_TYPES.items()}
    if pixels.dtype not in kinds:
        raise StudyError(
            f"{path.name}: expected pixels of {', '.join(map(str, kinds))}, got {pixels.dtype}; convert them"
        )
    data = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).tobytes()
    if compress:
        data = zlib.compress(data, 6)
    f, h, w = pixels.shape
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "AnatomicalOrientation = RAI",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CenterOfRotation = 0 0 0",
        f"CompressedData = {compress}",
        *([f"CompressedDataSize = {len(data)}"] if compress else []),
        f"DimSize = {w} {h} {f}",
        "Kinds = domain domain list",
        "ElementNumberOfChannels = 1",
        "ElementSpacing = 1 1 1",
        f"ElementType = {kinds[pixels.dtype]}",
        "Offset = 0 0 0",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
        "UltrasoundImageOrientation = MF",
        "UltrasoundImageType = BRIGHTNESS",
        f"Study_Name = {' '.join(sweep.name.split())}",
        f"Study_Content = {content}",
        f"Study_LatencyS = {_text(sweep.latency_s)}",
    ]
    image_to_probe = None
    if sweep.pixel_spacing_mm is not None:
        lines.append(f"Study_PixelSpacingMm = {_text(*sweep.pixel_spacing_mm)}")
    if sweep.T_probe_image is not None:
        lines.append(f"Study_ProbeImageTransform = {_text(*sweep.T_probe_image.matrix.ravel())}")
        if sweep.pixel_spacing_mm is not None:
            # PLUS counts image positions in pixels; out of plane there is none, any scale will do.
            scale = np.diag([*sweep.pixel_spacing_mm, math.sqrt(math.prod(sweep.pixel_spacing_mm)), 1.0])
            image_to_probe = _text(*(sweep.T_probe_image.matrix @ scale).ravel())
    lines += [
        f"Study_Pose{i:06d} = {_text(time)} {'OK' if valid else 'INVALID'} {_text(*pose.ravel())}"
        for i, (time, valid, pose) in enumerate(zip(sweep.pose_times_s, sweep.pose_valid, sweep.poses, strict=True))
    ]
    poses, _, tracked = sweep.frame_poses()
    for i in range(f):
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
    lines.append("ElementDataFile = LOCAL\n")
    # Under another name until whole: no half file ever passes for a sweep.
    partial = path.with_name(path.name + ".part")
    partial.write_bytes("\n".join(lines).encode() + data)
    partial.replace(path)


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


def _read_metafile(path: Path) -> tuple[Header, NDArray[Any]]:
    """Header and pixels (f, h, w) in the orientation MF."""
    if not path.is_file():
        raise StudyError(f"{path.name}: expected a metafile, got nothing at {path}; check the path")
    header: Header = {}
    with path.open("rb") as file:
        while "ElementDataFile" not in header:
            line = file.readline(MAX_LINE)
            key, equals, value = line.decode("latin-1").partition("=")
            if not line.endswith(b"\n") or not equals or (not header and key.strip() != "ObjectType"):
                found = "the end of the file" if not line else f"{line[:40]!r}"
                what = "header lines up to ElementDataFile" if header else "ObjectType first"
                raise StudyError(
                    f"{path.name}: expected {what}, got {found}; the file is truncated or not a PLUS sequence metafile"
                )
            header[key.strip()] = value.strip()
        data = file.read()
    if header["ElementDataFile"] != "LOCAL":
        raise StudyError(
            f"{path.name}: expected the pixels in the file, got {header['ElementDataFile']!r}; save as .mha"
        )
    if header["ObjectType"] != "Image" or header.get("ElementNumberOfChannels", "1") != "1":
        raise StudyError(f"{path.name}: expected grey images, got another object or colour; convert to one channel")
    kind = header.get("ElementType", "none")
    if kind not in ELEMENT_TYPES:
        raise StudyError(
            f"{path.name}: expected ElementType {', '.join(ELEMENT_TYPES)}, got {kind}; convert the pixels"
        )
    size = header.get("DimSize", "none").split()
    if len(size) != 3 or not all(part.isdigit() and int(part) > 0 for part in size):
        raise StudyError(f"{path.name}: expected DimSize of columns, rows and frames, got {header.get('DimSize')!r}")
    w, h, f = (int(part) for part in size)
    dtype = np.dtype(ELEMENT_TYPES[kind])
    dtype = dtype.newbyteorder(">" if header.get("BinaryDataByteOrderMSB", "False") == "True" else "<")
    n_bytes = w * h * f * dtype.itemsize
    if header.get("CompressedData", "False") == "True":
        data = _inflate(path, header, data, n_bytes)
    if len(data) != n_bytes:
        raise StudyError(
            f"{path.name}: expected {n_bytes} bytes for {f} frames of {w} x {h}, got {len(data)}; the file is"
            " truncated or its DimSize wrong"
        )
    stack = np.frombuffer(data, dtype=dtype).reshape(f, h, w).astype(dtype.newbyteorder("="), copy=False)
    return header, _turn(path, stack, header.get("UltrasoundImageOrientation", "MF")[:2].upper())


def _inflate(path: Path, header: Header, data: bytes, n_bytes: int) -> bytes:
    """Inflate ``data``, never to more than the header's size."""
    stated = header.get("CompressedDataSize", str(len(data)))
    if not stated.isdigit() or int(stated) != len(data):
        raise StudyError(
            f"{path.name}: expected {stated} compressed bytes, got {len(data)}; the file is truncated or mixed up"
        )
    if n_bytes > MAX_DEFLATE_RATIO * len(data):
        raise StudyError(
            f"{path.name}: expected {n_bytes} bytes by DimSize, but {len(data)} compressed ones cannot hold them;"
            " DimSize is wrong"
        )
    stream = zlib.decompressobj()
    try:
        pixels = stream.decompress(data, n_bytes)
        surplus = len(stream.decompress(stream.unconsumed_tail, 1))
    except zlib.error as error:
        raise StudyError(
            f"{path.name}: expected deflated pixels, got damaged data ({error}); copy the file again"
        ) from error
    if surplus:
        raise StudyError(f"{path.name}: expected {n_bytes} bytes by DimSize, got more; DimSize is wrong")
    return pixels


def _turn(path: Path, stack: NDArray[Any], orientation: str) -> NDArray[Any]:
    """From a PLUS orientation (first letter: the column axis; second: the row axis) to MF."""
    if len(orientation) == 2 and orientation[0] in "FN" and orientation[1] in "MU":
        stack, orientation = stack.transpose(0, 2, 1), orientation[::-1]
    if len(orientation) != 2 or orientation[0] not in "MU" or orientation[1] not in "FN":
        raise StudyError(
            f"{path.name}: expected UltrasoundImageOrientation like MF or UN, got {orientation!r}; correct it"
        )
    return stack[:, :: -1 if orientation[1] == "N" else 1, :: -1 if orientation[0] == "U" else 1]


def _numbers(path: Path, fields: Header, key: str, n: int, where: str = "") -> Floats:
    try:
        numbers = np.array(fields[key].split(), dtype=np.float64)
    except KeyError:
        raise StudyError(
            f"{path.name}: {where}expected a field {key}, got none; the file is no tracked sequence"
        ) from None
    except ValueError:
        raise StudyError(f"{path.name}: {where}expected {n} numbers as {key}, got {fields[key][:40]!r}") from None
    if len(numbers) != n:
        raise StudyError(
            f"{path.name}: {where}expected {n} numbers as {key}, got {len(numbers)}; the header is damaged"
        )
    return numbers


def _frame_fields(path: Path, header: Header, n_frames: int) -> list[Header]:
    """The fields of each frame, by their names without the frame."""
    frames: list[Header] = [{} for _ in range(n_frames)]
    for key, value in header.items():
        if key.startswith("Seq_Frame"):
            number, _, name = key.removeprefix("Seq_Frame").partition("_")
            if not number.isdigit() or int(number) >= n_frames:
                raise StudyError(
                    f"{path.name}: expected fields of {n_frames} frames (DimSize), got {key!r}; the file is mis-sized"
                )
            frames[int(number)][name] = value
    return frames


def _own_poses(path: Path, header: Header) -> tuple[Floats, Bools, Floats] | None:
    """Poses, validity and times as `write_plus` keeps them; None in files of other programs."""
    rows = [value.split() for key, value in header.items() if key.startswith("Study_Pose")]
    if not rows:
        return None
    try:
        valid = np.array([row.pop(1) == "OK" for row in rows])
        table = np.array(rows, dtype=np.float64).reshape(len(rows), 17)
    except (ValueError, IndexError):
        raise StudyError(
            f"{path.name}: expected Study_Pose lines of time, status and 16 numbers; they are damaged"
        ) from None
    return table[:, 1:].reshape(-1, 4, 4), valid, table[:, 0]


def _frame_poses(path: Path, frames: list[Header], probe: str, base: str) -> tuple[Floats, Bools]:
    """Each frame's pose (f, 4, 4) of the probe in the base frame, and whether it is valid."""
    direct = f"{probe}To{base}Transform"
    names = sorted({key for fields in frames for key in fields if key.endswith("Transform")})
    if direct in names:
        return _transforms(path, frames, direct)
    over = f"{probe}ToTrackerTransform", f"{base}ToTrackerTransform"
    if not set(over) <= set(names):
        raise StudyError(
            f"{path.name}: expected a pose {direct} per frame, got {', '.join(names) or 'no transforms at all'}; name"
            " the frames with probe= and base=, or record with tracking on"
        )
    (T_tracker_probe, seen), (T_tracker_base, also) = (_transforms(path, frames, key) for key in over)
    both = seen & also
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[both] = np.linalg.inv(T_tracker_base[both]) @ T_tracker_probe[both]
    return poses, both


def _transforms(path: Path, frames: list[Header], key: str) -> tuple[Floats, Bools]:
    poses, valid = np.tile(np.eye(4), (len(frames), 1, 1)), np.zeros(len(frames), dtype=bool)
    for i, fields in enumerate(frames):
        if key in fields and fields.get(f"{key}Status", "OK") == "OK":
            poses[i], valid[i] = _numbers(path, fields, key, 16, f"frame {i}: ").reshape(4, 4), True
    if not valid.any():
        raise StudyError(
            f"{path.name}: expected valid poses {key}, got none in {len(frames)} frames; was the probe in view?"
        )
    return poses, valid


def _calibration(
    path: Path, header: Header, frames: list[Header], probe: str
) -> tuple[tuple[float, float] | None, RigidTransform | None]:
    """Pixel spacing and image (mm) to probe, as far as the file knows them."""
    if "Study_Content" in header:
        spacing, transform = None, None
        if "Study_PixelSpacingMm" in header:
            sx, sy = _numbers(path, header, "Study_PixelSpacingMm", 2)
            spacing = (float(sx), float(sy))
        if "Study_ProbeImageTransform" in header:
            matrix = _numbers(path, header, "Study_ProbeImageTransform", 16).reshape(4, 4)
            transform = RigidTransform.from_matrix(matrix)
        return spacing, transform
    key = f"ImageTo{probe}Transform"
    for fields in frames:
        if key in fields and fields.get(f"{key}Status", "OK") == "OK":
            matrix = _numbers(path, fields, key, 16).reshape(4, 4)
            break
    else:
        return None, None
    x, y = matrix[:3, 0], matrix[:3, 1]
    sx, sy = float(np.linalg.norm(x)), float(np.linalg.norm(y))
    if not (sx > 0 and sy > 0 and abs(x @ y) < 1e-2 * sx * sy):
        raise StudyError(f"{path.name}: expected {key} with square axes, got a sheared or empty one; calibrate again")
    rotation, _ = Rotation.align_vectors([x / sx, y / sy], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return (sx, sy), RigidTransform(rotation.as_matrix(), matrix[:3, 3])


def read_folder(folder: str | os.PathLike[str]) -> TrackedSweep:
    """Read a sweep from a folder of PNG masks and CSV files.

    The folder holds ``frames.csv`` (``file,time_s``: a grey PNG in the folder, anything above 0 is bone),
    ``poses.csv`` (``time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw`` and, if you have it, ``valid`` as 1 or 0: position and
    orientation of the probe in the base frame) and ``sweep.json`` (``pixel_spacing_mm``, ``T_probe_image`` as
    4 rows of 4, ``latency_s``; each may be left out).

    Raises:
        StudyError: a missing file or column, an image of another size or with colour, or values out of range.
    """
    folder = Path(folder)
    frames = _read_table(folder / "frames.csv", ["file", "time_s"])
    poses_table = _read_table(folder / "poses.csv", POSE_COLUMNS)
    masks = _read_masks(folder, [str(name) for name in frames["file"]])
    numbers = poses_table[POSE_COLUMNS].to_numpy(dtype=np.float64)
    valid = poses_table["valid"].to_numpy() != 0 if "valid" in poses_table else np.ones(len(numbers), dtype=bool)
    lengths = np.linalg.norm(numbers[:, 4:], axis=1)
    wrong = np.flatnonzero(valid & ~(np.abs(lengths - 1) < 1e-2))
    if wrong.size:
        raise StudyError(
            f"poses.csv: expected unit quaternions (qx to qw), got length {lengths[wrong[0]]:.3g} in row {wrong[0]};"
            " mark the row invalid or check the columns"
        )
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[valid, :3, :3] = Rotation.from_quat(numbers[valid, 4:]).as_matrix()
    poses[valid, :3, 3] = numbers[valid, 1:4]
    settings = _read_settings(folder / "sweep.json")
    spacing, matrix = settings.get("pixel_spacing_mm"), settings.get("T_probe_image")
    try:
        return TrackedSweep(
            frame_times_s=frames["time_s"].to_numpy(dtype=np.float64),
            poses=poses,
            pose_times_s=numbers[:, 0],
            pose_valid=valid,
            masks=masks,
            pixel_spacing_mm=None if spacing is None else (float(spacing[0]), float(spacing[1])),
            T_probe_image=None if matrix is None else RigidTransform.from_matrix(matrix),
            latency_s=float(settings.get("latency_s", 0.0)),
            name=str(settings.get("name", folder.name)),
        )
    except (TypeError, IndexError) as error:
        raise StudyError(f"sweep.json: expected numbers, got something else ({error}); see read_folder") from error


def write_folder(folder: str | os.PathLike[str], sweep: TrackedSweep) -> None:
    """Write a sweep's masks as the folder that `read_folder` reads; poses become quaternions.

    Raises:
        StudyError: no masks, or a folder that already holds something.
    """
    folder = Path(folder)
    if sweep.masks is None:
        raise StudyError(f"{sweep.name}: expected masks, got B-mode only; annotate the frames first")
    if folder.exists() and any(folder.iterdir()):
        raise StudyError(f"{folder.name}: expected a new or empty folder, got files in it; choose another name")
    (folder / "masks").mkdir(parents=True)
    files = [f"masks/{i:06d}.png" for i in range(sweep.n_frames)]
    for file, mask in zip(files, sweep.masks, strict=True):
        sitk.WriteImage(sitk.GetImageFromArray(mask.astype(np.uint8) * 255), str(folder / file))
    pd.DataFrame({"file": files, "time_s": sweep.frame_times_s}).to_csv(folder / "frames.csv", index=False)
    quaternions = np.zeros((len(sweep.poses), 4))
    quaternions[sweep.pose_valid] = Rotation.from_matrix(sweep.poses[sweep.pose_valid, :3, :3]).as_quat()
    positions = np.where(sweep.pose_valid[:, None], sweep.poses[:, :3, 3], 0.0)
    table = pd.DataFrame(np.column_stack([sweep.pose_times_s, positions, quaternions]), columns=POSE_COLUMNS)
    table.assign(valid=sweep.pose_valid.astype(int)).to_csv(folder / "poses.csv", index=False)
    settings: dict[str, Any] = {"name": sweep.name, "latency_s": sweep.latency_s}
    if sweep.pixel_spacing_mm is not None:
        settings["pixel_spacing_mm"] = list(sweep.pixel_spacing_mm)
    if sweep.T_probe_image is not None:
        settings["T_probe_image"] = sweep.T_probe_image.matrix.tolist()
    (folder / "sweep.json").write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")


def _read_table(path: Path, columns: list[str]) -> pd.DataFrame:
    if not path.is_file():
        raise StudyError(f"{path.name}: expected this file in {path.parent}, got none; see study.data.plus.read_folder")
    try:
        table = pd.read_csv(path)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise StudyError(f"{path.name}: expected a CSV table, got something else ({error})") from error
    missing = [column for column in columns if column not in table]
    if missing or table.empty:
        raise StudyError(
            f"{path.name}: expected rows with columns {', '.join(columns)}, got {len(table)} rows without"
            f" {', '.join(missing) or 'any data'}; add them"
        )
    for column in [name for name in table if name != "file"]:
        if not pd.api.types.is_numeric_dtype(table[column]) or table[column].isna().any():
            raise StudyError(f"{path.name}: expected a number in every row of {column}, got text or gaps; fill them")
    return table


def _read_settings(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise StudyError(f"{path.name}: expected JSON, got something else ({error})") from error
    known = {"name", "latency_s", "pixel_spacing_mm", "T_probe_image"}
    if not isinstance(settings, dict) or not set(settings) <= known:
        raise StudyError(
            f"{path.name}: expected an object with {', '.join(sorted(known))}, got other keys; check the names"
        )
    return settings


def _read_masks(folder: Path, names: list[str]) -> Bools:
    """Masks (f, h, w); every image's size is checked before its pixels are read."""
    masks, reader = None, sitk.ImageFileReader()
    for i, name in enumerate(names):
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()) or not path.is_file():
            raise StudyError(f"frames.csv: expected {name!r} to be an image in the folder, got none; correct row {i}")
        reader.SetFileName(str(path))
        try:
            reader.ReadImageInformation()
            size, channels = reader.GetSize(), reader.GetNumberOfComponents()
            if channels != 1 or len(size) != 2:
                raise StudyError(
                    f"{name}: expected a grey image, got {channels} channels; save masks as 8-bit grey PNG"
                )
            if masks is None:
                masks = np.zeros((len(names), size[1], size[0]), dtype=bool)
            if (size[1], size[0]) != masks.shape[1:]:
                raise StudyError(
                    f"{name}: expected {masks.shape[2]} x {masks.shape[1]} pixels as in the first mask, got"
                    f" {size[0]} x {size[1]}; export all frames alike"
                )
            masks[i] = sitk.GetArrayFromImage(reader.Execute()) > 0
        except RuntimeError as error:
            raise StudyError(
                f"{name}: expected a readable image, got a damaged one ({type(error).__name__})"
            ) from error
    assert masks is not None  # the table has rows
    return masks
