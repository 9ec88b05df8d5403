"""The command line on CTs of one's own: masks, landmarks, the draft of a manifest, tables without the paper's rows."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from drawn_chest import draw, drawn_landmarks
from phantom_files import SMALL, landmark_file, masks_folder, nifti, own_manifest, points_file, scan, structure_ids
from PIL import Image

from study import params as study_params
from study.cli import main
from study.ct.parts import parts_from_labels
from study.data.manifest import load_manifest
from study.files.clouds import read_ply
from study.files.landmarks import read_landmarks
from study.types import CARTILAGES

Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STUDY_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setattr(study_params, "PROFILES", {**study_params.PROFILES, "quick": SMALL})
    monkeypatch.chdir(tmp_path)


def refused(capsys: Capture, *arguments: str | Path) -> str:
    assert main([str(argument) for argument in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("study: ")
    assert err.count("\n") == 1
    return err


# --- study cloud ---------------------------------------------------------------------------------------------------


def test_a_folder_of_masks_gives_the_cloud_of_the_label_volume(tmp_path: Path, capsys: Capture) -> None:
    ct, labels = scan("ct1")
    nifti(ct, tmp_path / "ct.nii.gz")
    nifti(labels, tmp_path / "labels.nii.gz")
    masks_folder(tmp_path / "segmentations")
    for given, out in (("labels.nii.gz", "one.ply"), ("segmentations", "many.ply")):
        assert main(["cloud", "ct.nii.gz", "--labels", given, "--points", "600", "--out", out]) == 0
    assert np.array_equal(read_ply(tmp_path / "one.ply"), read_ply(tmp_path / "many.ply"))
    capsys.readouterr()
    (tmp_path / "segmentations" / "rib_left_3.nii.gz").unlink()
    assert "rib_left_3" in refused(capsys, "cloud", "ct.nii.gz", "--labels", "segmentations", "--out", "c.ply")
    (tmp_path / "empty").mkdir()
    assert "expected masks" in refused(capsys, "cloud", "ct.nii.gz", "--labels", "empty", "--out", "c.ply")


# --- landmarks -----------------------------------------------------------------------------------------------------


@pytest.fixture
def marked(tmp_path: Path) -> Path:
    parts = parts_from_labels(scan("ct1")[1], structure_ids())
    return landmark_file(parts, tmp_path / "mine.yaml")


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_landmarks_placed_in_slicer_are_those_of_the_file(tmp_path: Path, marked: Path, space: str) -> None:
    here, there = read_landmarks(marked), read_landmarks(points_file(tmp_path / "mine.mrk.json", marked, space))
    for part in CARTILAGES:
        assert np.allclose(here.junctions[part], there.junctions[part])
        assert np.allclose(here.attachments[part], there.attachments[part])
    assert np.allclose(here.sternum, there.sternum)


@pytest.mark.parametrize(
    ("rename", "named"),
    [
        ({"junction right 2": "the first one"}, "the first one"),
        ({"junction right 2": "junction right 3"}, "twice"),
        ({"junction right 2": "sternum 9"}, "right_2"),
        ({f"sternum {k}": f"attachment left {k}" for k in (2, 3, 4, 5)}, "twice"),
    ],
)
def test_points_with_other_labels_are_named(
    tmp_path: Path, marked: Path, rename: dict[str, str], named: str, capsys: Capture
) -> None:
    path = points_file(tmp_path / "bad.mrk.json", marked, rename=rename)
    nifti(scan("ct1")[0], tmp_path / "ct.nii.gz")
    assert named in refused(capsys, "cloud", "ct.nii.gz", "--landmarks", path, "--out", "c.ply")


def test_many_picks_are_answered_by_one_load_and_pictures_are_drawn(tmp_path: Path, capsys: Capture) -> None:
    ct, _, _ = draw()
    nifti(ct.with_values(ct.values.astype(np.int16)), tmp_path / "ct.nii.gz")
    marks = drawn_landmarks()
    ends = [marks.junctions[CARTILAGES[0]], marks.attachments[CARTILAGES[5]]]
    words = [word for end in ends for word in ("--pick", f"{end[0]},{end[2]}")]
    assert main(["landmarks", "ct.nii.gz", *words]) == 0
    found = [yaml.safe_load(line) for line in capsys.readouterr().out.splitlines()]
    assert np.linalg.norm(np.array(found) - ends, axis=1).max() < 4.0
    assert main(["landmarks", "ct.nii.gz", "--slice", "20", "--slice=-5", "--out", "p"]) == 0
    assert main(["landmarks", "ct.nii.gz", "--out", "p"]) == 0
    made = sorted(path.name for path in (tmp_path / "p").iterdir())
    assert made == ["front.png", "slices.png"]
    assert all(Image.open(tmp_path / "p" / name).width > 900 for name in made)
    capsys.readouterr()
    assert "expected --out" in refused(capsys, "landmarks", "ct.nii.gz")
    assert "expected 2 numbers" in refused(capsys, "landmarks", "ct.nii.gz", "--pick", "3;4")
    assert "bone or cartilage" in refused(capsys, "landmarks", "ct.nii.gz", "--pick", "40,33")
    assert "nothing there" in refused(capsys, "landmarks", "none.nii.gz", "--pick", "0,0")


# --- study data init, and tables of one's own ------------------------------------------------------------------------


def test_a_drafted_manifest_runs_as_it_is(tmp_path: Path, capsys: Capture, marked: Path) -> None:
    folder = tmp_path / "chests"
    for name in ("ct1", "ct2"):
        ct, labels = scan(name)
        nifti(ct, folder / f"{name}.nii.gz")
        nifti(labels, folder / f"{name}_labels.nii.gz")
    nifti(scan("ct1")[0], folder / "anna b" / "ct.nii.gz")
    masks_folder(folder / "anna b" / "segmentations")
    nifti(scan("ct1")[0], folder / "carl.nii.gz")
    points_file(folder / "carl.mrk.json", marked)
    nifti(scan("ct1")[0], folder / "dora.nii.gz")
    assert main(["data", "init", "chests"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("5 CTs: chests/manifest.yaml")
    assert "without labels or landmarks: dora" in err
    manifest = load_manifest(folder / "manifest.yaml")
    subjects = manifest.cohort("chests").subjects
    assert set(subjects) == {"ct1", "ct2", "anna-b", "carl", "dora"}
    assert subjects["carl"].landmarks == "carl.mrk.json"
    assert manifest.file("anna-b_labels").is_family
    assert "#" in (folder / "manifest.yaml").read_text(encoding="utf-8")
    assert "new file" in refused(capsys, "data", "init", "chests")
    for path in (folder / "dora.nii.gz", folder / "manifest.yaml"):
        path.unlink()
    assert main(["data", "init", "chests", "--out", "cohort.yaml"]) == 0
    assert main(["data", "verify", "--dataset", "cohort.yaml"]) in (0, 1)  # 1: no hash is recorded
    assert "missing" not in capsys.readouterr().out
    assert main(["anatomy", "--dataset", "cohort.yaml", "--out", "sizes.csv"]) == 0
    assert set(pd.read_csv("sizes.csv")["subject"]) == {"ct1", "ct2", "anna-b", "carl"}


@pytest.mark.parametrize("path", ["nowhere", "bare"])
def test_a_folder_without_cts_drafts_nothing(tmp_path: Path, capsys: Capture, path: str) -> None:
    (tmp_path / "bare").mkdir()
    assert "expected" in refused(capsys, "data", "init", path)
    assert not list(tmp_path.rglob("*.yaml"))


def test_tables_of_ones_own_people_have_no_rows_of_the_paper_and_no_empty_columns(
    tmp_path: Path, capsys: Capture
) -> None:
    path = own_manifest(tmp_path / "mine")
    words = ["run", "--dataset", str(path), "--profile", "quick", "--methods", "coarse,icp", "--out", "runs/mine"]
    assert main(words) == 0
    out = capsys.readouterr().out
    table = (tmp_path / "runs" / "mine" / "hd_table.md").read_text(encoding="utf-8")
    assert "paper" not in out
    assert "paper" not in table
    assert "CT 2" not in table  # one CT
    header = next(line for line in table.splitlines() if line.startswith("|"))
    assert all(cell.strip() for cell in header.strip("|").split("|"))
    assert not re.search(r"\| +\|", table)
