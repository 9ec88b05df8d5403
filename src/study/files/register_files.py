"""The work of `study register`: two clouds and waypoints in files, a folder of results out."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from numpy.typing import ArrayLike

from study import pipeline
from study.files.clouds import PlyFile, read_ply_file
from study.files.registered import Request, check_outputs, describe, write_result
from study.files.transforms import grid_around, read_grid
from study.files.waypoints import read_waypoint_file
from study.geometry.points import unit


def register_files(
    ct: Path,
    us: Path,
    out: Path,
    *,
    method: str,
    waypoints: Path | None = None,
    radius_mm: float = 20.0,
    front: ArrayLike | None = None,
    seed: int = 0,
    field: str | None = None,
) -> tuple[list[str], list[str]]:
    """Register two PLY files (`study.register_pair`) and write the result; see `write_result`.

    Args:
        ct: PLY of the CT points.
        us: PLY of the US points; a property ``time`` says when each was seen, s.
        out: folder of results.
        method: a name in ``METHODS``.
        waypoints: ``.csv``, ``.mrk.json`` or ``.fcsv``, CT frame.
        radius_mm: sphere around a waypoint whose points carry it.
        front: (3,) direction from the chest to the probe, US frame, RAS.
        seed: draws of the method.
        field: an image of the US frame whose grid the displacement field gets, or a spacing in mm; None for no field.

    Returns:
        lines for standard output, and warnings.

    Raises:
        StudyError: files that are none, clouds that do not register, or an output that cannot be written; nothing is
            written then.
    """
    chosen = pipeline.find_method(method)
    towards = None if front is None else unit(front, "--front")
    path = None if waypoints is None else read_waypoint_file(waypoints)
    spacing_mm = None if field is None else _number(field)
    grid = None if field is None or spacing_mm is not None else read_grid(field)
    check_outputs(out, [Path(one) for one in (ct, us, waypoints, field) if one is not None])
    person, seen = read_ply_file(ct), read_ply_file(us)
    inputs = {"ct": _described(ct, person), "us": _described(us, seen) | {"timed": seen.times is not None}}
    if waypoints is not None and path is not None:
        inputs["waypoints"] = describe(waypoints, n_points=len(path.waypoints), space=path.space)
    if field is not None:
        inputs["field"] = {"spacing_mm": spacing_mm} if grid is None else describe(field)
    result = pipeline.register_pair(
        person.points, seen.points, method=method, seed=seed, front=towards, times=seen.times
    )
    if spacing_mm is not None:
        grid = grid_around(result.warped, spacing_mm)
    request = Request(inputs, asdict(chosen), seed, None if towards is None else towards.tolist(), radius_mm)
    lines, warnings = write_result(result, out, request, waypoints=path, grid=grid, faces=person.faces)
    untagged = [file.name for file, read in ((ct, person), (us, seen)) if read.space is None]
    if untagged:
        lines.append(f"no comment SPACE= in {', '.join(untagged)}: taken as RAS")
    return lines, warnings


def _described(path: Path, read: PlyFile) -> dict[str, object]:
    n_faces = 0 if read.faces is None else len(read.faces)
    return describe(path, n_points=len(read.points), n_faces=n_faces, space=read.space)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
