"""`study sweep`: a recording as a site has it becomes a cloud, and every frame's fate is told."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from PIL import Image
from plus_files import plus_recording
from scipy.spatial import KDTree
from small_sweeps import flat_sweep

from study.cli import main
from study.files import read_plus, read_timed_ply, write_folder
from study.ultrasound.bmode import simulate_bmode
from study.ultrasound.cloud import contour_points, sweep_cloud


@pytest.fixture(scope="module")
def sweep():
    """60 frames of B-mode over a flat bone, the last ten lost by the tracker, and its true masks."""
    plain = flat_sweep(
        masks=flat_sweep().masks.repeat(2, axis=1).repeat(2, axis=2), pixel_spacing_mm=(0.25, 0.25), latency_s=0.0
    )
    valid = plain.pose_times_s < plain.frame_times_s[50] - 0.01
    images = simulate_bmode(plain.masks, plain.pixel_spacing_mm, np.random.default_rng(0))
    return replace(plain, images=images, pose_valid=valid)


@pytest.fixture
def recording(tmp_path: Path, sweep) -> Path:
    return plus_recording(tmp_path / "rec.nrrd", sweep)


def test_masks_of_slicer_give_the_cloud_of_the_inner_road(tmp_path, recording, sweep, capsys):
    image = sitk.GetImageFromArray(sweep.masks.astype(np.uint8))
    for key, value in (("Name", "bone"), ("LabelValue", "1"), ("Layer", "0")):
        image.SetMetaData(f"Segment0_{key}", value)
    sitk.WriteImage(image, str(tmp_path / "m.seg.nrrd"), True)
    out = tmp_path / "cloud.ply"
    assert main(["sweep", str(recording), "--masks", str(tmp_path / "m.seg.nrrd"), "--out", str(out)]) == 0
    said = capsys.readouterr()
    expected = sweep_cloud(sweep).cloud
    points, times = read_timed_ply(out)
    # Thinning takes one of two points that lie even; before it they are the same.
    read = read_plus(recording, masks=tmp_path / "m.seg.nrrd")
    np.testing.assert_allclose(contour_points(read)[0], contour_points(sweep)[0], atol=1e-9)
    assert KDTree(points).query(expected.points)[0].max() < 1.5
    assert len(points) == pytest.approx(len(expected), rel=0.05)
    assert (times.min(), times.max()) == pytest.approx((expected.times.min(), expected.times.max()), abs=0.05)
    np.testing.assert_allclose(trimesh.load(out).vertices, points, atol=1e-3)
    for line in (
        "base frame Tracker: no ReferenceToTrackerTransform is in the file",
        "calibration of rec_config.xml, beside the recording",
        "frames used: 50 of 60",
        "frames no valid pose before or after, or too long a gap: 10 of 60 (numbers 50-59)",
        "--front 0.000,0.000,-1.000",
    ):
        assert line in said.out, line
    report = json.loads((tmp_path / "cloud.json").read_text(encoding="utf-8"))
    assert [row["what"] for row in report["frames"]].count("used") == 50
    assert (report["base_frame"], report["units"]["length"], report["masks_found_here"]) == ("Tracker", "mm", False)
    assert Image.open(tmp_path / "cloud.png").size[0] > 900


def test_without_masks_the_surface_is_found_and_said(tmp_path, recording, capsys):
    assert main(["sweep", str(recording), "--out", str(tmp_path / "cloud.ply")]) == 0
    said = capsys.readouterr()
    assert "the surface was looked for in the B-mode" in said.out
    assert "60/60" in said.err  # progress
    points, _ = read_timed_ply(tmp_path / "cloud.ply")
    assert np.abs(points[:, 2] - 19.875).mean() < 0.3
    report = json.loads((tmp_path / "cloud.json").read_text(encoding="utf-8"))
    assert report["masks_found_here"]
    assert all(row["quality"] > 0.1 for row in report["frames"] if row["what"] == "used")


def test_few_frames_are_worth_a_warning_and_a_folder_is_a_recording(tmp_path, sweep, capsys):
    empty = sweep.masks.copy()
    empty[20:] = False
    write_folder(tmp_path / "folder", replace(sweep, masks=empty, images=None))
    assert main(["sweep", str(tmp_path / "folder"), "--out", str(tmp_path / "c.ply")]) == 0
    said = capsys.readouterr()
    assert "frames nothing in its mask: 30 of 60" in said.out
    assert "study: warning: only 20 of 60 frames were used; see c.json" in said.err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["none.nrrd"], "nothing at"),
        (["rec.nrrd", "--config", "none.xml"], "nothing at"),
        (["rec.nrrd", "--masks", "none"], "nothing at"),
        (["rec.nrrd", "--base", "Table"], "expected a pose ProbeToTableTransform per frame"),
        (["rec.nrrd", "--latency", "268"], "milliseconds"),
        (["bare.nrrd"], "expected a calibration, got none in the recording or beside it; give --config"),
        (["folder", "--masks", "m.nrrd"], "a folder that holds all"),
    ],
)
def test_a_refusal_is_one_line_and_leaves_nothing(tmp_path, recording, sweep, capsys, monkeypatch, words, told):
    monkeypatch.chdir(tmp_path)
    plus_recording(tmp_path / "bare.nrrd", sweep, matrix_of_config=False)
    (tmp_path / "folder").mkdir()
    before = sorted(tmp_path.iterdir())
    assert main(["sweep", *words, "--out", "cloud.ply"]) == 2
    said = capsys.readouterr().err
    assert told in said
    assert said.startswith("study: ")
    assert len(said.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == before
