"""Tracked sweeps as folders: PNG masks, a CSV of frames and a CSV of poses, for trackers with formats of their own."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.files.atomic import replacing, write_text
from study.files.plus_config import METRES_BELOW_MM
from study.files.sweep_masks import read_png_masks
from study.types import RigidTransform
from study.ultrasound.tracked import TrackedSweep

POSE_COLUMNS = ["time_s", "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"]


def read_folder(folder: str | os.PathLike[str]) -> TrackedSweep:
    """Read a sweep from a folder of PNG masks and CSV files.

    The folder holds ``frames.csv`` (``file,time_s``: a grey PNG in the folder, anything above 0 is bone),
    ``poses.csv`` (``time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw`` and, if you have it, ``valid`` as 1 or 0: position and
    orientation of the probe in the base frame) and ``sweep.json`` (``pixel_spacing_mm``, ``T_probe_image`` as
    4 rows of 4, ``latency_s``; each may be left out).

    Raises:
        StudyError: a missing file or column, an image of another size, with colour or of more grey levels than a mask's
            two, or values out of range.
    """
    folder = Path(folder)
    frames = _read_table(folder / "frames.csv", ["file", "time_s"])
    poses_table = _read_table(folder / "poses.csv", POSE_COLUMNS)
    masks = read_png_masks(folder, [str(name) for name in frames["file"]], "frames.csv")
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
        if spacing is not None and max(float(spacing[0]), float(spacing[1])) < METRES_BELOW_MM:
            raise StudyError(f"sweep.json: expected pixel_spacing_mm, got {spacing}; in metres? multiply by 1000")
        if matrix is not None and not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
            raise StudyError(f"sweep.json: expected 0 0 0 1 as T_probe_image's last row, got {matrix[3]}; transposed?")
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
    except StudyError:
        raise
    except (TypeError, IndexError, ValueError) as error:
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
    files = [f"masks/{i:06d}.png" for i in range(sweep.n_frames)]
    for file, mask in zip(files, sweep.masks, strict=True):
        with replacing(folder / file) as temporary:
            sitk.WriteImage(sitk.GetImageFromArray(mask.astype(np.uint8) * 255), str(temporary))
    _write_table(pd.DataFrame({"file": files, "time_s": sweep.frame_times_s}), folder / "frames.csv")
    quaternions = np.zeros((len(sweep.poses), 4))
    quaternions[sweep.pose_valid] = Rotation.from_matrix(sweep.poses[sweep.pose_valid, :3, :3]).as_quat()
    positions = np.where(sweep.pose_valid[:, None], sweep.poses[:, :3, 3], 0.0)
    table = pd.DataFrame(np.column_stack([sweep.pose_times_s, positions, quaternions]), columns=POSE_COLUMNS)
    _write_table(table.assign(valid=sweep.pose_valid.astype(int)), folder / "poses.csv")
    settings: dict[str, Any] = {"name": sweep.name, "latency_s": sweep.latency_s}
    if sweep.pixel_spacing_mm is not None:
        settings["pixel_spacing_mm"] = list(sweep.pixel_spacing_mm)
    if sweep.T_probe_image is not None:
        settings["T_probe_image"] = sweep.T_probe_image.matrix.tolist()
    write_text(folder / "sweep.json", json.dumps(settings, indent=2) + "\n")


def _write_table(table: pd.DataFrame, path: Path) -> None:
    write_text(path, table.to_csv(index=False, lineterminator="\n"))


def _read_table(path: Path, columns: list[str]) -> pd.DataFrame:
    if not path.is_file():
        raise StudyError(f"{path.name}: expected this file in {path.parent}, got none; see study.files.read_folder")
    try:
        table = pd.read_csv(path)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise StudyError(f"{path.name}: expected a CSV table, got something else ({error}); save it again") from error
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
        raise StudyError(f"{path.name}: expected JSON, got something else ({error}); mend it") from error
    known = {"name", "latency_s", "pixel_spacing_mm", "T_probe_image"}
    if not isinstance(settings, dict) or not set(settings) <= known:
        raise StudyError(
            f"{path.name}: expected an object with {', '.join(sorted(known))}, got other keys; check the names"
        )
    return settings
