"""Clouds and waypoints of one's own: PLY and CSV in, registration results out."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import trimesh

from study.errors import StudyError
from study.files.atomic import write_bytes, write_text
from study.registration import Registration
from study.types import Floats, PointCloud, Waypoints, as_points, as_times

NOT_CARRIED = "waypoint not carried"
TIME = "time"  # the property of a PLY file's vertices that says when each was seen, s
MAX_STEP_S = 0.05  # between two times that a file can tell apart: a frame or two


def read_ply(path: str | os.PathLike[str]) -> Floats:
    """Points (n, 3) of a PLY file, a cloud or a mesh's vertices.

    Raises:
        StudyError: no such file, or not a PLY file with points.
    """
    return _read_vertices(path)[0]


def read_timed_ply(path: str | os.PathLike[str]) -> tuple[Floats, Floats | None]:
    """Points (n, 3) of a PLY file, and times (n,) s where its vertices have a property ``time``, else None.

    Raises:
        StudyError: as `read_ply`; times that are not finite, or that single precision has rounded to nothing.
    """
    points, columns = _read_vertices(path)
    if TIME not in columns:
        return points, None
    name, column = Path(path).name, np.asarray(columns[TIME]).reshape(-1)
    times = as_times(column, len(points), name)
    if column.dtype == np.float32 and np.spacing(np.abs(column).max()) > MAX_STEP_S:
        raise StudyError(
            f"{name}: expected times to {MAX_STEP_S:g} s or finer, got single precision at {times.max():.0f} s, which "
            "is coarser; write them as double, or count from the start of the sweep"
        )
    raw = np.column_stack([np.asarray(columns[axis]).reshape(-1) for axis in "xyz"])
    if not np.array_equal(raw, points):  # a textured mesh is cut up along its seams
        raise StudyError(f"{name}: expected times for the points of a cloud, got a mesh; export its vertices alone")
    return points, times


def _read_vertices(path: str | os.PathLike[str]) -> tuple[Floats, Mapping[str, Any]]:
    """Points (n, 3) of a PLY file, and its vertices' x, y, z and, where there is one, time, as the file has them."""
    path = Path(path)
    if not path.is_file():
        raise StudyError(f"expected a PLY file at {path}, got no such file; check the path")
    try:
        loaded = trimesh.load(path, file_type="ply", process=False)
    except Exception as error:  # trimesh raises whatever its parser met
        reason = " ".join(str(error).split()) or type(error).__name__
        raise StudyError(
            f"{path.name}: expected a PLY file with points, got unreadable bytes: {reason}; export it again"
        ) from error
    points = as_points(getattr(loaded, "vertices", np.empty((0, 3))), path.name)
    vertex = loaded.metadata["_ply_raw"]["vertex"]
    return points, {name: vertex["data"][name] for name in (*"xyz", TIME) if name in vertex["properties"]}


def read_waypoints(path: str | os.PathLike[str]) -> Waypoints:
    """Waypoints (k, 3) mm from a CSV file with columns ``x``, ``y``, ``z`` and, where there is one, ``label``.

    A waypoint without a label is called by its line in the file, the header being line 1.

    Raises:
        StudyError: no such file, other columns, or a place that is no number.
    """
    path = Path(path)
    try:
        table = pd.read_csv(path, skip_blank_lines=False).dropna(how="all")
    except (OSError, ValueError) as error:
        raise StudyError(
            f"expected a CSV file of waypoints at {path}, got: {' '.join(str(error).split())}; check the path"
        ) from error
    if not {"x", "y", "z"} <= set(table.columns):
        raise StudyError(
            f"{path.name}: expected columns x, y, z, got {', '.join(map(str, table.columns))}; name them in line 1"
        )
    lines = [f"line {number + 2}" for number in table.index]
    places = table[["x", "y", "z"]].apply(pd.to_numeric, errors="coerce").to_numpy(dtype=np.float64)
    bad = [line for line, place in zip(lines, places, strict=True) if not np.isfinite(place).all()]
    if bad:
        raise StudyError(
            f"{path.name}: expected finite numbers x, y, z in mm, got others in {', '.join(bad)}; mend them"
        )
    if "label" in table.columns:
        lines = [line if pd.isna(label) else str(label) for line, label in zip(lines, table["label"], strict=True)]
    return Waypoints(as_points(places, path.name), tuple(lines))


def as_ply_path(path: str | os.PathLike[str]) -> Path:
    """The path of a cloud to write; ask before a long computation.

    Raises:
        StudyError: another suffix than .ply.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise StudyError(f"expected a file name that ends in .ply, got {path.name!r}")
    return path


def write_ply(cloud: PointCloud, path: str | os.PathLike[str]) -> Path:
    """Write a cloud's points as binary PLY, mm, and its times, s, in double precision and in their order.

    Raises:
        StudyError: another suffix.
    """
    path = as_ply_path(path)
    # By hand, since trimesh rounds to single precision: half a micrometre a metre away from the origin.
    names = "xyz" if cloud.times is None else [*"xyz", TIME]
    rows = cloud.points if cloud.times is None else np.column_stack([cloud.points, cloud.times])
    properties = "".join(f"property double {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}end_header\n"
    content = header.encode("ascii") + rows.astype("<f8").tobytes()
    write_bytes(path, content)
    return path


def write_registration(
    result: Registration, folder: Path, waypoints: Waypoints | None = None, radius_mm: float = 20.0
) -> list[str]:
    """Write ``warped.ply``, ``registration.json`` and, where waypoints are given, ``waypoints_us.csv``.

    A waypoint that cannot be carried keeps its row: empty places and the reason, in a column that is there only then.

    Args:
        result: a registration.
        folder: where to write.
        waypoints: mm, CT frame.
        radius_mm: sphere of the path transfer (sec. III-D).

    Returns:
        a line for each file, saying what it is, and one for each waypoint that was not carried.

    Raises:
        StudyError: not one waypoint can be carried; nothing is written.
    """
    table, told = None, []
    if waypoints is not None:
        path = result.carry_path(waypoints.points, radius_mm)
        told = [f"{label}: {reason}" for label, reason in zip(waypoints.labels, path.reasons, strict=True) if reason]
        if len(told) == len(waypoints):
            raise StudyError(f"waypoints: expected one or more that can be carried, got none: {told[0]}")
        table = pd.DataFrame(path.points, columns=["x", "y", "z"])
        if not all(label.startswith("line ") for label in waypoints.labels):
            table["label"] = waypoints.labels
        if told:
            table["reason"] = path.reasons
    for name in ("registration.json", "waypoints_us.csv"):  # of an earlier registration, which this one is not
        (folder / name).unlink(missing_ok=True)
    write_ply(PointCloud(result.warped, "warped"), folder / "warped.ply")
    summary = {
        "method": result.method,
        "converged": result.converged,
        "warnings": [*result.warnings, *(f"{NOT_CARRIED}: {one}" for one in told)],
        "quality": None if result.quality is None else asdict(result.quality),
        "n_iterations": result.n_iterations,
        "stop_reason": result.stop_reason,
        "T_us_ct": result.T_us_ct.matrix.tolist(),
        "T_us_ct_is": "the rigid part of the result only, CT frame to US frame, mm; no probe should follow it",
    }
    write_text(folder / "registration.json", json.dumps(summary, indent=2) + "\n")
    lines = [
        f"CT cloud in the US frame, mm: {folder / 'warped.ply'}",
        f"quality, warnings, rigid part (not for a probe to follow): {folder / 'registration.json'}",
    ]
    if table is not None:
        write_text(folder / "waypoints_us.csv", table.to_csv(index=False, lineterminator="\n"))
        lines.append(f"waypoints in the US frame, mm: {folder / 'waypoints_us.csv'}")
    return [*lines, *(f"{NOT_CARRIED}: {one}" for one in told)]
