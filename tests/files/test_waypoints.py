from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pandas as pd
import pytest

from study.errors import StudyError
from study.files.waypoints import csv_text, markups, read_waypoint_file, read_waypoints

PLACES = np.array([[10.5, -20.25, 1300.0], [1 / 3, 2e-7, -40.0], [-7.0, 8.0, 9.0]])
LABELS = ("R2-3.1", "Ansatz, 3. Rippe", "L4-5.2")
FCSV = "# Markups fiducial file version = 4.11\n# CoordinateSystem = {space}\n# columns = {columns}\n{rows}"
COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"

# What Slicer's markups-schema-v1.0.3.json (Modules/Loadable/Markups/Resources/Schema) asks of a point list.
NUMBERS = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
POINT = {
    "id": {"type": "string"},
    "label": {"type": "string"},
    "description": {"type": "string"},
    "position": NUMBERS,
    "selected": {"type": "boolean"},
    "positionStatus": {"enum": ["undefined", "preview", "defined"]},
}
MARKUP = {
    "type": {"enum": ["Fiducial", "Line", "Angle", "Curve", "ClosedCurve", "Plane", "ROI"]},
    "name": {"type": "string"},
    "coordinateSystem": {"enum": ["LPS", "RAS"]},
    "coordinateUnits": {"enum": ["mm", "um"]},
    "controlPoints": {"type": "array", "items": {"type": "object", "properties": POINT}},
}
SCHEMA = {
    "type": "object",
    "required": ["@schema", "markups"],
    "properties": {
        "@schema": {"type": "string"},
        "markups": {"type": "array", "items": {"type": "object", "required": ["type"], "properties": MARKUP}},
    },
}


def slicer_list(space: str = "LPS", **changes: Any) -> dict[str, Any]:
    """A list of points as 3D Slicer saves it."""
    points = [
        {"id": str(k), "label": label, "description": "", "position": place.tolist(), "positionStatus": "defined"}
        for k, (label, place) in enumerate(zip(LABELS, PLACES, strict=True), start=1)
    ]
    markup = {"type": "Fiducial", "coordinateSystem": space, "coordinateUnits": "mm", "controlPoints": points}
    markup |= changes
    return {"@schema": "markups-schema-v1.0.3.json#", "markups": [{k: v for k, v in markup.items() if v is not None}]}


def saved(folder: Path, content: Any, name: str = "w.mrk.json") -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


# --- CSV -------------------------------------------------------------------------------------------------------------


def test_what_is_no_table_of_places_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"none\.csv"):
        read_waypoints(tmp_path / "none.csv")
    with pytest.raises(StudyError, match=r"nan\.csv: expected finite numbers .* got others in line 3"):
        read_waypoints(saved(tmp_path, "x,y,z\n1,2,3\n1,,3\n", "nan.csv"))
    for name, text in (("words.csv", "x,y,z\n1,two,3\n"), ("empty.csv", ""), ("long.csv", "x,y,z\n1,2,3\n1,2,3,4\n")):
        with pytest.raises(StudyError, match=name):
            read_waypoints(saved(tmp_path, text, name))
    with pytest.raises(StudyError, match="columns x, y, z, got a, b, c"):
        read_waypoints(saved(tmp_path, "a,b,c\n1,2,3\n", "names.csv"))
    with pytest.raises(StudyError, match=r"shift\.csv"):  # every row is longer: no first column may be dropped
        read_waypoints(saved(tmp_path, "x,y,z\n1,2,3,4\n5,6,7,8\n", "shift.csv"))
    with pytest.raises(StudyError, match=r"w\.txt: expected waypoints as \.mrk\.json, \.fcsv, \.csv"):
        read_waypoints(saved(tmp_path, "x,y,z\n1,2,3\n", "w.txt"))
    (tmp_path / "latin.csv").write_bytes("label,x,y,z\nRücken,1,2,3\n".encode("latin-1"))
    with pytest.raises(StudyError, match=r"latin\.csv"):
        read_waypoints(tmp_path / "latin.csv")


def test_waypoints_are_taken_by_column_name(tmp_path: Path) -> None:
    path = read_waypoints(saved(tmp_path, "name,z,y,x\nR2-3.1,3,2,1\nR2-3.2,6,5,4\n", "w.csv"))
    assert path.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert path.labels == ("line 2", "line 3")


def test_waypoints_keep_their_labels_and_count_as_the_file_does(tmp_path: Path) -> None:
    path = saved(tmp_path, "label,x,y,z\nR2-3.1,1,2,3\n\n,4,5,6\n", "w.csv")
    assert read_waypoints(path).labels == ("R2-3.1", "line 4")


def test_csv_comes_back_as_it_was_written(tmp_path: Path) -> None:
    path = saved(tmp_path, csv_text(PLACES, LABELS), "w.csv")
    read = read_waypoint_file(path)
    assert np.array_equal(read.waypoints.points, PLACES)
    assert (read.waypoints.labels, read.space) == (LABELS, "RAS")
    assert np.array_equal(pd.read_csv(path)[["x", "y", "z"]], PLACES)


# --- .mrk.json -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("space", "sign"), [("LPS", -1), ("RAS", 1)])
def test_markups_are_turned_to_ras_and_back(tmp_path: Path, space: str, sign: int) -> None:
    read = read_waypoint_file(saved(tmp_path, slicer_list(space)))
    assert np.array_equal(read.waypoints.points, PLACES * [sign, sign, 1])
    assert (read.waypoints.labels, read.space) == (LABELS, space)
    content = markups(read.waypoints.points, read.waypoints.labels, read.space, read.descriptions, "w")
    jsonschema.validate(content, SCHEMA)
    (markup,) = content["markups"]
    assert markup["coordinateSystem"] == space
    assert [one["position"] for one in markup["controlPoints"]] == PLACES.tolist()  # as in the file that was read
    assert [one["label"] for one in markup["controlPoints"]] == list(LABELS)
    again = read_waypoint_file(saved(tmp_path, content, "again.mrk.json"))
    assert np.array_equal(again.waypoints.points, read.waypoints.points)


def test_a_waypoint_without_a_place_is_one_that_was_not_placed() -> None:
    points = np.vstack([PLACES[:1], [[np.nan] * 3]])
    content = markups(points, ("a", "b"), "LPS", ("", "too far"), "w")
    jsonschema.validate(content, SCHEMA)
    good, bad = content["markups"][0]["controlPoints"]
    assert (good["positionStatus"], bad["positionStatus"]) == ("defined", "undefined")
    assert "position" not in bad
    assert bad["description"] == "too far"
    json.dumps(content, allow_nan=False)


@pytest.mark.parametrize(
    ("content", "told"),
    [(json.dumps(slicer_list())[:-200], "expected JSON"),
     (slicer_list(coordinateSystem=None), "expected coordinateSystem LPS or RAS, got none"),
     (slicer_list("IJK"), "expected the space RAS or LPS, got 'IJK'"),
     (slicer_list(coordinateUnits="m"), "expected coordinateUnits mm, got 'm'"),
     (slicer_list(coordinateUnits=["um", "UCUM", "micrometer"]), "expected coordinateUnits mm"),
     (slicer_list(type="ROI"), "expected a markup of type"),
     (slicer_list(controlPoints=[]), "expected controlPoints, got none"),
     (slicer_list(controlPoints=[{"label": "a", "position": [1, 2]}]), "a: expected three finite numbers"),
     (slicer_list(controlPoints=[{"label": "a", "position": [1, 2, float("nan")]}]), "three finite numbers"),
     (slicer_list(controlPoints=[{"label": "a", "position": "123"}]), "three finite numbers"),
     (slicer_list(controlPoints=[{"label": "a", "position": "", "positionStatus": "missing"}]), "not placed"),
     ({"markups": slicer_list()["markups"] * 2}, "expected one list under 'markups', got 2"),
     ([1, 2], "expected one list"), ("[" * 100_000, "expected JSON")],
)  # fmt: skip
def test_faulty_markups_are_refused_by_name(tmp_path: Path, content: Any, told: str) -> None:
    with pytest.raises(StudyError, match=r"w\.mrk\.json") as caught:
        read_waypoints(saved(tmp_path, content))
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_unit_as_a_code_and_points_without_labels_are_read(tmp_path: Path) -> None:
    content = slicer_list(coordinateUnits=["mm", "UCUM", "millimeter"], type="Curve")
    del content["markups"][0]["controlPoints"][1]["label"]
    assert read_waypoints(saved(tmp_path, content)).labels == ("R2-3.1", "point 2", "L4-5.2")


# --- .fcsv -----------------------------------------------------------------------------------------------------------


def fcsv(space: str = "LPS", columns: str = COLUMNS, end: str = "") -> str:
    rows = "".join(
        f'n_{k},{x!r},{y!r},{z!r},0,0,0,1,1,1,0,"{label}",seen,{end}\n'
        for k, (label, (x, y, z)) in enumerate(zip(LABELS, PLACES.tolist(), strict=True))
    )
    return FCSV.format(space=space, columns=columns, rows=rows)


@pytest.mark.parametrize(
    ("space", "sign", "kept"), [("LPS", -1, "LPS"), ("1", -1, "LPS"), ("0", 1, "RAS"), ("RAS", 1, "RAS")]
)
@pytest.mark.parametrize("end", ["", ",2,0"])  # Slicer 5 writes two columns more than it names
def test_fcsv_is_read_by_its_header(tmp_path: Path, space: str, sign: int, kept: str, end: str) -> None:
    read = read_waypoint_file(saved(tmp_path, fcsv(space, end=end), "w.fcsv"))
    assert np.array_equal(read.waypoints.points, PLACES * [sign, sign, 1])
    assert (read.waypoints.labels, read.space, read.descriptions) == (LABELS, kept, ("seen",) * 3)


@pytest.mark.parametrize(
    ("text", "told"),
    [(fcsv().replace("# CoordinateSystem = LPS\n", ""), "expected a line '# CoordinateSystem = RAS'"),
     (fcsv("2"), "expected the space RAS or LPS, got '2'"),
     (fcsv().replace("0,0,0,1,1,1,0", "0,0,0,1,1"), "expected 14 columns, got 12 in line 4"),
     (fcsv().replace("10.5", "nan"), "line 4: expected three finite numbers"),
     (fcsv(end=",3,0"), "line 4, got a point that was not placed"),
     (fcsv(columns="id,a,b,c"), "expected rows with columns x, y, z and label"),
     (fcsv()[:120], "expected rows")],
)  # fmt: skip
def test_faulty_fcsv_is_refused_by_name(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(StudyError, match=r"w\.fcsv") as caught:
        read_waypoints(saved(tmp_path, text, "w.fcsv"))
    assert told in str(caught.value)
