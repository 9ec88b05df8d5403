"""A fitted calibration as a file: spatial, temporal or both, with its units, its frames and how far to trust it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from study.errors import StudyError
from study.files.atomic import write_json
from study.files.plus_config import METRES_BELOW_MM, PixelCalibration, matrix_of
from study.types import RigidTransform
from study.ultrasound.spatial import SpatialCalibration
from study.ultrasound.temporal import LatencyCalibration

FORMAT = "study calibration 1"
UNITS = {"length": "mm", "angle": "deg", "time": "s"}
FRAMES = {
    "image": "x mm along the columns, y mm along the rows away from the transducer, from the centre of pixel (0, 0)",
    "probe": "the tracked tool's; its pose in the recording maps it to the base frame",
    "T_probe_image": "4 rows of 4, maps a point of the image frame to the probe frame",
}
MEANINGS = {
    "latency_s": "stamps of frames minus stamps of poses for the same moment",
    "residual_mm": "root mean square distance of the views from the phantom",
    "sd_mm": "standard error of the translation, largest axis",
    "sd_deg": "standard error of the rotation, largest axis",
    "residual": "root mean square misfit of depth and height, in the unit of the depths that were given",
}
SPATIAL = ("T_probe_image", "pixel_spacing_mm", "residual_mm", "sd_mm", "sd_deg", "point")
TEMPORAL = ("latency_s", "sd_s", "correlation", "period_s", "residual", "n_frames")


@dataclass(frozen=True)
class SavedCalibration:
    """What `read_calibration` found.

    Attributes:
        spatial: where the image lies on the probe, or None.
        temporal: how late the images are, or None.
    """

    spatial: SpatialCalibration | None
    temporal: LatencyCalibration | None

    def pixels(self, name: str) -> PixelCalibration:
        """What a sweep needs of it; ``name`` is the file's, for the notes."""
        notes = []
        if self.spatial is not None:
            notes.append(f"calibration of {name}, root mean square {self.spatial.residual_mm:.2f} mm")
        if self.temporal is not None:
            notes.append(f"latency of {name}, {1000 * self.temporal.latency_s:.0f} ms")
        return PixelCalibration(
            None if self.spatial is None else self.spatial.pixel_spacing_mm,
            None if self.spatial is None else self.spatial.T_probe_image,
            None if self.temporal is None else self.temporal.latency_s,
            tuple(notes),
        )


def write_calibration(
    path: str | os.PathLike[str],
    spatial: SpatialCalibration | None = None,
    temporal: LatencyCalibration | None = None,
) -> Path:
    """Write calibrations as JSON that says its units, frames and root mean square misfits.

    Raises:
        StudyError: another suffix than .json, nothing to write, or values that `read_calibration` would refuse.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        raise StudyError(f"{path.name}: expected a file name that ends in .json, got another; rename it")
    if spatial is None and temporal is None:
        raise StudyError(f"{path.name}: expected a spatial or a temporal calibration, got neither; fit one first")
    content: dict[str, Any] = {"format": FORMAT, "units": UNITS, "frames": FRAMES, "meanings": MEANINGS}
    if spatial is not None:
        content["spatial"] = {key: getattr(spatial, key) for key in SPATIAL} | {
            "T_probe_image": spatial.T_probe_image.matrix.tolist(),
            "point": None if np.isnan(spatial.point).any() else spatial.point.tolist(),  # wires have no point
        }
    if temporal is not None:
        content["temporal"] = {key: getattr(temporal, key) for key in TEMPORAL}
    _saved(path.name, json.loads(json.dumps(content, default=_listed)))
    write_json(content, path)
    return path


def read_calibration(path: str | os.PathLike[str]) -> SavedCalibration:
    """Read what `write_calibration` wrote.

    Raises:
        StudyError: no such file, no JSON, another format or version, other units, a missing or unknown entry, values
            that are no finite numbers or out of range, or a ``T_probe_image`` that is not rigid.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise StudyError(f"{path.name}: expected a calibration, got no file at {path}; check the path") from error
    except ValueError as error:
        raise StudyError(
            f"{path.name}: expected a calibration as JSON, got something else ({error}); fit it again"
        ) from error
    return _saved(path.name, content)


def _listed(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _saved(name: str, content: Any) -> SavedCalibration:
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise StudyError(f"{name}: expected the format {FORMAT!r}, got another file; write it with write_calibration")
    for key, expected in (("units", UNITS), ("frames", FRAMES)):
        if content.get(key) != expected:
            raise StudyError(
                f"{name}: expected {key} {json.dumps(expected)}, got {json.dumps(content.get(key))[:200]}; they cannot"
                " be altered: convert the numbers instead"
            )
    unknown = set(content) - {"format", "units", "frames", "meanings", "spatial", "temporal"}
    if unknown or not {"spatial", "temporal"} & set(content):
        raise StudyError(f"{name}: expected 'spatial' or 'temporal', got {', '.join(sorted(content))}; fit it again")
    spatial, temporal = content.get("spatial"), content.get("temporal")
    return SavedCalibration(
        None if spatial is None else _spatial(name, spatial), None if temporal is None else _temporal(name, temporal)
    )


def _spatial(name: str, entry: Any) -> SpatialCalibration:
    _check_keys(name, "spatial", entry, SPATIAL)
    try:
        numbers = np.array(entry["T_probe_image"], dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (4, 4):
        raise StudyError(f"{name}: expected 4 rows of 4 numbers as T_probe_image, got others; fit it again")
    matrix = matrix_of(numbers, name, "T_probe_image")
    try:
        rigid = RigidTransform.from_matrix(matrix)
    except StudyError as error:
        raise StudyError(f"{name}: expected a rigid T_probe_image, got one that is not: {error}") from error
    spacing = entry["pixel_spacing_mm"]
    if not isinstance(spacing, list) or len(spacing) != 2:
        raise StudyError(f"{name}: expected two pixel_spacing_mm, got {str(spacing)[:40]}; fit it again")
    sx, sy = (_number(name, {"pixel_spacing_mm": value}, "pixel_spacing_mm", 0.0) for value in spacing)
    if not (min(sx, sy) >= METRES_BELOW_MM and max(sx, sy) < 10):
        raise StudyError(f"{name}: expected pixels of {METRES_BELOW_MM:g} to 10 mm, got {sx:g} x {sy:g}; metres?")
    point = entry["point"]
    if point is not None and (not isinstance(point, list) or len(point) != 3):
        raise StudyError(f"{name}: expected three numbers or null as point, got {str(point)[:40]}; fit it again")
    place = [_number(name, {"point": value}, "point") for value in point or ()] or [math.nan] * 3
    residual, sd_mm, sd_deg = (_number(name, entry, key, 0.0) for key in ("residual_mm", "sd_mm", "sd_deg"))
    return SpatialCalibration(rigid, (sx, sy), residual, sd_mm, sd_deg, np.array(place))


def _temporal(name: str, entry: Any) -> LatencyCalibration:
    _check_keys(name, "temporal", entry, TEMPORAL)
    latency_s = _number(name, entry, "latency_s")
    if not abs(latency_s) < 10:
        raise StudyError(f"{name}: expected latency_s in seconds, got {latency_s:g}; milliseconds? divide by 1000")
    n_frames = _number(name, entry, "n_frames", 1.0)
    others = {key: _number(name, entry, key, 0.0) for key in ("correlation", "sd_s", "period_s", "residual")}
    if others["correlation"] > 1:
        raise StudyError(f"{name}: expected a correlation of 0 to 1, got {others['correlation']:g}; fit it again")
    return LatencyCalibration(latency_s=latency_s, n_frames=int(n_frames), **others)


def _check_keys(name: str, what: str, entry: Any, keys: tuple[str, ...]) -> None:
    if not isinstance(entry, dict) or set(entry) != set(keys):
        found = ", ".join(sorted(entry)) if isinstance(entry, dict) else str(entry)[:40]
        raise StudyError(f"{name}: expected {what} with {', '.join(keys)}, got {found}; fit it again")


def _number(name: str, entry: Mapping[str, Any], key: str, least: float = -math.inf) -> float:
    value = entry[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < least:
        limit = "" if least == -math.inf else f" of {least:g} or more"
        raise StudyError(f"{name}: expected a finite number{limit} as {key}, got {str(value)[:40]}; fit it again")
    return float(value)
