from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trimesh

from study.errors import StudyError
from study.files.clouds import read_ply, read_timed_ply, read_waypoints, write_ply, write_registration
from study.registration import Registration
from study.types import PointCloud, RigidTransform, Waypoints

POINTS = np.random.default_rng(5).normal([0.0, -900.0, 1200.0], 60.0, size=(400, 3))


def test_a_cloud_comes_back_bit_for_bit_and_in_order(tmp_path: Path) -> None:
    path = write_ply(PointCloud(POINTS), tmp_path / "new" / "folder" / "cloud.ply")
    assert np.array_equal(read_ply(path), POINTS)
    assert np.array_equal(trimesh.load(path).vertices, POINTS)  # another reader sees the same
    assert [entry.name for entry in path.parent.iterdir()] == ["cloud.ply"]


def test_times_come_back_bit_for_bit_beside_their_points(tmp_path: Path) -> None:
    times = 1.7e9 + np.random.default_rng(6).uniform(0, 40, len(POINTS))  # as a computer's clock counts
    path = write_ply(PointCloud(POINTS, times=times), tmp_path / "us.ply")
    points, read = read_timed_ply(path)
    assert np.array_equal(points, POINTS)
    assert read is not None
    assert np.array_equal(read, times)
    assert np.array_equal(read_ply(path), POINTS)
    assert np.array_equal(trimesh.load(path).vertices, POINTS)
    assert read_timed_ply(write_ply(PointCloud(POINTS), tmp_path / "bare.ply"))[1] is None


def timed_ascii(path: Path, times: list[str], kind: str = "double") -> Path:
    names = "".join(f"property double {axis}\n" for axis in "xyz")
    rows = "".join(f"{k} {k * k} 3 {time}\n" for k, time in enumerate(times))
    header = f"ply\nformat ascii 1.0\nelement vertex {len(times)}\n{names}property {kind} time\nend_header\n"
    path.write_text(header + rows, encoding="utf-8")
    return path


def test_times_of_other_writers_are_read_or_refused(tmp_path: Path) -> None:
    path = timed_ascii(tmp_path / "us.ply", ["0.5", "0.25", "12"])
    assert np.array_equal(read_timed_ply(path)[1], [0.5, 0.25, 12])
    assert np.array_equal(read_timed_ply(timed_ascii(path, ["0.5", "0.25", "12"], "float"))[1], [0.5, 0.25, 12])
    for bad in ("nan", "inf"):
        with pytest.raises(StudyError, match=r"us\.ply: expected finite times in seconds, got 1 .* the first 2"):
            read_timed_ply(timed_ascii(path, ["1", "2", bad]))
    with pytest.raises(StudyError, match=r"us\.ply: expected times to 0\.05 s or finer, got single precision"):
        read_timed_ply(timed_ascii(path, ["1700000000.5", "1700000001.5", "1700000002"], "float"))
    assert len(read_ply(path)) == 3


def test_ascii_clouds_and_meshes_are_read_as_they_are(tmp_path: Path) -> None:
    box = trimesh.creation.box((100, 200, 300))
    box.export(tmp_path / "mesh.ply", encoding="ascii")
    assert np.allclose(read_ply(tmp_path / "mesh.ply"), box.vertices)
    assert read_timed_ply(tmp_path / "mesh.ply")[1] is None
    doubled = "\n".join(["1 2 3", "1 2 3", "4 5 6"])  # equal points stay: row i must stay row i
    header = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {a}\n" for a in "xyz")
    (tmp_path / "cloud.ply").write_text(f"{header}end_header\n{doubled}\n")
    assert read_ply(tmp_path / "cloud.ply").tolist() == [[1, 2, 3], [1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("content", [b"", b"not a ply", b"ply\nformat ascii 1.0\nelement vertex 9\nend_header\n1"])
def test_what_is_no_ply_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(StudyError, match=r"bad\.ply") as caught:
        read_ply(tmp_path / "bad.ply")
    assert "\n" not in str(caught.value)


def test_a_cut_off_ply_is_refused(tmp_path: Path) -> None:
    path = write_ply(PointCloud(POINTS), tmp_path / "cut.ply")
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(StudyError, match=r"cut\.ply"):
        read_ply(path)


def test_missing_files_and_nan_are_refused(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="no such file"):
        read_ply(tmp_path / "none.ply")
    with pytest.raises(StudyError, match=r"none\.csv"):
        read_waypoints(tmp_path / "none.csv")
    (tmp_path / "nan.csv").write_text("x,y,z\n1,2,3\n1,,3\n")
    with pytest.raises(StudyError, match=r"nan\.csv: expected finite numbers .* got others in line 3"):
        read_waypoints(tmp_path / "nan.csv")
    (tmp_path / "words.csv").write_text("x,y,z\n1,two,3\n")
    with pytest.raises(StudyError, match=r"words\.csv"):
        read_waypoints(tmp_path / "words.csv")
    (tmp_path / "names.csv").write_text("a,b,c\n1,2,3\n")
    with pytest.raises(StudyError, match="columns x, y, z, got a, b, c"):
        read_waypoints(tmp_path / "names.csv")
    (tmp_path / "empty.csv").write_text("")
    with pytest.raises(StudyError, match=r"empty\.csv"):
        read_waypoints(tmp_path / "empty.csv")


def test_waypoints_are_taken_by_column_name(tmp_path: Path) -> None:
    (tmp_path / "w.csv").write_text("name,z,y,x\nR2-3.1,3,2,1\nR2-3.2,6,5,4\n")
    path = read_waypoints(tmp_path / "w.csv")
    assert path.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert path.labels == ("line 2", "line 3")


def test_waypoints_keep_their_labels_and_count_as_the_file_does(tmp_path: Path) -> None:
    (tmp_path / "w.csv").write_text("label,x,y,z\nR2-3.1,1,2,3\n\n,4,5,6\n")
    assert read_waypoints(tmp_path / "w.csv").labels == ("R2-3.1", "line 4")


def test_another_suffix_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"ends in \.ply, got 'cloud\.stl'"):
        write_ply(PointCloud(POINTS), tmp_path / "cloud.stl")
    assert not list(tmp_path.iterdir())


def test_a_registration_is_written_whole(tmp_path: Path) -> None:
    T = RigidTransform.random(np.random.default_rng(1))
    result = Registration(POINTS, T.apply(POINTS), T, False, 7, "iteration limit", warnings=("few points",))
    path = Waypoints(POINTS[:4], tuple(f"line {k + 2}" for k in range(4)))
    lines = write_registration(result, tmp_path / "out", path, radius_mm=60.0)
    assert {entry.name for entry in (tmp_path / "out").iterdir()} == {
        "warped.ply", "registration.json", "waypoints_us.csv"
    }  # fmt: skip
    assert len(lines) == 3
    assert np.array_equal(read_ply(tmp_path / "out" / "warped.ply"), result.warped)
    summary = json.loads((tmp_path / "out" / "registration.json").read_text(encoding="utf-8"))
    assert np.array_equal(summary["T_us_ct"], T.matrix)
    assert (summary["converged"], summary["warnings"]) == (False, ["few points"])
    header, *rows = (tmp_path / "out" / "waypoints_us.csv").read_text(encoding="utf-8").splitlines()
    assert header == "x,y,z"
    moved = [[float(value) for value in row.split(",")] for row in rows]
    assert np.allclose(moved, T.apply(POINTS[:4]), rtol=0, atol=1e-9)


def test_a_bad_waypoint_is_flagged_and_the_good_ones_survive(tmp_path: Path) -> None:
    T = RigidTransform.random(np.random.default_rng(1))
    result = Registration(POINTS, T.apply(POINTS), T, True, 7, "at rest")
    path = Waypoints(np.vstack([POINTS[:1], [[9e3, 0, 0]], POINTS[1:2]]), ("R2-3.1", "far", "R2-3.2"))
    lines = write_registration(result, tmp_path / "out", path, radius_mm=60.0)
    assert lines[-1].startswith("waypoint not carried: far: expected at least 3 CT points")
    table = pd.read_csv(tmp_path / "out" / "waypoints_us.csv", keep_default_na=False, na_values={"x": ""})
    assert table["label"].to_list() == ["R2-3.1", "far", "R2-3.2"]
    assert table["x"].isna().to_list() == [False, True, False]
    assert [bool(reason) for reason in table["reason"]] == [False, True, False]
    warnings = json.loads((tmp_path / "out" / "registration.json").read_text(encoding="utf-8"))["warnings"]
    assert len(warnings) == 1
    assert "far" in warnings[0]
    with pytest.raises(StudyError, match="expected one or more that can be carried, got none: far"):
        write_registration(result, tmp_path / "none", Waypoints(path.points[1:2], ("far",)))
    assert not (tmp_path / "none").exists()


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_ply(PointCloud(POINTS), tmp_path / "cloud.ply")
    before = path.read_bytes()

    def full(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[:100])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        write_ply(PointCloud(POINTS + 1), path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["cloud.ply"]
