"""Reading PLUS sequence files: tracked sweeps as 3D Slicer and the PLUS toolkit record them."""

from __future__ import annotations

import os
from collections.abc import Sequence as Rows
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from study.errors import StudyError
from study.files.calibration import read_calibration
from study.files.plus_config import PixelCalibration, config_beside, matrix_of, pixel_calibration, read_config
from study.files.sequences import ORIENTATION, Header, Sequence, numbers_of, read_sequence
from study.files.sweep_masks import check_masks, read_mask_stack
from study.types import Bools, Floats, RigidTransform
from study.ultrasound.tracked import TrackedSweep

REFERENCE, TRACKER = "Reference", "Tracker"  # PLUS's usual names: a tool fixed to the patient, the device's own frame
SAME_PIXEL_MM = 0.01  # two calibrations that differ by more anywhere in the image are two calibrations


def read_plus(
    path: str | os.PathLike[str],
    *,
    masks: str | os.PathLike[str] | None = None,
    segments: Rows[str] | None = None,
    config: str | os.PathLike[str] | None = None,
    probe: str = "Probe",
    base: str | None = None,
    pixel_spacing_mm: tuple[float, float] | None = None,
    T_probe_image: RigidTransform | None = None,
    latency_s: float | None = None,
) -> TrackedSweep:
    """Read a PLUS sequence file (``.igs.mha``, ``.seq.mha``, ``.nrrd``, ``.seq.nrrd``), compressed or not.

    Files of `write_plus` come back as they were. In files of other programs every frame carries its own pose and
    frames count as B-mode. The calibration is ``ImageTo<probe>Transform`` where the file has it, else that of the
    ``<name>_config.xml`` which PLUS leaves beside a recording. Images are turned to the orientation MF (marked side
    first, transducer on top), to which that transform belongs; RGB becomes grey. What was chosen is in ``notes``;
    transforms that are not used are kept in ``frame_fields``, for `write_plus`.

    Args:
        path: the file.
        masks: a file of the same frames that holds their masks, or a folder of PNGs, as `read_mask_stack` takes them.
            They are taken to lie as the images do where they state no orientation, as files of programs that know
            nothing of ultrasound.
        segments: names of the segments of a ``.seg.nrrd`` that are bone or cartilage; its only one when None.
        config: a PLUS configuration, or a calibration of `write_calibration`, instead of the file's own.
        probe: the probe's frame in the names of the file's transforms.
        base: the base frame in them; ``<probe>To<base>Transform`` is used, or both over ``Tracker``. When None the
            ``Reference``, which moves with the patient, where the file has one, else the ``Tracker``.
        pixel_spacing_mm: (sx, sy) mm, instead of the file's.
        T_probe_image: image (mm) to probe, instead of the file's.
        latency_s: instead of the file's; files of other programs have none, which is 0 (PLUS has already taken its
            own ``LocalTimeOffsetSec`` out of the stamps).

    Raises:
        StudyError: no sequence file, truncated, damaged or mis-sized data, no time stamps, no poses or valid frames,
            values out of range, two calibrations that disagree, or masks that are B-mode or of another recording.

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
    found = read_sequence(path)
    pixels = found.turned()
    times = _stamps(found)
    notes = [*_own_notes(found.header), *found.notes]
    tracking = _own_poses(found, probe, base)
    if tracking is None:
        base, why = _choose_base(found.frames, probe, base)
        notes.append(why)
        tracking = _Tracking((probe, base), *_frame_poses(found, probe, base), times)
    calibrated = _calibration(path, found, tracking.frame_names[0], config)
    notes += calibrated.notes
    if latency_s is None and calibrated.latency_s is not None:
        latency_s = calibrated.latency_s
    if latency_s is None:
        known = "Study_LatencyS" in found.header
        latency_s = float(numbers_of(path.name, found.header, "Study_LatencyS", 1)[0]) if known else 0.0
    shown = _shown(found)
    bones = pixels if found.content == "masks" else None
    if bones is not None:
        check_masks(bones, path.name)
    if masks is not None:
        orientation = found.header.get(ORIENTATION, "MF")
        bones, told = read_mask_stack(
            Path(masks), found.pixels.shape, times, path.name, orientation=orientation, segments=segments
        )
        notes += told
    return TrackedSweep(
        frame_times_s=times[shown],
        poses=tracking.poses,
        pose_times_s=tracking.times_s,
        pose_valid=tracking.valid,
        masks=None if bones is None else bones[shown] > 0,
        images=None if found.content == "masks" else pixels[shown],
        pixel_spacing_mm=pixel_spacing_mm or calibrated.pixel_spacing_mm,
        T_probe_image=T_probe_image or calibrated.T_probe_image,
        latency_s=latency_s,
        name=found.header.get("Study_Name", path.name.split(".")[0]),
        frame_names=tracking.frame_names,
        frame_fields=_unused(found.frames, times, *tracking.frame_names),
        notes=tuple(notes),
    )


@dataclass(frozen=True)
class _Tracking:
    """Names of the probe's and the base frame, poses (p, 4, 4), their validity (p,) and times (p,) s."""

    frame_names: tuple[str, str]
    poses: Floats
    valid: Bools
    times_s: Floats


def _stamps(found: Sequence) -> Floats:
    """Time stamp (f,) s of each frame."""
    return np.array(
        [numbers_of(found.name, fields, "Timestamp", 1, f"frame {i}: ")[0] for i, fields in enumerate(found.frames)]
    )


def _shown(found: Sequence) -> Bools:
    """Which frames (f,) have an image: a tracker may go on while the image stops, and the pixels then mean nothing."""
    shown = np.array([fields.get("ImageStatus", "OK") == "OK" for fields in found.frames])
    if not shown.any():
        raise StudyError(
            f"{found.name}: expected at least one valid frame, got none of {len(shown)} (ImageStatus); record with the"
            " image on"
        )
    return shown


def _own_notes(header: Header) -> list[str]:
    return [value for key, value in sorted(header.items()) if key.startswith("Study_Note")]


def _unused(frames: list[Header], times: Floats, probe: str, base: str) -> dict[float, dict[str, str]]:
    """What the frames say beyond what is read, by their stamps; nothing of frames that share a stamp."""
    used = {"Timestamp", "ImageStatus"}
    for key in (f"{probe}To{base}Transform", f"{probe}ToTrackerTransform", f"ImageTo{probe}Transform"):
        used |= {key, f"{key}Status"}
    stamps, counts = np.unique(times, return_counts=True)
    alone = set(stamps[counts == 1].tolist())
    kept = {
        time: {key: value for key, value in fields.items() if key not in used}
        for time, fields in zip(times.tolist(), frames, strict=True)
        if time in alone
    }
    return {time: fields for time, fields in kept.items() if fields}


def _own_poses(found: Sequence, probe: str, base: str | None) -> _Tracking | None:
    """Poses, validity and times as `write_plus` keeps them; None in files of other programs."""
    rows = [value.split() for key, value in found.header.items() if key.startswith("Study_Pose")]
    if not rows:
        return None
    names = found.header.get("Study_Frames", f"{probe} {TRACKER}").split()
    if len(names) != 2 or (base is not None and base != names[1]):
        raise StudyError(
            f"{found.name}: expected poses in the base frame {base or 'that Study_Frames names'}, got"
            f" {' '.join(names[1:]) or 'none'}; leave base out, or read the original recording"
        )
    try:
        valid = np.array([row.pop(1) == "OK" for row in rows])
        table = np.array(rows, dtype=np.float64).reshape(len(rows), 17)
    except (ValueError, IndexError):
        raise StudyError(
            f"{found.name}: expected Study_Pose lines of time, status and 16 numbers; they are damaged"
        ) from None
    poses = table[:, 1:].reshape(-1, 4, 4)
    if not np.allclose(poses[valid, 3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        raise StudyError(
            f"{found.name}: expected 0 0 0 1 as the last row of every Study_Pose, got others; write it again"
        )
    return _Tracking((names[0], names[1]), poses, valid, table[:, 0])


def _choose_base(frames: list[Header], probe: str, base: str | None) -> tuple[str, str]:
    """The base frame, and why it is that one."""
    if base is not None:
        return base, f"base frame {base}, as asked"
    direct, over = f"{probe}To{REFERENCE}Transform", f"{REFERENCE}To{TRACKER}Transform"
    for key in (direct, over):
        found = [fields for fields in frames if key in fields]
        if any(fields.get(f"{key}Status", "OK") == "OK" for fields in found):
            return REFERENCE, f"base frame {REFERENCE}, which moves with the patient: {key} is in the file"
        if found:
            return TRACKER, f"base frame {TRACKER}: {key} is in the file, but not valid in any frame"
    return TRACKER, f"base frame {TRACKER}: no {over} is in the file"


def _frame_poses(found: Sequence, probe: str, base: str) -> tuple[Floats, Bools]:
    """Each frame's pose (f, 4, 4) of the probe in the base frame, and whether it is valid."""
    direct = f"{probe}To{base}Transform"
    names = sorted({key for fields in found.frames for key in fields if key.endswith("Transform")})
    if direct in names:
        return _transforms(found, direct)
    over = f"{probe}ToTrackerTransform", f"{base}ToTrackerTransform"
    if not set(over) <= set(names):
        lacking = direct if base == TRACKER or over[1] not in names else over[0]
        raise StudyError(
            f"{found.name}: expected a pose {lacking} per frame, got {', '.join(names) or 'no transforms at all'}; name"
            " the frames with probe= and base=, or record with tracking on"
        )
    (T_tracker_probe, seen), (T_tracker_base, also) = (_transforms(found, key) for key in over)
    both = seen & also
    if not both.any():
        raise StudyError(
            f"{found.name}: expected frames that see {probe} and {base} at once, got none of {len(both)}; give"
            " base='Tracker', or record with both in view"
        )
    poses = np.tile(np.eye(4), (len(both), 1, 1))
    poses[both] = np.linalg.inv(T_tracker_base[both]) @ T_tracker_probe[both]
    return poses, both


def _transforms(found: Sequence, key: str) -> tuple[Floats, Bools]:
    frames = found.frames
    poses, valid = np.tile(np.eye(4), (len(frames), 1, 1)), np.zeros(len(frames), dtype=bool)
    for i, fields in enumerate(frames):
        if key in fields and fields.get(f"{key}Status", "OK") == "OK":
            where = f"frame {i}: "
            poses[i] = matrix_of(numbers_of(found.name, fields, key, 16, where), found.name, key, where)
            valid[i] = True
    if not valid.any():
        raise StudyError(
            f"{found.name}: expected valid poses {key}, got none in {len(frames)} frames; was the probe in view?"
        )
    return poses, valid


def _calibration(path: Path, found: Sequence, probe: str, config: str | os.PathLike[str] | None) -> PixelCalibration:
    """The calibration that is asked for, else the recording's."""
    if config is None:
        return _recorded_calibration(path, found, probe)
    chosen = Path(config)
    if chosen.suffix.lower() == ".json":
        asked = read_calibration(chosen).pixels(chosen.name)
        if asked.T_probe_image is not None:
            return asked
        recorded = _recorded_calibration(path, found, probe)
        return replace(recorded, latency_s=asked.latency_s, notes=(*recorded.notes, *asked.notes))
    stated = read_config(chosen, probe)
    if stated is None or stated.T_probe_image is None:
        raise StudyError(
            f"{chosen.name}: expected a Transform from Image to {probe}, got none but the identity; calibrate the"
            " probe in PLUS, or name its frame with probe="
        )
    return replace(stated, notes=(f"calibration of {chosen.name}, as asked",))


def _recorded_calibration(path: Path, found: Sequence, probe: str) -> PixelCalibration:
    """The calibration in the recording, else that of the configuration beside it."""
    own = _own_calibration(found, probe)
    beside = config_beside(path)
    other = None if beside is None else read_config(beside, probe)
    if other is None or other.T_probe_image is None:
        return own if other is None else replace(own, notes=(*own.notes, *other.notes))
    assert beside is not None
    if own.T_probe_image is None:
        return replace(other, notes=(*own.notes, f"calibration of {beside.name}, beside the recording"))
    corners = np.array([[0, 0, 0], [found.pixels.shape[2], 0, 0], [0, found.pixels.shape[1], 0]], dtype=np.float64)
    ends = [one.T_probe_image.apply(corners * [*(one.pixel_spacing_mm or (1.0, 1.0)), 1.0]) for one in (own, other)
            if one.T_probe_image is not None]  # fmt: skip
    off_mm = float(np.linalg.norm(ends[0] - ends[1], axis=1).max())
    if off_mm > SAME_PIXEL_MM:
        raise StudyError(
            f"{path.name}: expected one calibration, got its own and that of {beside.name}, {off_mm:.2f} mm apart;"
            " choose with config=, or rename the configuration that is not of this recording"
        )
    return own


def _own_calibration(found: Sequence, probe: str) -> PixelCalibration:
    """Pixel spacing and image (mm) to probe, as far as the recording knows them."""
    if found.content is not None:
        spacing, transform = None, None
        if "Study_PixelSpacingMm" in found.header:
            sx, sy = numbers_of(found.name, found.header, "Study_PixelSpacingMm", 2)
            spacing = (float(sx), float(sy))
        key = "Study_ProbeImageTransform"
        if key in found.header:
            numbers = numbers_of(found.name, found.header, key, 16)
            transform = RigidTransform.from_matrix(matrix_of(numbers, found.name, key))
        return PixelCalibration(spacing, transform)
    key = f"ImageTo{probe}Transform"
    for fields in found.frames:
        if key in fields and fields.get(f"{key}Status", "OK") == "OK":
            matrix = matrix_of(numbers_of(found.name, fields, key, 16), found.name, key)
            return pixel_calibration(matrix, found.name, key)
    return PixelCalibration()
