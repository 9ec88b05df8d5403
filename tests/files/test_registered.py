from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import SimpleITK as sitk
import trimesh
from planted_registration import SOURCE, T_US_CT, planted

from study import __version__
from study.errors import StudyError
from study.files import registered
from study.files.clouds import read_ply
from study.files.meanings import FILES
from study.files.registered import Request, check_outputs, describe, write_registration, write_result
from study.files.transforms import grid_around
from study.files.waypoints import WaypointFile, read_waypoint_file
from study.quality import Quality
from study.registration import Registration
from study.types import RigidTransform, Waypoints

QUALITY = Quality(0.01, 0.02, 3.0, 0.04, 0.05)
REQUEST = Request({"ct": {"file": "ct.ply", "sha256": "0" * 64, "n_points": 3000}}, {"n_nodes": 150}, seed=7)
PATH = WaypointFile(Waypoints(SOURCE[:4], ("R2-3.1", "R2-3.2", "L2-3.1", "L2-3.2")), "LPS", ("seen", "", "", ""))


def written(folder: Path, result: Registration, **options: Any) -> tuple[list[str], list[str]]:
    return write_result(replace(result, target=result.warped + 0.5 * result.front), folder, REQUEST, **options)


def content(folder: Path, name: str) -> Any:
    return json.loads((folder / name).read_text(encoding="utf-8"))


def test_every_file_is_written_and_read_by_other_libraries(tmp_path: Path) -> None:
    result = replace(planted(), quality=QUALITY)
    grid = grid_around(result.warped, 8.0)
    lines, warnings = written(tmp_path / "out", result, waypoints=PATH, grid=grid)
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(FILES)
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]
    assert len(lines) == len(FILES)
    assert warnings == []
    cloud = trimesh.load(tmp_path / "out" / "warped.ply", process=False)
    assert np.array_equal(cloud.vertices, result.warped)
    vertex = cloud.metadata["_ply_raw"]["vertex"]
    columns = {name: np.ravel(vertex["data"][name]) for name in vertex["properties"]}
    assert np.array_equal(columns["part"], result.parts)
    moved = np.column_stack([columns[f"displacement_{axis}"] for axis in "xyz"])
    assert np.allclose(moved + T_US_CT.apply(SOURCE), result.warped)
    assert columns["us_distance"].max() <= 0.5 + 1e-9
    rigid = sitk.ReadTransform(str(tmp_path / "out" / "rigid.tfm"))
    place = T_US_CT.apply(SOURCE[:1])[0] * [-1, -1, 1]
    assert np.allclose(rigid.TransformPoint(place.tolist()), SOURCE[0] * [-1, -1, 1])
    field = sitk.ReadImage(str(tmp_path / "out" / "displacement.nii.gz"))
    assert field.GetNumberOfComponentsPerPixel() == 3
    slicer = read_waypoint_file(tmp_path / "out" / "waypoints_us.mrk.json")
    assert (slicer.space, slicer.waypoints.labels) == ("LPS", PATH.waypoints.labels)
    assert slicer.descriptions == PATH.descriptions
    table = pd.read_csv(tmp_path / "out" / "waypoints_us.csv")
    robot = content(tmp_path / "out", "waypoints_robot.json")
    assert np.allclose(slicer.waypoints.points, result.warped[:4])
    assert np.allclose(table[["x", "y", "z"]], result.warped[:4])
    assert np.allclose([one["position"] for one in robot["waypoints"]], result.warped[:4])


def test_a_planner_is_told_frame_unit_order_normal_quality_and_bound(tmp_path: Path) -> None:
    class Bounded(type(planted())):  # type: ignore[misc]
        def bounds(self, waypoints: Any) -> np.ndarray:
            return np.full(len(waypoints), 2.9)

    known = planted()
    result = Bounded(**{name: getattr(known, name) for name in known.__dataclass_fields__})
    written(tmp_path / "out", result, waypoints=PATH)
    robot = content(tmp_path / "out", "waypoints_robot.json")
    assert (robot["frame"], robot["unit"], robot["suspect"]) == ("US, RAS", "mm", False)
    assert [one["label"] for one in robot["waypoints"]] == list(PATH.waypoints.labels)
    assert [one["index"] for one in robot["waypoints"]] == [0, 1, 2, 3]
    for one in robot["waypoints"]:
        assert np.linalg.norm(one["normal"]) == pytest.approx(1.0)
        assert np.dot(one["normal"], result.front) > 0.5
        assert one["bound_mm"] == 2.9
        assert one["quality"]["us_residual_mm"] <= 0.5 + 1e-9
        assert one["quality"]["n_us_points"] > 0
    written(tmp_path / "bad", replace(result, warnings=("torn",)), waypoints=PATH)
    robot = content(tmp_path / "bad", "waypoints_robot.json")
    assert (robot["suspect"], robot["warnings"]) == (True, ["torn"])
    assert {one["bound_mm"] for one in robot["waypoints"]} == {None}  # beside a warning it does not hold


def leaves(value: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """Every number, with the names that lead to it."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from leaves(inner, f"{at}.{name}" if at else name)
    elif isinstance(value, list):
        for inner in value:
            yield from leaves(inner, at)
    elif isinstance(value, int | float):
        yield at, value


def test_every_number_has_a_meaning_version_seed_and_inputs_are_there(tmp_path: Path) -> None:
    result = replace(planted(), quality=QUALITY)
    written(tmp_path / "out", result, waypoints=PATH, grid=grid_around(result.warped, 8.0))
    summary = content(tmp_path / "out", "registration.json")
    assert (summary["study_version"], summary["seed"]) == (__version__, 7)
    assert summary["parameters"] == {"n_nodes": 150}
    assert summary["inputs"]["ct"]["sha256"] == "0" * 64
    assert summary["quality"] == {name: getattr(QUALITY, name) for name in QUALITY.__dataclass_fields__}
    assert np.array_equal(summary["T_us_ct"], T_US_CT.matrix)
    assert not summary["T_us_ct_is_all"]
    assert set(summary["files"]) == set(FILES)
    assert "fixed (US) to moving (CT)" in summary["field"]["direction"]
    for name in ("registration.json", "waypoints_robot.json"):
        whole = content(tmp_path / "out", name)
        meaning = whole.pop("meaning")
        found = {at.removeprefix("waypoints.") for at, _ in leaves(whole)}
        assert len(found) > 5
        for at in found - {"format_version"}:
            steps = at.split(".")
            assert {".".join(steps[:k]) for k in range(1, len(steps) + 1)} & set(meaning), at


def test_a_rigid_result_says_that_the_matrix_is_all(tmp_path: Path) -> None:
    result = Registration(SOURCE, T_US_CT.apply(SOURCE), T_US_CT, False, 7, "iteration limit", warnings=("few points",))
    result = replace(result, front=T_US_CT.rotation[:, 1])
    _, warnings = written(tmp_path / "out", result)
    summary = content(tmp_path / "out", "registration.json")
    assert summary["T_us_ct_is_all"]
    assert (summary["converged"], summary["warnings"], summary["field"]) == (False, ["few points"], None)
    assert warnings == ["few points", "not converged: iteration limit"]
    assert np.array_equal(read_ply(tmp_path / "out" / "warped.ply"), result.warped)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"warped.ply", "rigid.tfm", "registration.json"}


def test_a_bad_waypoint_is_flagged_and_the_good_ones_survive(tmp_path: Path) -> None:
    T = RigidTransform.random(np.random.default_rng(1))
    result = Registration(SOURCE, T.apply(SOURCE), T, True, 7, "at rest", front=T.rotation[:, 1])
    points = np.vstack([SOURCE[:1], [[9e3, 0, 0]], SOURCE[1:2]])
    path = WaypointFile(Waypoints(points, ("R2-3.1", "far", "R2-3.2")), "RAS", ("", "", ""))
    plain = replace(result, target=result.warped)
    assert write_registration(plain, tmp_path / "out", path.waypoints)[-1].startswith("waypoint not carried: far: ")
    _, warnings = written(tmp_path / "out", result, waypoints=path)
    assert warnings[0].startswith("waypoint not carried: far: expected at least 3 CT points")
    table = pd.read_csv(tmp_path / "out" / "waypoints_us.csv", keep_default_na=False, na_values={"x": ""})
    assert table["label"].to_list() == ["R2-3.1", "far", "R2-3.2"]
    assert table["x"].isna().to_list() == [False, True, False]
    assert [bool(reason) for reason in table["reason"]] == [False, True, False]
    assert content(tmp_path / "out", "registration.json")["warnings"] == warnings
    control = content(tmp_path / "out", "waypoints_us.mrk.json")["markups"][0]["controlPoints"]
    assert [one["positionStatus"] for one in control] == ["defined", "undefined", "defined"]
    robot = content(tmp_path / "out", "waypoints_robot.json")["waypoints"]
    assert [one["carried"] for one in robot] == [True, False, True]
    assert robot[1]["position"] is robot[1]["normal"] is None
    assert "3 CT points" in robot[1]["reason"]
    with pytest.raises(StudyError, match="expected one or more that can be carried, got none: far"):
        written(tmp_path / "none", result, waypoints=WaypointFile(Waypoints(points[1:2], ("far",)), "RAS", ("",)))
    assert not (tmp_path / "none").exists()


def test_a_write_that_fails_leaves_the_earlier_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = planted()
    written(tmp_path / "out", result, waypoints=PATH)
    (tmp_path / "out" / "notes.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(registered, "write_rigid", full)
        with pytest.raises(OSError, match="No space"):
            written(tmp_path / "out", replace(result, warped=result.warped + 1), waypoints=PATH)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]
    written(tmp_path / "out", result)  # without waypoints: those of before go, what is not the command's stays
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "warped.ply", "rigid.tfm", "registration.json", "notes.txt"
    }  # fmt: skip


def test_a_field_that_does_not_hold_the_result_or_lead_back_is_warned_of(tmp_path: Path) -> None:
    result = planted(field=False)
    flat = replace(result, warped=T_US_CT.apply(SOURCE * [1, 0.02, 1]))  # front and back on each other
    grid = grid_around(flat.warped, 10.0)
    _, warnings = written(tmp_path / "flat", flat, grid=grid)
    assert any(
        re.search("field: it takes 1 in 20 warped points over .* mm from where they came from", one) for one in warnings
    )
    grid = grid_around(result.warped, 10.0)
    half = replace(grid, shape=(grid.shape[0] // 2, *grid.shape[1:]), name="half.nii.gz")
    _, warnings = written(tmp_path / "half", result, grid=half)
    assert any(re.search("of the warped points lie outside half", one) for one in warnings)
    assert content(tmp_path / "half", "registration.json")["warnings"] == warnings


def test_outputs_are_checked_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StudyError, match="expected a folder for the result, got the file"):
        check_outputs(tmp_path / "file", [])
    (tmp_path / "warped.ply").write_text("a CT of that name")
    with pytest.raises(StudyError, match=r"warped\.ply: expected an input that the result does not replace"):
        check_outputs(tmp_path, [tmp_path / "warped.ply"])
    check_outputs(tmp_path / "new", [tmp_path / "warped.ply"])
    assert describe(tmp_path / "file", n_points=3) == {
        "file": "file", "n_points": 3, "sha256": "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    }  # fmt: skip
