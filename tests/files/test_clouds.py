from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh

from study.errors import StudyError
from study.files.clouds import read_ply, read_ply_file, read_timed_ply, write_ply
from study.types import PointCloud

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


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="no such file"):
        read_ply(tmp_path / "none.ply")


# --- space, faces, parts ---------------------------------------------------------------------------------------------


def retagged(path: Path, comment: str) -> Path:
    """A file that another tool wrote: with its comment in the place of ours."""
    path.write_bytes(path.read_bytes().replace(b"comment SPACE=RAS\n", comment.encode("ascii")))
    return path


@pytest.mark.parametrize(
    ("comment", "space", "sign"),
    [("comment SPACE=RAS\n", "RAS", 1), ("comment 3D Slicer output. SPACE=LPS\n", "LPS", -1), ("", None, 1)],
)
def test_a_file_is_turned_by_the_space_that_it_states(
    tmp_path: Path, comment: str, space: str | None, sign: int
) -> None:
    times = np.arange(len(POINTS)) / 10
    path = retagged(write_ply(PointCloud(POINTS, times=times), tmp_path / "cloud.ply"), comment)
    read = read_ply_file(path)
    assert read.space == space
    assert np.array_equal(read.points, POINTS * [sign, sign, 1])
    assert np.array_equal(read_ply(path), read.points)
    assert read.times is not None
    assert np.array_equal(read.times, times)


@pytest.mark.parametrize("comment", ["comment SPACE=RAI\n", "comment SPACE=RAS\ncomment SPACE=LPS\n"])
def test_a_space_that_is_none_or_two_is_refused(tmp_path: Path, comment: str) -> None:
    path = retagged(write_ply(PointCloud(POINTS), tmp_path / "cloud.ply"), comment)
    with pytest.raises(StudyError, match=r"cloud\.ply: expected (the space RAS or LPS|one comment SPACE=)"):
        read_ply(path)


def test_what_is_written_says_ras_in_a_comment_of_its_own(tmp_path: Path) -> None:
    header = write_ply(PointCloud(POINTS), tmp_path / "cloud.ply").read_bytes().partition(b"end_header")[0]
    assert b"\ncomment SPACE=RAS\n" in header  # as 3D Slicer's reader wants it


def test_faces_parts_and_columns_are_read_by_other_libraries(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=80.0)
    n = len(sphere.vertices)
    parts, far = np.arange(n) % 10 - 1, np.linspace(0, 7, n)
    cloud = PointCloud(sphere.vertices, parts=parts)
    path = write_ply(cloud, tmp_path / "mesh.ply", faces=sphere.faces, columns={"us_distance": far})
    read = read_ply_file(path)
    assert read.faces is not None
    assert np.array_equal(read.faces, sphere.faces)
    assert np.array_equal(read.points, sphere.vertices)
    other = trimesh.load(path, process=False)
    assert other.volume == pytest.approx(sphere.volume)  # the winding too
    columns = other.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(np.ravel(columns["part"]), parts)
    assert np.array_equal(np.ravel(columns["us_distance"]), far)
    third = o3d.io.read_triangle_mesh(str(path))
    assert np.array_equal(np.asarray(third.vertices), sphere.vertices)
    assert np.array_equal(np.asarray(third.triangles), sphere.faces)
    assert len(o3d.io.read_point_cloud(str(write_ply(cloud, tmp_path / "cloud.ply"))).points) == n
    assert read_ply_file(tmp_path / "cloud.ply").faces is None
    path.write_bytes(path.read_bytes()[:-100])  # cut off within the faces
    with pytest.raises(StudyError, match=r"mesh\.ply: expected a PLY file with points"):
        read_ply(path)


def test_another_suffix_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"ends in \.ply, got 'cloud\.stl'"):
        write_ply(PointCloud(POINTS), tmp_path / "cloud.stl")
    assert not list(tmp_path.iterdir())


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
