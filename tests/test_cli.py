from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from http_archive import (
    RIBFRAC_PATH,
    TOTALSEGMENTATOR_PATH,
    ArchiveServer,
    rebased_manifest,
    ribfrac_zip,
    ribseg_zip,
    totalsegmentator_zip,
)
from phantom_files import SMALL, cached_ct_volume, landmark_file, nifti, own_manifest, scan, structure_ids
from scipy.spatial import KDTree

from study import params as study_params
from study import phantom, pipeline
from study.cli import main
from study.ct.parts import parts_from_labels
from study.datasets import for_evidence
from study.errors import StudyError
from study.files.atomic import sha256_of
from study.files.clouds import read_ply, write_ply
from study.methods import METHODS
from study.params import PHANTOM_SEED
from study.results.metrics_csv import Case, metric_rows, read_metrics, write_metrics
from study.types import PointCloud, RigidTransform

Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No downloads, no one else's data folder, phantom volumes drawn once, everything written below tmp_path."""
    monkeypatch.setenv("STUDY_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(phantom, "ct_volume", cached_ct_volume)
    monkeypatch.setattr(study_params, "PROFILES", {**study_params.PROFILES, "quick": SMALL})
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def server() -> Iterator[ArchiveServer]:
    with ArchiveServer() as running:
        yield running


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A CT and a US cloud of two phantoms, each in a frame of its own, and waypoints of the CT."""
    folder = tmp_path_factory.mktemp("clouds")
    rng = np.random.default_rng(3)
    ct = phantom.reference_cloud(phantom.draw_subject("ct1", PHANTOM_SEED), 4000, rng)
    us = phantom.anterior_cloud(phantom.draw_subject("patient", PHANTOM_SEED), 3000, 0.5, 2, rng)
    waypoints = phantom.waypoints(phantom.draw_subject("ct1", PHANTOM_SEED)).points
    for cloud, name in ((ct, "ct"), (us, "us")):
        T = RigidTransform.random(rng)
        write_ply(PointCloud(T.apply(cloud.points)), folder / f"{name}.ply")
        if name == "ct":
            np.savetxt(folder / "way.csv", T.apply(waypoints), delimiter=",", header="x,y,z", comments="")
    return folder


def refused(capsys: Capture, *arguments: str | Path) -> str:
    """The one line on standard error of a command that is refused."""
    assert main([str(argument) for argument in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("study: ")
    assert err.count("\n") == 1
    assert err.endswith("\n")
    assert "Traceback" not in err
    return err


# --- help ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [[], ["data"], ["run"], ["compare"], ["rerun"], ["register"], ["cloud"], ["report"], ["datasets"], ["evidence"],
     ["landmarks"], ["data", "init"], ["data", "list"], ["data", "fetch"], ["data", "verify"]],
    ids=" ".join,
)  # fmt: skip
def test_every_command_explains_itself(words: list[str], capsys: Capture) -> None:
    assert main([*words, "--help"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"Usage: {' '.join(['study', *words])} ")
    assert "..." not in out.split("\n", 1)[1]  # no sentence is cut off
    assert err == ""


def test_study_alone_prints_the_commands(capsys: Capture) -> None:
    assert main([]) == 0
    out = capsys.readouterr().out
    assert all(f"  {name} " in out for name in ("data", "run", "compare", "register", "cloud", "report"))


def test_the_module_exits_with_the_code_and_no_traceback() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "study", "run", "--profile", "fast"],
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == "study: expected a profile among full, quick, got 'fast'\n"
    assert done.stdout == ""


# --- what is refused, on one line ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "told"),
    [(["run", "--methods", "icp,magic"], "expected a method among coarse, icp,"),
     (["run", "--methods", ""], "expected a method among"),
     (["run", "--dataset", "opne"], "got 'opne'"),
     (["run", "--profile", "fast"], "expected a profile among full, quick, got 'fast'"),
     (["run", "--datset", "open"], "No such option"),
     (["run", "--jobs", "0"], "--jobs"),
     (["run", "--seed", "-1"], "--seed"),
     (["run", "--seed", "one"], "--seed"),
     (["run", "--dataset", "none.yaml"], "none.yaml"),
     (["data", "list", "--dataset", "opne"], "got 'opne'"),
     (["data", "fetch", "--dataset", "none.yaml"], "none.yaml"),
     (["data", "verify", "--dataset", "opne"], "got 'opne'"),
     (["data", "lst"], "No such command 'lst'"),
     (["rnu"], "No such command 'rnu'"),
     (["register", "a.ply"], "Missing argument 'US'"),
     (["register", "a.ply", "b.ply", "--out", "o"], "expected a PLY file at a.ply, got no such file"),
     (["register", "a.ply", "b.ply"], "--out"),
     (["compare", "none", "nothing"], "none"),
     (["report", "none"], "none"),
     (["cloud", "ct.nii.gz", "--out", "c.ply"], "expected labels or landmarks, got neither"),
     (["cloud", "ct.nii.gz", "--labels", "l", "--landmarks", "m", "--out", "c.ply"], "got both"),
     (["cloud", "ct.nii.gz", "--landmarks", "m", "--out", "c.stl"], "ends in .ply"),
     (["cloud", "ct.nii.gz", "--labels", "l.nii", "--label-map", "mine", "--out", "c.ply"], "got 'mine'"),
     (["cloud", "ct.nii.gz", "--labels", "l.nii", "--out", "c.ply"], "ct.nii.gz")],
)  # fmt: skip
def test_an_expected_failure_is_one_line_and_exit_code_2(words: list[str], told: str, capsys: Capture) -> None:
    assert told in refused(capsys, *words)
    assert not Path("results").exists()
    assert not Path("o").exists()


def test_a_bad_manifest_names_its_key(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "bad.yaml").write_text("cohorts:\n  mine:\n    subjects:\n      a: {role: nurse}\n")
    line = refused(capsys, "run", "--dataset", "bad.yaml")
    assert "cohorts.mine.subjects.a.role (line 4)" in line
    raw = {"cohorts": {name: {"kind": "generated", "subjects": {"a": {}}} for name in ("one", "two")}}
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(raw))
    assert "two.yaml: expected one cohort, got one, two" in refused(capsys, "run", "--dataset", "two.yaml")


def test_a_run_that_cannot_be_written_is_refused_before_it_starts(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "file").write_text("mine")
    assert "file" in refused(capsys, "run", "--profile", "quick", "--methods", "coarse", "--out", "file")
    assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"


def test_ribseg_without_its_labels_says_what_to_download_and_where_to_put_it(tmp_path: Path, capsys: Capture) -> None:
    with ArchiveServer() as server:
        path = rebased_manifest(tmp_path / "mine.yaml", server.url, keep=["ribseg"])
        assert main(["run", "--dataset", str(path), "--profile", "quick", "--methods", "coarse"]) == 2
        assert server.requests == []
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("study: ")]
    assert len(told) == 1
    assert "drive.google.com" in told[0]
    assert str(tmp_path / "data" / "ribseg_v2.zip") in told[0]


@pytest.mark.parametrize("error", [ZeroDivisionError("by\nnought"), RuntimeError("x"), MemoryError(), RecursionError()])
def test_anything_unforeseen_is_one_line_with_a_code_of_its_own(
    error: Exception, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("study.data.manifest.load_manifest", fail)
    assert main(["datasets"]) == 70
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"study: expected no such error, got {type(error).__name__}")
    assert err.count("\n") == 1
    assert main(["--traceback", "datasets"]) == 70
    assert "Traceback (most recent call last)" in capsys.readouterr().err
    monkeypatch.setenv("STUDY_TRACEBACK", "1")
    assert main(["datasets"]) == 70
    assert "Traceback (most recent call last)" in capsys.readouterr().err


# --- register --------------------------------------------------------------------------------------------------------


def test_two_clouds_are_registered_and_written(clouds: Path, tmp_path: Path, capsys: Capture) -> None:
    words = ["register", str(clouds / "ct.ply"), str(clouds / "us.ply"), "--waypoints", str(clouds / "way.csv")]
    assert main([*words, "--method", "icp", "--out", "out"]) == 0
    out, _ = capsys.readouterr()
    written = {path.name for path in (tmp_path / "out").iterdir()}
    made = {"warped.ply", "registration.json", "rigid.tfm"}
    assert written == made | {"waypoints_us.csv", "waypoints_us.mrk.json", "waypoints_robot.json"}
    assert all(name in out for name in written)
    assert "not for a probe to follow" in out
    assert "no comment SPACE=" not in out
    ct, us, warped = (read_ply(path) for path in (clouds / "ct.ply", clouds / "us.ply", tmp_path / "out/warped.ply"))
    T = np.array(json.loads((tmp_path / "out" / "registration.json").read_text(encoding="utf-8"))["T_us_ct"])
    assert np.allclose(ct @ T[:3, :3].T + T[:3, 3], warped, atol=1e-9)  # ICP is rigid: row i is CT point i
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert np.linalg.norm(warped.mean(axis=0) - us.mean(axis=0)) < 25.0
    waypoints = np.loadtxt(clouds / "way.csv", delimiter=",", skiprows=1)
    moved = np.loadtxt(tmp_path / "out" / "waypoints_us.csv", delimiter=",", skiprows=1)
    assert np.allclose(waypoints @ T[:3, :3].T + T[:3, 3], moved, atol=1e-6)


def test_a_clouds_times_come_with_its_file(
    clouds: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    us, handed = read_ply(clouds / "us.ply"), []
    write_ply(PointCloud(us, times=np.arange(len(us)) / 100), tmp_path / "timed.ply")

    def register(*given: Any, **options: Any) -> Any:
        handed.append(options["times"])
        raise StudyError("expected nothing")

    monkeypatch.setattr(pipeline, "register_pair", register)
    for name in (tmp_path / "timed.ply", clouds / "us.ply"):
        refused(capsys, "register", clouds / "ct.ply", name, "--out", "out")
    assert np.array_equal(handed[0], np.arange(len(us)) / 100)
    assert handed[1] is None


def test_the_default_method_keeps_the_rows(clouds: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "out").mkdir()
    for name in ("waypoints_us.csv", "notes.txt"):  # the waypoints of an earlier registration, and the user's own
        (tmp_path / "out" / name).write_text("old")
    assert main(["register", str(clouds / "ct.ply"), str(clouds / "us.ply"), "--out", "out"]) == 0
    capsys.readouterr()
    ct, warped = read_ply(clouds / "ct.ply"), read_ply(tmp_path / "out" / "warped.ply")
    assert warped.shape == ct.shape
    some = np.random.default_rng(0).choice(len(ct), size=(500, 2))
    before, after = (np.linalg.norm(np.diff(points[some], axis=1)[:, 0], axis=1) for points in (ct, warped))
    assert np.corrcoef(before, after)[0, 1] > 0.9  # neighbours stay neighbours only if the order is kept
    assert not (tmp_path / "out" / "waypoints_us.csv").exists()
    assert (tmp_path / "out" / "notes.txt").read_text() == "old"
    assert (
        json.loads((tmp_path / "out" / "registration.json").read_text(encoding="utf-8"))["method"] == "skeleton_graph"
    )


def test_front_radius_quality_and_warnings(clouds: Path, tmp_path: Path, capsys: Capture) -> None:
    words = ["register", str(clouds / "ct.ply"), str(clouds / "us.ply"), "--method", "coarse", "--out", "out"]
    assert main([*words, "--front", "0,1,0", "--radius", "30", "--waypoints", str(clouds / "way.csv")]) == 0
    said = capsys.readouterr().err
    summary = json.loads((tmp_path / "out" / "registration.json").read_text(encoding="utf-8"))
    assert set(summary["quality"]) == {
        "residual_share", "wrong_part_share", "further_motion_mm", "stretched_share", "folded_share"
    }  # fmt: skip
    assert summary["quality"]["further_motion_mm"] == pytest.approx(0.0, abs=1e-6)  # coarse moves nothing further
    assert all(f"study: warning: {one}" in said for one in summary["warnings"])
    line = refused(capsys, *words[:-1], "back", "--front", "0,-1,0")
    assert "us: expected cartilages that arch towards the `front` given" in line
    assert "expected 3 numbers" in refused(capsys, *words[:-1], "back", "--front", "up")
    assert "--radius" in refused(capsys, *words[:-1], "back", "--radius", "-3")
    assert not (tmp_path / "back").exists()


def test_a_waypoint_far_off_is_named_and_the_others_are_carried(clouds: Path, tmp_path: Path, capsys: Capture) -> None:
    good = (clouds / "way.csv").read_text().splitlines()
    (tmp_path / "way.csv").write_text("\n".join([good[0], good[1], "9000,0,0", good[2]]) + "\n")
    words = ["register", str(clouds / "ct.ply"), str(clouds / "us.ply"), "--method", "coarse", "--out", "out"]
    assert main([*words, "--waypoints", "way.csv"]) == 0
    assert "waypoint not carried: line 3: expected at least 3 CT points" in capsys.readouterr().err
    rows = (tmp_path / "out" / "waypoints_us.csv").read_text(encoding="utf-8").splitlines()
    assert [row.startswith(",,,") for row in rows] == [False, False, True, False]


def test_files_of_slicer_and_a_field_go_through(clouds: Path, tmp_path: Path, capsys: Capture) -> None:
    """The same clouds and waypoints as 3D Slicer keeps them, in LPS, give the same result."""
    turned = [-1.0, -1.0, 1.0]
    for name in ("ct", "us"):
        path = write_ply(PointCloud(read_ply(clouds / f"{name}.ply") * turned), tmp_path / f"{name}.ply")
        path.write_bytes(path.read_bytes().replace(b"SPACE=RAS", b"SPACE=LPS"))
    places = np.loadtxt(clouds / "way.csv", delimiter=",", skiprows=1)
    points = [{"label": f"W{k}", "position": (place * turned).tolist()} for k, place in enumerate(places)]
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    (tmp_path / "w.mrk.json").write_text(json.dumps({"markups": [markup]}), encoding="utf-8")
    rest = ["--method", "coarse", "--out"]
    assert main(["register", "ct.ply", "us.ply", "--waypoints", "w.mrk.json", "--field", "8", *rest, "lps"]) == 0
    ras = [str(clouds / name) for name in ("ct.ply", "us.ply", "way.csv")]
    assert main(["register", *ras[:2], "--waypoints", ras[2], *rest, "ras"]) == 0
    capsys.readouterr()
    assert np.allclose(read_ply("lps/warped.ply"), read_ply("ras/warped.ply"), atol=1e-6)
    assert Path("lps/displacement.nii.gz").is_file()
    summary = json.loads(Path("lps/registration.json").read_text(encoding="utf-8"))
    assert (summary["inputs"]["us"]["space"], summary["inputs"]["waypoints"]["space"]) == ("LPS", "LPS")
    assert summary["inputs"]["ct"]["sha256"] == sha256_of(tmp_path / "ct.ply")
    assert summary["field"]["return_mm"]["max"] < 0.01  # coarse moves rigidly
    us = json.loads(Path("lps/waypoints_us.mrk.json").read_text(encoding="utf-8"))["markups"][0]
    assert us["coordinateSystem"] == "LPS"
    in_ras = np.loadtxt("ras/waypoints_us.csv", delimiter=",", skiprows=1)
    assert np.allclose([one["position"] for one in us["controlPoints"]], in_ras * turned, atol=1e-6)
    (tmp_path / "w.mrk.json").write_text(json.dumps({"markups": [markup]})[:-9], encoding="utf-8")
    line = refused(capsys, "register", "ct.ply", "us.ply", "--waypoints", "w.mrk.json", *rest, "no")
    assert "w.mrk.json: expected JSON" in line
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("fault", ["nan", "metres", "five", "garbage", "flat", "waypoint", "method", "columns"])
def test_bad_clouds_are_refused_and_leave_nothing(clouds: Path, tmp_path: Path, capsys: Capture, fault: str) -> None:
    points = np.array(read_ply(clouds / "ct.ply"))
    options: list[str | Path] = []
    if fault == "nan":
        points[7] = np.nan
    elif fault == "metres":
        points /= 1000
    elif fault == "five":
        points = points[:5]
    elif fault == "flat":
        points = np.random.default_rng(0).normal(scale=60.0, size=(3000, 3))
    elif fault == "method":
        options = ["--method", "magic"]
    elif fault == "waypoint":
        (tmp_path / "far.csv").write_text("x,y,z\n9000,0,0\n")
        options = ["--waypoints", "far.csv", "--method", "coarse"]
    elif fault == "columns":
        (tmp_path / "far.csv").write_text("a,b\n1,2\n")
        options = ["--waypoints", "far.csv"]
    trimesh.PointCloud(points).export(tmp_path / "bad.ply")
    if fault == "garbage":
        (tmp_path / "bad.ply").write_bytes(b"ply\nrubbish")
    line = refused(capsys, "register", "bad.ply", clouds / "us.ply", *options, "--out", "out")
    told = {"nan": "NaN", "metres": "metres? multiply by 1000", "five": "got 5", "garbage": "bad.ply",
            "flat": "expected", "waypoint": "within", "method": "magic", "columns": "x, y, z"}  # fmt: skip
    assert told[fault] in line
    assert not (tmp_path / "out").exists()


# --- a CT of one's own -----------------------------------------------------------------------------------------------


def test_a_cloud_from_labels_and_from_landmarks(tmp_path: Path, capsys: Capture) -> None:
    image, labels = scan("ct1")
    nifti(image, tmp_path / "ct.nii.gz")
    nifti(labels, tmp_path / "labels.nii.gz")
    landmark_file(parts_from_labels(labels, structure_ids()), tmp_path / "ct.yaml")
    options = ["--points", "2000", "--out"]
    assert main(["cloud", "ct.nii.gz", "--labels", "labels.nii.gz", *options, "a.ply"]) == 0
    assert main(["cloud", "ct.nii.gz", "--landmarks", "ct.yaml", *options, "b.ply"]) == 0
    assert "2000 points of sternum and cartilages 2-5, mm RAS+: a.ply" in capsys.readouterr().out
    surface = phantom.reference_cloud(phantom.draw_subject("ct1", PHANTOM_SEED), 20000, np.random.default_rng(0)).points
    for name, limit_mm in (("a.ply", 1.5), ("b.ply", 3.0)):
        points = read_ply(tmp_path / name)
        assert points.shape == (2000, 3)
        assert KDTree(surface).query(points)[0].mean() < limit_mm
    other = nifti(scan("ct2")[1], tmp_path / "other.nii.gz")
    line = refused(capsys, "cloud", "ct.nii.gz", "--labels", other, *options, "c.ply")
    assert "grid" in line
    line = refused(capsys, "cloud", "ct.nii.gz", "--labels", "ct.nii.gz", *options, "c.ply")
    assert "ct" in line
    line = refused(
        capsys, "cloud", "ct.nii.gz", "--labels", "labels.nii.gz", "--label-map", "ribseg_v2", *options, "c.ply"
    )
    assert "wrong label map" in line
    assert not (tmp_path / "c.ply").exists()


def test_a_manifest_of_ones_own_runs_compares_and_reports(tmp_path: Path, capsys: Capture) -> None:
    path = own_manifest(tmp_path / "mine")
    words = ["run", "--dataset", str(path.relative_to(tmp_path)), "--profile", "quick", "--methods", "coarse, icp"]
    assert main([*words, "--out", "runs/mine"]) == 0
    out, err = capsys.readouterr()
    assert "Hausdorff distance, mine" in out
    assert "mine: registrations: 2 of 2" in err
    metrics = read_metrics(tmp_path / "runs" / "mine" / "metrics.csv")
    assert set(zip(metrics["source"], metrics["target"], strict=True)) == {("ct2", "ct1")}
    assert set(metrics[metrics["method"] == "coarse"]["status"]) == {"ok"}
    assert not metrics["metric"].str.startswith("true").any()  # between two people no truth is known
    inputs = json.loads((tmp_path / "runs" / "mine" / "provenance.json").read_text(encoding="utf-8"))["inputs_sha256"]
    assert inputs["ct1_ct"] == sha256_of(tmp_path / "mine" / "scans" / "ct1_ct.nii.gz")

    assert main(["report", "runs"]) == 0
    out, err = capsys.readouterr()
    assert "## mine" in out
    assert err == ""
    (tmp_path / "runs" / "mine" / "hd_table.md").write_text("| better |")
    assert main(["report", "runs"]) == 0
    assert capsys.readouterr().err == (
        "study: warning: runs/mine: the run has since been altered: edited hd_table.md\n"
    )
    assert main(["compare", "runs/mine", "runs/mine"]) == 0
    assert f"compared {len(metrics)} rows" in capsys.readouterr().out

    # One scan cut short: its rows say so, and the command that has nothing left to show fails.
    scan_file = tmp_path / "mine" / "scans" / "ct2_ct.nii.gz"
    scan_file.write_bytes(scan_file.read_bytes()[:9000])
    assert main([*words, "--out", "runs/cut"]) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("study: ")]
    assert len(told) == 1
    assert "mine: every case failed: ct2_ct" in told[0]
    assert read_metrics(tmp_path / "runs" / "cut" / "metrics.csv")["status"].str.startswith("failed: ct2_ct").all()


# --- compare ---------------------------------------------------------------------------------------------------------


def metrics_file(folder: Path, hd: float = 10.0, method: str = "icp") -> Path:
    write_metrics(metric_rows(Case("d", "a", "b", method, 0), {"hd": hd}), folder / "metrics.csv")
    return folder


def test_compare_agrees_differs_and_cannot(tmp_path: Path, capsys: Capture) -> None:
    reference = metrics_file(tmp_path / "reference")
    assert main(["compare", str(reference), str(metrics_file(tmp_path / "same"))]) == 0
    assert "compared 1 rows" in capsys.readouterr().out
    assert main(["compare", str(reference), str(metrics_file(tmp_path / "far", hd=20.0))]) == 1
    out, err = capsys.readouterr()
    assert "1 value(s) beyond tolerance" in out
    assert "20.0" in out
    assert err == ""
    assert main(["compare", str(reference), str(metrics_file(tmp_path / "shifted", hd=10.19))]) == 1
    assert "1 mean(s) beyond tolerance" in capsys.readouterr().out
    assert main(["compare", str(reference), str(metrics_file(tmp_path / "other", method="cpd"))]) == 1
    assert "only in the reference" in capsys.readouterr().out
    (tmp_path / "empty").mkdir()
    for words in (["--tolerance", "9"], [reference], [reference, reference, reference]):
        refused(capsys, "compare", *words)  # never 1, which says that two runs differ
    metrics_file(tmp_path / "open")
    text = (tmp_path / "open" / "metrics.csv").read_text(encoding="utf-8")
    (tmp_path / "open" / "metrics.csv").write_text(text.replace("\nd,", "\nopen,"), encoding="utf-8")
    assert "expected a run of d at seed 0" in refused(capsys, "compare", reference, "open")
    assert "metrics.csv" in refused(capsys, "compare", reference, "empty")
    assert "metrics.csv" in refused(capsys, "compare", "empty", reference)
    for name, text in (("blank", ""), ("header", "a,b\n"), ("binary", "\0\1\2")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.csv").write_text(text)
        assert name in refused(capsys, "compare", reference, name)
    shutil.copytree(reference, tmp_path / "no_rows")
    rows = (tmp_path / "no_rows" / "metrics.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "no_rows" / "metrics.csv").write_text(rows[0] + "\n")
    assert "at least one row" in refused(capsys, "compare", reference, "no_rows")


def test_only_the_whole_study_goes_where_the_reference_is_made_from(tmp_path: Path, capsys: Capture) -> None:
    words = ["run", "--profile", "quick", "--methods", "coarse"]
    assert main(words) == 0
    assert "metrics, tables and provenance: results/trials/phantom-quick-seed0-coarse\n" in capsys.readouterr().out
    assert not (tmp_path / "results" / "runs").exists()


def test_datasets_are_listed_by_the_library(capsys: Capture) -> None:
    assert main(["datasets", "--reported"]) == 0
    assert capsys.readouterr().out.splitlines() == ["phantom", "planted", "open"]
    assert main(["datasets", "--evidence"]) == 0
    assert capsys.readouterr().out.splitlines() == for_evidence()
    assert main(["datasets"]) == 0
    assert {"ribseg", "totalsegmentator"} < set(capsys.readouterr().out.splitlines())


def test_report_needs_runs(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "runs").mkdir()
    assert "run `study run` first" in refused(capsys, "report", "runs")


# --- data ------------------------------------------------------------------------------------------------------------


def test_data_list_fetch_and_verify(server: ArchiveServer, tmp_path: Path, capsys: Capture) -> None:
    rng = np.random.default_rng(0)
    server.files[RIBFRAC_PATH] = ribfrac_zip({number: rng.bytes(2000) for number in (421, 441, 461, 481, 500)})
    packed = ribseg_zip({number: rng.bytes(500) for number in (421, 441, 461, 481, 500)})
    path = rebased_manifest(tmp_path / "mine.yaml", server.url, keep=["ribseg"])
    options = ["--dataset", str(path)]
    assert main(["data", "list", *options]) == 0
    out, _ = capsys.readouterr()
    assert out.count("absent") == 5
    assert out.count("to be put in place") == 5
    assert "CC BY-NC 4.0" in out
    assert main(["data", "verify", *options]) == 1
    capsys.readouterr()
    assert "drive.google.com" in refused(capsys, "data", "fetch", *options)
    (tmp_path / "ribseg_v2.zip").write_bytes(packed)
    assert main(["data", "fetch", *options]) == 0
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 10
    assert all(Path(line).is_file() for line in out.splitlines())
    assert "fetching 10 files" in err
    n_before = len(server.requests)
    assert main(["data", "fetch", *options]) == 0
    assert len(server.requests) == n_before
    assert main(["data", "verify", *options]) == 0
    assert capsys.readouterr().out.count("verified") == 10
    Path(out.splitlines()[0]).write_bytes(b"flipped")
    assert main(["data", "verify", *options]) == 1
    assert "expected sha256" in capsys.readouterr().out
    assert not Path(out.splitlines()[0]).exists()


def test_data_fetch_of_one_mask_per_structure(server: ArchiveServer, tmp_path: Path, capsys: Capture) -> None:
    masks = {name: name.encode() for name in structure_ids()}
    server.files[TOTALSEGMENTATOR_PATH] = totalsegmentator_zip(
        {name: (name.encode(), masks) for name in ("s0011", "s0058", "s0223")}
    )
    path = rebased_manifest(tmp_path / "mine.yml", server.url, keep=["totalsegmentator"])
    assert main(["data", "fetch", "--dataset", str(path)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 3 * (1 + len(masks))


@pytest.mark.parametrize("verb", ["list", "fetch", "verify"])
def test_a_generated_cohort_has_no_files_and_that_is_fine(verb: str, capsys: Capture) -> None:
    assert main(["data", verb, "--dataset", "phantom"]) == 0
    assert capsys.readouterr().out == "phantom: no files, it is generated\n"


def test_planted_has_the_files_of_open(capsys: Capture) -> None:
    assert main(["data", "list", "--dataset", "planted"]) == 0
    assert "lidc_ct" in capsys.readouterr().out


def test_the_methods_named_in_the_readme_exist() -> None:
    assert {"icp", "nonrigid_icp", "cpd", "skeleton_graph"} <= set(METHODS)
