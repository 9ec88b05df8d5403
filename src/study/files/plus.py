"""Reading PLUS sequence metafiles: tracked sweeps as 3D Slicer and the PLUS toolkit record them."""

from __future__ import annotations

import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.types import Bools, Floats, RigidTransform
from study.ultrasound.tracked import TrackedSweep

MAX_LINE = 1 << 16
MAX_DEFLATE_RATIO = 1032  # zlib cannot do better: a header that asks for more is wrong
ELEMENT_TYPES = {"MET_UCHAR": "u1", "MET_CHAR": "i1", "MET_USHORT": "u2", "MET_SHORT": "i2", "MET_FLOAT": "f4"}

ORIENTATION = "UltrasoundImageOrientation"
SAME_TIME_S = 1e-3  # stamps are rounded to a millisecond or less; frames lie 10 ms and more apart
METRES_BELOW_MM = 0.005  # no probe for a chest has pixels so small

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
        masks: a second metafile of the same frames that holds their masks. It is taken to lie as the images do where
            it states no orientation, as files of programs that know nothing of ultrasound.
        probe: the probe's frame in the names of the file's transforms.
        base: the base frame in them; ``<probe>To<base>Transform`` is used, or both over ``Tracker``.
        pixel_spacing_mm: (sx, sy) mm, instead of the file's.
        T_probe_image: image (mm) to probe, instead of the file's.
        latency_s: instead of the file's; files of other programs have none, which is 0.

    Raises:
        StudyError: not a metafile, truncated, damaged or mis-sized data, no time stamps, no poses or valid frames,
            values out of range, or masks that are B-mode or of another recording.

    Examples:
        >>> import tempfile
        >>> from study.files import write_plus
        >>> times = np.array([0.0, 0.1])
        >>> poses, bone = np.tile(np.eye(4), (2, 1, 1)), np.ones((2, 3, 4), bool)
        >>> sweep = TrackedSweep(times, poses, times, np.ones(2, bool), bone, name="recorded")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_plus(Path(folder, "tiny.igs.mha"), sweep)
        ...     back = read_plus(Path(folder, "tiny.igs.mha"))
        >>> back.n_frames, back.masks.shape, back.name
        (2, (2, 3, 4), 'recorded')
    """
    path = Path(path)
    header, stack = _read_metafile(path)
    pixels = _turn(path, stack, header.get(ORIENTATION, "MF"))
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
    if not shown.any():
        raise StudyError(
            f"{path.name}: expected at least one valid frame, got none of {len(shown)} (ImageStatus); record with the"
            " image on"
        )
    if bones is not None:
        check_masks(bones, path.name)
    if masks is not None:
        bones = _read_masks(Path(masks), path, header.get(ORIENTATION, "MF"), pixels.shape, times)
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


def check_masks(stack: NDArray[Any], name: str) -> None:
    """Pixels are 0 or one other value, as masks are and B-mode is not.

    Raises:
        StudyError: several values.
    """
    top = stack.max()
    if not ((stack == 0) | (stack == top)).all():
        raise StudyError(
            f"{name}: expected masks of 0 and one other value, got {len(np.unique(stack))} grey levels; is this the"
            " B-mode? export the annotation alone"
        )


def _read_masks(path: Path, images: Path, orientation: str, shape: tuple[int, ...], times: Floats) -> NDArray[Any]:
    """The masks (f, h, w) of the frames of ``images``, in the orientation MF."""
    header, stack = _read_metafile(path)
    bones = _turn(path, stack, header.get(ORIENTATION, orientation))
    if header.get("Study_Content", "masks") != "masks":
        raise StudyError(
            f"{path.name}: expected masks, got a file that says it holds {header['Study_Content']}; give the annotation"
        )
    if bones.shape != shape:
        raise StudyError(
            f"{path.name}: expected masks of the size of the images {shape}, got {bones.shape}; export all frames alike"
        )
    check_masks(bones, path.name)
    for i, fields in enumerate(_frame_fields(path, header, len(bones))):
        if "Timestamp" not in fields:  # other programs keep none: then only the size can tell
            continue
        time = float(_numbers(path, fields, "Timestamp", 1, f"frame {i}: ")[0])
        if not abs(time - times[i]) < SAME_TIME_S:
            raise StudyError(
                f"{path.name}: frame {i}: expected the time stamp of {images.name}, {times[i]:.6f} s, got {time:.6f} s;"
                " these are masks of another recording"
            )
    return bones


def _read_metafile(path: Path) -> tuple[Header, NDArray[Any]]:
    """Header and pixels (f, h, w) as they are stored."""
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
            if header.setdefault(key.strip(), value.strip()) != value.strip():
                raise StudyError(
                    f"{path.name}: expected one value of {key.strip()}, got {header[key.strip()][:40]!r} and"
                    f" {value.strip()[:40]!r}; delete the wrong one"
                )
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
    return header, stack


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
    if not stream.eof or stream.unused_data:  # the checksum stands at the stream's very end
        raise StudyError(
            f"{path.name}: expected pixels that end with their checksum, got a truncated stream or bytes behind it;"
            " copy the file again"
        )
    return pixels


def _turn(path: Path, stack: NDArray[Any], orientation: str) -> NDArray[Any]:
    """From a PLUS orientation (first letter: the column axis; second: the row axis) to MF."""
    orientation = orientation[:2].upper()
    if len(orientation) == 2 and orientation[0] in "FN" and orientation[1] in "MU":
        stack, orientation = stack.transpose(0, 2, 1), orientation[::-1]
    if len(orientation) != 2 or orientation[0] not in "MU" or orientation[1] not in "FN":
        raise StudyError(
            f"{path.name}: expected UltrasoundImageOrientation like MF or UN, got {orientation!r}; correct it"
        )
    return stack[:, :: -1 if orientation[1] == "N" else 1, :: -1 if orientation[0] == "U" else 1]


def _matrix(path: Path, fields: Header, key: str, where: str = "") -> Floats:
    """A (4, 4) matrix, whose last row is 0 0 0 1."""
    matrix = _numbers(path, fields, key, 16, where).reshape(4, 4)
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        raise StudyError(
            f"{path.name}: {where}expected 0 0 0 1 as the last row of {key}, as proper rotations with a translation"
            f" have, got {matrix[3].tolist()}; a transposed matrix? write it row by row"
        )
    return matrix


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
    poses = table[:, 1:].reshape(-1, 4, 4)
    if not np.allclose(poses[valid, 3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        raise StudyError(
            f"{path.name}: expected 0 0 0 1 as the last row of every Study_Pose, got others; write it again"
        )
    return poses, valid, table[:, 0]


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
            poses[i], valid[i] = _matrix(path, fields, key, f"frame {i}: "), True
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
            transform = RigidTransform.from_matrix(_matrix(path, header, "Study_ProbeImageTransform"))
        return spacing, transform
    key = f"ImageTo{probe}Transform"
    for fields in frames:
        if key in fields and fields.get(f"{key}Status", "OK") == "OK":
            matrix = _matrix(path, fields, key)
            break
    else:
        return None, None
    x, y = matrix[:3, 0], matrix[:3, 1]
    sx, sy = float(np.linalg.norm(x)), float(np.linalg.norm(y))
    if not (sx > 0 and sy > 0 and abs(x @ y) < 1e-2 * sx * sy):
        raise StudyError(f"{path.name}: expected {key} with square axes, got a sheared or empty one; calibrate again")
    if max(sx, sy) < METRES_BELOW_MM:
        raise StudyError(
            f"{path.name}: expected {key} from pixels to mm, got pixels of {sx:g} x {sy:g} mm; in metres? multiply its"
            " first three rows by 1000"
        )
    rotation, _ = Rotation.align_vectors([x / sx, y / sy], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return (sx, sy), RigidTransform(rotation.as_matrix(), matrix[:3, 3])
