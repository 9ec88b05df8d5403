"""Clouds and waypoints of one's own: PLY and CSV in, registration results out."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pandas as pd
import trimesh

from study.errors import StudyError
from study.files.atomic import write_bytes, write_text
from study.registration import Registration
from study.types import Floats, PointCloud, as_points


def read_ply(path: str | os.PathLike[str]) -> Floats:
    """Points (n, 3) of a PLY file, a cloud or a mesh's vertices.

    Raises:
        StudyError: no such file, or not a PLY file with points.
    """
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
    return as_points(getattr(loaded, "vertices", np.empty((0, 3))), path.name)


def read_waypoints(path: str | os.PathLike[str]) -> Floats:
    """Waypoints (k, 3) mm from a CSV file with columns ``x``, ``y``, ``z``.

    Raises:
        StudyError: no such file, or other columns.
    """
    path = Path(path)
    try:
        table = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise StudyError(
            f"expected a CSV file of waypoints at {path}, got: {' '.join(str(error).split())}; check the path"
        ) from error
    if not {"x", "y", "z"} <= set(table.columns):
        raise StudyError(
            f"{path.name}: expected columns x, y, z, got {', '.join(map(str, table.columns))}; rename them"
        )
    return as_points(table[["x", "y", "z"]].to_numpy(), path.name)


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
    """Write a cloud's points as binary PLY, mm, in double precision and in their order.

    Raises:
        StudyError: another suffix.
    """
    path = as_ply_path(path)
    # By hand, since trimesh rounds to single precision: half a micrometre a metre away from the origin.
    properties = "".join(f"property double {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}end_header\n"
    content = header.encode("ascii") + cloud.points.astype("<f8").tobytes()
    write_bytes(path, content)
    return path


def write_registration(result: Registration, waypoints_us: Floats | None, folder: Path) -> list[str]:
    """Write ``warped.ply``, ``registration.json`` and, where given, ``waypoints_us.csv``.

    Returns:
        a line for each file, saying what it is.
    """
    write_ply(PointCloud(result.warped, "warped"), folder / "warped.ply")
    summary = {
        "method": result.method,
        "T_us_ct": result.T_us_ct.matrix.tolist(),
        "converged": result.converged,
        "n_iterations": result.n_iterations,
        "stop_reason": result.stop_reason,
        "warnings": list(result.warnings),
    }
    write_text(folder / "registration.json", json.dumps(summary, indent=2) + "\n")
    lines = [
        f"CT cloud in the US frame, mm: {folder / 'warped.ply'}",
        f"coarse or rigid transform and how it ended: {folder / 'registration.json'}",
    ]
    if waypoints_us is not None:
        table = pd.DataFrame(waypoints_us, columns=["x", "y", "z"]).to_csv(index=False, lineterminator="\n")
        write_text(folder / "waypoints_us.csv", table)
        lines.append(f"waypoints in the US frame, mm: {folder / 'waypoints_us.csv'}")
    return lines
