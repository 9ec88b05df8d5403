"""A folder of masks and poses comes back, and a broken one says what is wrong."""

import dataclasses

import numpy as np
import pytest
import SimpleITK as sitk
from tracked_sweeps import assert_identical, make_sweep

from study.errors import StudyError
from study.files.sweep_folder import read_folder, write_folder


def test_a_folder_reads_back(tmp_path):
    sweep = make_sweep()
    write_folder(tmp_path / "f", sweep)
    back = read_folder(tmp_path / "f")
    np.testing.assert_allclose(back.poses[back.pose_valid], sweep.poses[sweep.pose_valid], atol=1e-12)
    assert_identical(dataclasses.replace(back, poses=sweep.poses), sweep)
    with pytest.raises(StudyError, match="new or empty"):
        write_folder(tmp_path / "f", sweep)
    with pytest.raises(StudyError, match="annotate"):
        write_folder(tmp_path / "g", make_sweep(masks=None, images=np.zeros((9, 2, 2))))


def test_a_folder_without_settings_is_uncalibrated(tmp_path):
    write_folder(tmp_path, make_sweep())
    (tmp_path / "sweep.json").unlink()
    back = read_folder(tmp_path)
    assert (back.pixel_spacing_mm, back.T_probe_image, back.latency_s) == (None, None, 0.0)


def write_png(path, array, vector=False):
    sitk.WriteImage(sitk.GetImageFromArray(array, isVector=vector), str(path))


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: (f / "poses.csv").unlink(), "poses.csv: expected this file"),
        (lambda f: (f / "poses.csv").write_text("time_s,x_mm\n1,2\n"), "without y_mm"),
        (lambda f: (f / "poses.csv").write_text(""), "CSV table"),
        (lambda f: (f / "frames.csv").write_text("file,time_s\n"), "0 rows"),
        (
            lambda f: (f / "frames.csv").write_text("file,time_s\nmasks/000000.png,soon\n"),
            "number in every row of time_s",
        ),
        (lambda f: (f / "frames.csv").write_text("file,time_s\n../x.png,1\n"), "image in the folder"),
        (lambda f: (f / "masks" / "000003.png").unlink(), "correct row 3"),
        (lambda f: (f / "masks" / "000003.png").write_bytes(b"no image"), "damaged"),
        (lambda f: write_png(f / "masks" / "000003.png", np.zeros((5, 5), np.uint8)), "13 x 11 pixels"),
        (lambda f: write_png(f / "masks" / "000003.png", np.zeros((11, 13, 3), np.uint8), True), "3 channels"),
        (
            lambda f: write_png(f / "masks" / "000003.png", np.arange(143, dtype=np.uint8).reshape(11, 13)),
            "000003.png: expected masks of 0 and one other value, got 143 grey levels",
        ),
        (lambda f: (f / "sweep.json").write_text("{"), "expected JSON"),
        (lambda f: (f / "sweep.json").write_text('{"pixel_spacing_mm": [0.0002, 0.0003]}'), "in metres"),
        (lambda f: (f / "sweep.json").write_text('{"pixel_spacing_mm": ["a", "b"]}'), "expected numbers"),
        (
            lambda f: (f / "sweep.json").write_text('{"T_probe_image": [[1,0,0,0], [0,1,0,0], [0,0,1,0], [4,5,6,1]]}'),
            "0 0 0 1 as T_probe_image's last row",
        ),
        (lambda f: (f / "sweep.json").write_text('{"latency_ms": 268}'), "check the names"),
        (lambda f: (f / "sweep.json").write_text('{"pixel_spacing_mm": 0.2}'), "expected numbers"),
        (
            lambda f: (f / "poses.csv").write_text("time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw\n1,0,0,0,0,0,0,0\n"),
            "unit quaternions",
        ),
    ],
)
def test_a_broken_folder_says_what_is_wrong(tmp_path, break_it, message):
    write_folder(tmp_path, make_sweep())
    break_it(tmp_path)
    with pytest.raises(StudyError, match=message):
        read_folder(tmp_path)
