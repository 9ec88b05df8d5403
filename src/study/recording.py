"""From a recording of one's own to a cloud, with a picture and what became of every frame: `study sweep`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from study import __version__, figures
from study.errors import StudyError
from study.files.atomic import sha256_of, write_bytes, write_json
from study.files.clouds import as_ply_path, write_ply
from study.files.plus import read_plus
from study.files.sweep_folder import read_folder
from study.types import Floats
from study.ultrasound.bone_surface import BoneFinder, mask_sweep
from study.ultrasound.cloud import EMPTY, USED, SweepCloud, frame_fates, sweep_cloud
from study.ultrasound.tracked import TrackedSweep

FOUND = (
    "masks: none given, so the surface was looked for in the B-mode (a baseline without training, see"
    " docs/ultrasound.md): look at the picture before you use it"
)
FEW_USED = 0.5  # of the frames: fewer deserve a word
SHOTS = 6  # frames in the picture
MAX_RANGES = 12  # of frame numbers in a line; the report has all


@dataclass(frozen=True)
class _Masked:
    """A sweep with masks; where they were found here, each frame's quality (f,) and which (f,) are poor."""

    sweep: TrackedSweep
    quality: Floats | None = None
    fates: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def cloud_of_recording(
    recording: Path,
    out: Path,
    *,
    config: Path | None = None,
    masks: Path | None = None,
    segments: Sequence[str] = (),
    probe: str = "Probe",
    base: str | None = None,
    latency_s: float | None = None,
    spacing_mm: float = 1.5,
    show_progress: bool = False,
) -> list[str]:
    """Write the cloud of a recording, a picture and a report beside it.

    Args:
        recording: a PLUS sequence, or a folder of `study.files.read_folder`.
        out: the cloud, ``.ply``; ``.png`` and ``.json`` of the same name lie beside it.
        config, masks, segments, probe, base, latency_s: as `study.files.read_plus` takes them.
        spacing_mm: between points of the cloud.
        show_progress: a bar on standard error while frames are searched.

    Returns:
        lines to print: how the recording was read, frames used and dropped and why, and what was written.

    Raises:
        StudyError: what the readers and `sweep_cloud` refuse; nothing is written.
    """
    out = as_ply_path(out)
    if recording.is_dir():
        if config is not None or masks is not None or segments or base is not None:
            raise StudyError(f"{recording.name}: expected a folder that holds all, got further files; leave them out")
        sweep = read_folder(recording)
    else:
        sweep = read_plus(
            recording, masks=masks, segments=list(segments) or None, config=config, probe=probe, base=base,
            latency_s=latency_s,
        )  # fmt: skip
    masked = _with_masks(sweep, show_progress)
    made = sweep_cloud(masked.sweep, spacing_mm=spacing_mm)
    picture, report = out.with_suffix(".png"), out.with_suffix(".json")
    content = _content(recording, masked, made)
    write_ply(made.cloud, out)
    write_bytes(picture, figures.png(_picture(masked, made)))
    write_json(content, report)
    counts = Counter(masked.fates)
    front = ",".join(f"{value:.3f}" for value in np.round(made.front, 3) + 0.0)  # no minus before a zero
    lines = [*masked.notes, f"latency {1000 * masked.sweep.latency_s:.0f} ms taken out of the frames' stamps"]
    for fate, n in counts.most_common():
        numbers = _ranges([i for i, one in enumerate(masked.fates) if one == fate])
        lines.append(f"frames {fate}: {n} of {len(masked.fates)}" + ("" if fate == USED else f" (numbers {numbers})"))
    if counts[USED] < FEW_USED * len(masked.fates):
        lines.append(f"study: warning: only {counts[USED]} of {len(masked.fates)} frames were used; see {report.name}")
    return [
        *lines,
        f"{len(made.cloud)} points, mm, frame {masked.sweep.frame_names[1]}, with their times: {out}",
        f"towards the skin, for study register: --front {front}",
        f"picture: {picture}",
        f"what became of every frame: {report}",
    ]


def _with_masks(sweep: TrackedSweep, show_progress: bool) -> _Masked:
    if sweep.masks is not None:
        return _Masked(sweep, None, tuple(frame_fates(sweep)), sweep.notes)
    if sweep.pixel_spacing_mm is None or sweep.T_probe_image is None:  # before minutes of looking
        raise StudyError(f"{sweep.name}: expected a calibration, got none in the recording or beside it; give --config")

    def shown(numbers: Iterable[int]) -> Iterable[int]:
        return tqdm(numbers, desc="surface in B-mode", unit="frame", disable=not show_progress)

    masked, found = mask_sweep(sweep, progress=shown)
    poor = f"poor image, quality below {BoneFinder.min_quality:g}"
    fates = [poor if fate == EMPTY and bad else fate for fate, bad in zip(frame_fates(masked), found.poor, strict=True)]
    return _Masked(masked, found.quality, tuple(fates), (*sweep.notes, FOUND))


def _ranges(numbers: list[int]) -> str:
    """Rising numbers as ``3, 7-9``, the first dozen ranges of them."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    shown = [f"{first}" if first == last else f"{first}-{last}" for first, last in runs[:MAX_RANGES]]
    return ", ".join([*shown, *(["..."] if len(runs) > MAX_RANGES else [])])


def _content(recording: Path, masked: _Masked, made: SweepCloud) -> dict[str, Any]:
    """The report: where the cloud is from, how it was made, and every frame."""
    sweep = masked.sweep
    frames = [
        {"frame": i, "time_s": time, "what": fate, "quality": None if np.isnan(quality) else quality}
        for i, (time, fate, quality) in enumerate(
            zip(
                sweep.frame_times_s.tolist(),
                masked.fates,
                [np.nan] * sweep.n_frames if masked.quality is None else masked.quality.tolist(),
                strict=True,
            )
        )
    ]
    return {
        "version": __version__,
        "recording": recording.name,
        "recording_sha256": sha256_of(recording) if recording.is_file() else None,
        "notes": list(masked.notes),
        "units": {"length": "mm", "time": "s"},
        "base_frame": sweep.frame_names[1],
        "front": made.front,
        "front_is": "unit vector from the anatomy towards the skin, base frame",
        "latency_s": sweep.latency_s,
        "pixel_spacing_mm": sweep.pixel_spacing_mm,
        "T_probe_image": None if sweep.T_probe_image is None else sweep.T_probe_image.matrix,
        "masks_found_here": masked.quality is not None,
        "n_points": len(made.cloud),
        "n_contour": made.report.n_contour,
        "frames": frames,
    }


def _picture(masked: _Masked, made: SweepCloud) -> Figure:
    """The cloud, and frames spread over those that were used."""
    sweep = masked.sweep
    assert sweep.masks is not None
    assert sweep.pixel_spacing_mm is not None
    used = np.flatnonzero(np.array(masked.fates) == USED)
    chosen = used[np.linspace(0, len(used) - 1, min(SHOTS, len(used))).astype(np.int64)]
    shots = []
    for i in chosen.tolist():
        quality = "" if masked.quality is None else f", quality {masked.quality[i]:.2f}"
        shots.append((f"frame {i}{quality}", None if sweep.images is None else sweep.images[i], sweep.masks[i]))
    title = f"{sweep.name}: {len(used)} of {sweep.n_frames} frames"
    if masked.quality is not None:
        title += ", surface found in the B-mode"
    return figures.sweep_overview(made.cloud, made.beam, shots, sweep.pixel_spacing_mm, title=title)
