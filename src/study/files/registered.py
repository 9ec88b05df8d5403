"""What `study register` writes: a registration in the forms that 3D Slicer, ITK and a robot's planner read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import study
from study.errors import StudyError
from study.files.atomic import filling, sha256_of, write_json, write_text
from study.files.clouds import write_ply
from study.files.meanings import FILES, FRAMES, MEANINGS, ROBOT_MEANINGS
from study.files.transforms import Field, Grid, sample_field, write_field, write_rigid
from study.files.waypoints import WaypointFile, csv_text, markups
from study.geometry.points import nearest
from study.guidance import NEIGHBOURS, GuidedPath, guide
from study.registration import REACH_MM, FieldRegistration, Registration
from study.types import Ints, PointCloud, Waypoints

NOT_CARRIED = "waypoint not carried"
SUMMARY = "registration.json"
WHOLE_MM = 1e-3  # a result that leaves its rigid part by less is rigid
MOST_RETURN_MM = 2.0  # of 19 in 20 warped points: a field that takes more of them farther from where they came from


@dataclass(frozen=True)
class Request:
    """What a registration to be written was made of.

    Attributes:
        inputs: what is known of each input file, by what it is: ``"ct"``, ``"us"``, ``"waypoints"``, ``"field"``.
        parameters: of the method; None where it was not said, as
        seed: of the draws.
        front: direction to the probe, where it was given.
        radius_mm: sphere of the path transfer.
    """

    inputs: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    parameters: Mapping[str, Any] | None = None
    seed: int | None = None
    front: list[float] | None = None
    radius_mm: float = 20.0


def describe(path: str | os.PathLike[str], **known: Any) -> dict[str, Any]:
    """Name and SHA-256 of an input file, and what else is known of it."""
    return {"file": Path(path).name, "sha256": sha256_of(Path(path)), **known}


def write_registration(
    result: Registration, folder: Path, waypoints: Waypoints | None = None, radius_mm: float = 20.0
) -> list[str]:
    """Write a registration that was made in Python: `write_result`, without what only a file can tell.

    Args:
        result: of `study.register_pair`.
        folder: where to write.
        waypoints: mm, CT frame.
        radius_mm: sphere of the path transfer (sec. III-D).

    Returns:
        a line for each file, saying what it is, and one for each waypoint that was not carried.

    Raises:
        StudyError: not one waypoint can be carried; nothing is written.
    """
    given = None if waypoints is None else WaypointFile(waypoints, "RAS", ("",) * len(waypoints))
    lines, told = write_result(result, folder, Request(radius_mm=radius_mm), waypoints=given)
    return [*lines, *(one for one in told if one.startswith(NOT_CARRIED))]


def write_result(
    result: Registration,
    folder: Path,
    request: Request,
    *,
    waypoints: WaypointFile | None = None,
    grid: Grid | None = None,
    faces: Ints | None = None,
) -> tuple[list[str], list[str]]:
    """Write a registration: all of its files, or none.

    Files of an earlier registration go, other files in the folder stay. ``registration.json`` is put there last: a
    folder with it is whole. A waypoint that cannot be carried keeps its row, without a place and with the reason.

    Args:
        result: of `study.register_pair`.
        folder: where to write.
        request: what it was made of.
        waypoints: of the CT frame.
        grid: of the displacement field, US frame; none is written without.
        faces: (f, 3) of the CT points, where they are a surface.

    Returns:
        a line for each file, saying what it is, and a sentence for each thing to be warned of.

    Raises:
        StudyError: not one waypoint can be carried, or a grid elsewhere than the result; nothing is written.
    """
    guided = None if waypoints is None else guide(result, waypoints.waypoints, request.radius_mm)
    sampled = None if grid is None else sample_field(result, grid)
    suspect = [*result.warnings, *([] if result.converged else [f"not converged: {result.stop_reason}"])]
    told = [] if sampled is None else _field_warnings(sampled)
    if guided is not None and waypoints is not None:
        reasons = zip(waypoints.waypoints.labels, guided.reasons, strict=True)
        told += [f"{NOT_CARRIED}: {label}: {reason}" for label, reason in reasons if reason]
    with filling(folder, list(FILES), SUMMARY) as new:
        _write_cloud(result, faces, new)
        write_rigid(result.T_us_ct, new / "rigid.tfm")
        if guided is not None and waypoints is not None:
            _write_waypoints(guided, waypoints, result, suspect, new)
        if sampled is not None:
            write_field(sampled, new / "displacement.nii.gz")
        made = [name for name in FILES if (new / name).is_file() or name == SUMMARY]
        write_json(_summary(result, request, [*result.warnings, *told], sampled, made), new / SUMMARY)
    return [f"{FILES[name]}: {folder / name}" for name in made], [*told, *suspect]


def _write_cloud(result: Registration, faces: Ints | None, folder: Path) -> None:
    """``warped.ply``, with the displacement that the rigid part leaves and the distance to the ultrasound."""
    moved = result.warped - result.T_us_ct.apply(result.source)
    columns = {f"displacement_{axis}": moved[:, k] for k, axis in enumerate("xyz")}
    if result.target is not None:
        columns["us_distance"] = nearest(result.warped, result.target)[0]
    write_ply(PointCloud(result.warped, "warped", result.parts), folder / "warped.ply", faces=faces, columns=columns)


def _write_waypoints(
    guided: GuidedPath, given: WaypointFile, result: Registration, suspect: list[str], folder: Path
) -> None:
    labels = given.waypoints.labels
    write_text(folder / "waypoints_us.csv", csv_text(guided.points, labels, guided.reasons))
    descriptions = [reason or known for reason, known in zip(guided.reasons, given.descriptions, strict=True)]
    slicer = markups(guided.points, labels, given.space, descriptions, "waypoints_us")
    write_json(slicer, folder / "waypoints_us.mrk.json")
    robot = {
        "format": "study waypoints",
        "format_version": 1,
        "study_version": study.__version__,
        "frame": "US, RAS",
        "frame_is": FRAMES["US"],
        "unit": "mm",
        "method": result.method,
        "suspect": bool(suspect),
        "warnings": suspect,
        "waypoints": [_robot_waypoint(guided, k, label, bool(suspect)) for k, label in enumerate(labels)],
        "meaning": ROBOT_MEANINGS,
    }
    write_json(robot, folder / "waypoints_robot.json")


def _robot_waypoint(guided: GuidedPath, k: int, label: str, suspect: bool) -> dict[str, Any]:
    carried = not guided.reasons[k]
    bounded = guided.bounds_mm is not None and carried and not suspect
    return {
        "index": k,
        "label": label,
        "carried": carried,
        "reason": guided.reasons[k] or None,
        "position": guided.points[k].tolist() if carried else None,
        "normal": guided.normals[k].tolist() if carried else None,
        "normal_from": None if not carried else "surface" if guided.from_surface[k] else "chest",
        "bound_mm": float(guided.bounds_mm[k]) if bounded and guided.bounds_mm is not None else None,
        "quality": {
            "ct_distance_mm": float(guided.ct_distance_mm[k]),
            "us_residual_mm": None if np.isnan(guided.residual_mm[k]) else float(guided.residual_mm[k]),
            "n_us_points": int(guided.n_us[k]),
        },
    }


def _summary(
    result: Registration, request: Request, warnings: list[str], sampled: Field | None, made: list[str]
) -> dict[str, Any]:
    """The content of ``registration.json``."""
    bent_mm = np.linalg.norm(result.warped - result.T_us_ct.apply(result.source), axis=1)
    return {
        "format": "study registration",
        "format_version": 1,
        "study_version": study.__version__,
        "method": result.method,
        "parameters": None if request.parameters is None else dict(request.parameters),
        "seed": request.seed,
        "front": request.front,
        "radius_mm": request.radius_mm,
        "inputs": {name: dict(known) for name, known in request.inputs.items()},
        "converged": result.converged,
        "n_iterations": result.n_iterations,
        "stop_reason": result.stop_reason,
        "warnings": warnings,
        "quality": None if result.quality is None else asdict(result.quality),
        "n_points": len(result.warped),
        "T_us_ct": result.T_us_ct.matrix.tolist(),
        "T_us_ct_is": "the rigid part of the result only, CT frame to US frame, mm; no probe should follow it",
        "T_us_ct_is_all": bool(bent_mm.max() < WHOLE_MM),
        "beyond_rigid_mm": {"mean": float(bent_mm.mean()), "max": float(bent_mm.max())},
        "field": None if sampled is None else _about(sampled, result),
        "files": {name: FILES[name] for name in made},
        "frames": FRAMES,
        "meaning": MEANINGS,
    }


def _about(field: Field, result: Registration) -> dict[str, Any]:
    made = (
        "the inverse of the method's own field"
        if isinstance(result, FieldRegistration)
        else f"the rigid motion that takes the nearest {NEIGHBOURS} warped points back, since the method has no field"
    )
    return {
        "made": made,
        "outside": f"farther than {REACH_MM:g} mm from every warped point: the rigid part alone",
        "direction": "fixed (US) to moving (CT): a voxel's place in the US frame plus its vector is a place in the CT",
        "voxels": list(field.grid.shape),
        "spacing_mm": field.grid.spacing_mm.tolist(),
        "in_grid_share": field.in_grid_share,
        "return_mm": {
            "mean": float(field.return_mm.mean()),
            "p95": float(np.percentile(field.return_mm, 95)),
            "max": float(field.return_mm.max()),
        },
        "no_inverse_share": field.unknown_share,
    }


def _field_warnings(field: Field) -> list[str]:
    told = []
    if field.in_grid_share < 1:
        told.append(
            f"displacement field: {1 - field.in_grid_share:.0%} of the warped points lie outside {field.grid.name}"
        )
    if field.unknown_share > 0:
        told.append(
            f"displacement field: {field.unknown_share:.2%} of its places have no inverse and got the rigid part"
        )
    off_mm = float(np.percentile(field.return_mm, 95))
    if off_mm > MOST_RETURN_MM:
        told.append(
            f"displacement field: it takes 1 in 20 warped points over {off_mm:.1f} mm from where they came from, since "
            "the method lays the tube's front and back on each other; gaussian_process has a field of its own"
        )
    return told


def check_outputs(folder: Path, inputs: list[Path]) -> None:
    """Refuse a folder that is none, or an input that the result would replace; ask before a long computation.

    Raises:
        StudyError: either of them.
    """
    if folder.exists() and not folder.is_dir():
        raise StudyError(f"expected a folder for the result, got the file {folder}; name another")
    for path in inputs:
        if path.name in FILES and path.exists() and folder.exists() and path.resolve().parent == folder.resolve():
            raise StudyError(f"{path}: expected an input that the result does not replace; name another folder")
