"""Waypoints in and out: CSV, 3D Slicer's markups ``.mrk.json``, and its older ``.fcsv``, which is only read."""

from __future__ import annotations

import csv
import json
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from study.errors import StudyError
from study.files.spaces import Space, as_space, to_ras
from study.types import Floats, Waypoints, as_points

LINE = "line "  # what a waypoint without a label is called by
SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
KINDS = ("Fiducial", "Curve", "ClosedCurve", "Line", "Angle")  # markups whose control points are what was picked
MAX_BYTES = 64 << 20
FCSV_COLUMNS = ("id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label", "desc", "associatedNodeID")
FCSV_SPACES = {"0": "RAS", "1": "LPS"}  # how versions before 4.11 write it
FCSV_PLACED = "2"  # of a column that Slicer 5 writes and its header leaves out


@dataclass(frozen=True)
class WaypointFile:
    """What a file of waypoints holds.

    Attributes:
        waypoints: mm, RAS, in the file's order.
        space: that of the file; RAS of a CSV file, which states none.
        descriptions: (k,) of a waypoint each, ``""`` for none.
    """

    waypoints: Waypoints
    space: Space
    descriptions: tuple[str, ...]


def read_waypoints(path: str | os.PathLike[str]) -> Waypoints:
    """Waypoints (k, 3) mm, RAS, in the file's order; see `read_waypoint_file`."""
    return read_waypoint_file(path).waypoints


def read_waypoint_file(path: str | os.PathLike[str]) -> WaypointFile:
    """Waypoints of a ``.csv``, ``.mrk.json`` or ``.fcsv`` file.

    CSV has columns ``x``, ``y``, ``z``, mm, RAS, and, where there is one, ``label``. A waypoint without a label is
    called by its line in the file, the header being line 1, or by its number among the control points.

    Raises:
        StudyError: no such file or another suffix; damaged; a place that is missing or no number; a space or unit that
            is missing or another than RAS or LPS, and mm; a file of several lists.
    """
    path = Path(path)
    name = path.name.lower()
    read = next((read for suffix, read in _READERS.items() if name.endswith(suffix)), None)
    if read is None:
        raise StudyError(f"{path.name}: expected waypoints as {', '.join(_READERS)}, got another suffix; rename it")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise StudyError(f"{path.name}: expected at most {MAX_BYTES} bytes of waypoints, got more; another file?")
        return read(path)
    except OSError as error:
        raise StudyError(f"expected waypoints at {path}, got: {error.strerror}; check the path") from error
    except UnicodeDecodeError as error:
        raise StudyError(f"{path.name}: expected text in UTF-8, got other bytes; export it again") from error


def _read_csv(path: Path) -> WaypointFile:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # rows that are longer than the header
            table = pd.read_csv(path, skip_blank_lines=False, index_col=False, encoding="utf-8").dropna(how="all")
    except (ValueError, pd.errors.ParserWarning) as error:
        raise StudyError(
            f"{path.name}: expected a CSV file of waypoints, got: {' '.join(str(error).split())}; check its columns"
        ) from error
    if not {"x", "y", "z"} <= set(table.columns):
        raise StudyError(
            f"{path.name}: expected columns x, y, z, got {', '.join(map(str, table.columns))}; name them in line 1"
        )
    lines = [f"{LINE}{number + 2}" for number in table.index]
    places = table[["x", "y", "z"]].apply(pd.to_numeric, errors="coerce").to_numpy(dtype=np.float64)
    bad = [line for line, place in zip(lines, places, strict=True) if not np.isfinite(place).all()]
    if bad:
        raise StudyError(
            f"{path.name}: expected finite numbers x, y, z in mm, got others in {', '.join(bad)}; mend them"
        )
    if "label" in table.columns:
        lines = [line if pd.isna(label) else str(label) for line, label in zip(lines, table["label"], strict=True)]
    return WaypointFile(Waypoints(as_points(places, path.name), tuple(lines)), "RAS", ("",) * len(lines))


def _read_markups(path: Path) -> WaypointFile:
    name = path.name
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, RecursionError) as error:
        raise StudyError(f"{name}: expected JSON of 3D Slicer's markups, got {error}; save it again") from error
    lists = content.get("markups") if isinstance(content, dict) else None
    if not isinstance(lists, list) or len(lists) != 1 or not isinstance(lists[0], dict):
        raise StudyError(
            f"{name}: expected one list under 'markups', got {len(lists) if isinstance(lists, list) else 'none'}; "
            "save each list of points to a file of its own"
        )
    markup: dict[str, Any] = lists[0]
    if markup.get("type") not in KINDS:
        raise StudyError(f"{name}: expected a markup of type {', '.join(KINDS)}, got {markup.get('type')!r}")
    if "coordinateSystem" not in markup:
        raise StudyError(
            f"{name}: expected coordinateSystem LPS or RAS, got none; add the one it is: they differ by half a turn"
        )
    space = as_space(str(markup["coordinateSystem"]), f"{name}: coordinateSystem")
    unit = markup.get("coordinateUnits", "mm")
    if (unit[0] if isinstance(unit, list) and unit else unit) != "mm":
        raise StudyError(f"{name}: expected coordinateUnits mm, got {unit!r}; save it in mm")
    given = markup.get("controlPoints")
    if not isinstance(given, list) or not given or not all(isinstance(one, dict) for one in given):
        raise StudyError(f"{name}: expected controlPoints, got none; place some and save again")
    labels = tuple(str(one.get("label") or f"point {number}") for number, one in enumerate(given, start=1))
    for label, one in zip(labels, given, strict=True):
        if one.get("positionStatus", "defined") != "defined":
            raise StudyError(f"{name}: expected a place for {label!r}, got a point not placed; place or delete it")
    points = np.array(
        [_place(one.get("position"), f"{name}: {label}") for label, one in zip(labels, given, strict=True)]
    )
    descriptions = tuple(str(one.get("description") or "") for one in given)
    return WaypointFile(Waypoints(to_ras(points, space), labels), space, descriptions)


def _read_fcsv(path: Path) -> WaypointFile:
    name = path.name
    header: dict[str, str] = {}
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        if stated := re.match(r"#\s*(\w[\w ]*?)\s*=\s*(.*)", line):
            header[stated[1].lower()] = stated[2].strip()
        elif line.strip() and not line.startswith("#"):
            rows.append((number, next(csv.reader([line]))))
    if "coordinatesystem" not in header:
        raise StudyError(f"{name}: expected a line '# CoordinateSystem = RAS' or LPS, got none; add the right one")
    space = as_space(
        FCSV_SPACES.get(header["coordinatesystem"], header["coordinatesystem"]), f"{name}: CoordinateSystem"
    )
    columns = [one.strip() for one in header["columns"].split(",")] if "columns" in header else list(FCSV_COLUMNS)
    if not {"x", "y", "z", "label"} <= set(columns) or not rows:
        raise StudyError(
            f"{name}: expected rows with columns x, y, z and label, got {len(rows)} of "
            f"{', '.join(columns)}; save it again"
        )
    labels, descriptions, points = [], [], []
    for number, row in rows:
        if len(row) not in (len(columns), len(columns) + 2):  # Slicer 5 adds two that its header does not name
            raise StudyError(f"{name}: expected {len(columns)} columns, got {len(row)} in line {number}; mend it")
        if len(row) > len(columns) and row[len(columns)] != FCSV_PLACED:
            raise StudyError(f"{name}: expected a place in line {number}, got a point that was not placed; delete it")
        one = dict(zip(columns, row, strict=False))
        labels.append(one["label"] or f"{LINE}{number}")
        descriptions.append(one.get("desc", ""))
        points.append(_place([one[axis] for axis in "xyz"], f"{name}: line {number}"))
    return WaypointFile(Waypoints(to_ras(np.array(points), space), tuple(labels)), space, tuple(descriptions))


_READERS = {".mrk.json": _read_markups, ".fcsv": _read_fcsv, ".csv": _read_csv}


def _place(position: Any, where: str) -> Floats:
    """Three finite numbers (3,) of a point."""
    try:
        place = np.array([float(value) for value in position] if isinstance(position, list) else [])
    except (TypeError, ValueError):
        place = np.empty(0)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise StudyError(f"{where}: expected three finite numbers in mm, got {str(position)[:60]}; mend it")
    return place


def csv_text(points: Floats, labels: Sequence[str], reasons: Sequence[str] = ()) -> str:
    """Waypoints (k, 3) mm as CSV; places that are NaN stay empty.

    Args:
        points: mm, RAS.
        labels: (k,); a column unless all are lines of a file without any.
        reasons: (k,) why a waypoint has no place; a column where there is one.
    """
    table = pd.DataFrame(points, columns=["x", "y", "z"])
    if not all(label.startswith(LINE) for label in labels):
        table["label"] = list(labels)
    if any(reasons):
        table["reason"] = list(reasons)
    return table.to_csv(index=False, lineterminator="\n")


def markups(
    points: Floats, labels: Sequence[str], space: Space, descriptions: Sequence[str], name: str
) -> dict[str, Any]:
    """Waypoints as the content of one of 3D Slicer's ``.mrk.json`` files, a point list.

    Args:
        points: (k, 3) mm, RAS; NaN for a waypoint without a place, which the list then has as one not placed.
        labels: (k,).
        space: in which the file has them.
        descriptions: (k,).
        name: of the list.
    """
    control = []
    for number, (place, label, description) in enumerate(zip(points, labels, descriptions, strict=True), start=1):
        one: dict[str, Any] = {"id": str(number), "label": label, "description": description, "selected": True}
        placed = bool(np.isfinite(place).all())
        one["positionStatus"] = "defined" if placed else "undefined"
        if placed:
            one["position"] = to_ras(place, space).tolist()
        control.append(one)
    return {
        "@schema": SCHEMA,
        "markups": [
            {
                "type": "Fiducial",
                "name": name,
                "coordinateSystem": space,
                "coordinateUnits": "mm",
                "controlPoints": control,
            }
        ],
    }
