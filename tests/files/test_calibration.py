"""A calibration comes back to the last bit, serves a recording, and is refused when someone altered it."""

import json

import numpy as np
import pytest
from plus_files import plus_nrrd
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.files.calibration import read_calibration, write_calibration
from study.files.plus import read_plus
from study.ultrasound import calibrate_latency, calibrate_spatial, simulate_calibration_views, simulate_latency_run


@pytest.fixture(scope="module")
def fitted():
    rng = np.random.default_rng(3)
    return (
        calibrate_spatial(*simulate_calibration_views(rng)),
        calibrate_latency(*simulate_latency_run(0.268, rng)),
    )


def test_what_was_fitted_comes_back(tmp_path, fitted):
    spatial, temporal = fitted
    back = read_calibration(write_calibration(tmp_path / "c.json", spatial, temporal))
    assert back.temporal == temporal
    np.testing.assert_array_equal(back.spatial.T_probe_image.matrix, spatial.T_probe_image.matrix)
    np.testing.assert_array_equal(back.spatial.point, spatial.point)
    for key in ("pixel_spacing_mm", "residual_mm", "sd_mm", "sd_deg"):
        assert getattr(back.spatial, key) == getattr(spatial, key)
    # As another program reads it: units and frames are said, and the rotation is one.
    content = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))
    assert content["units"]["length"] == "mm"
    assert content["spatial"]["residual_mm"] < 0.3
    matrix = np.array(content["spatial"]["T_probe_image"])
    assert Rotation.from_matrix(matrix[:3, :3], assume_valid=False).magnitude() >= 0


def test_either_alone_and_wires(tmp_path, fitted):
    spatial, temporal = fitted
    object.__setattr__(wires := type(spatial)(**vars(spatial)), "point", np.full(3, np.nan))
    assert np.isnan(read_calibration(write_calibration(tmp_path / "w.json", wires)).spatial.point).all()
    assert read_calibration(write_calibration(tmp_path / "t.json", temporal=temporal)).spatial is None
    with pytest.raises(StudyError, match="got neither"):
        write_calibration(tmp_path / "n.json")
    with pytest.raises(StudyError, match=r"ends in \.json"):
        write_calibration(tmp_path / "n.xml", spatial)


def test_it_serves_a_recording(tmp_path, fitted):
    spatial, temporal = fitted
    path = plus_nrrd(tmp_path / "a.nrrd")
    sweep = read_plus(path, config=write_calibration(tmp_path / "c.json", spatial, temporal))
    np.testing.assert_array_equal(sweep.T_probe_image.matrix, spatial.T_probe_image.matrix)
    assert (sweep.pixel_spacing_mm, sweep.latency_s) == (spatial.pixel_spacing_mm, temporal.latency_s)
    assert [note.split(",")[0] for note in sweep.notes[1:]] == ["calibration of c.json", "latency of c.json"]
    late = read_plus(path, config=write_calibration(tmp_path / "t.json", temporal=temporal))
    assert (late.T_probe_image, late.latency_s) == (None, temporal.latency_s)


def _entry(part, key, value):
    def change(content):
        content[part][key] = value

    return change


def _scaled(content):
    content["spatial"]["T_probe_image"][0][0] *= 1.1


def _mirrored(content):
    for row in content["spatial"]["T_probe_image"][:3]:
        row[0] *= -1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_entry("units", "length", "m"), "expected units"),
        (_entry("units", "time", "ms"), "expected units"),
        (_entry("frames", "image", "pixels"), "expected frames"),
        (lambda content: content.update(format="study calibration 2"), "expected the format"),
        (lambda content: content.pop("units"), "expected units"),
        (lambda content: [content.pop("spatial"), content.pop("temporal")], "'spatial' or 'temporal'"),
        (_entry("spatial", "sd_mm", float("nan")), "finite number"),
        (_entry("spatial", "residual_mm", None), "finite number"),
        (_entry("spatial", "pixel_spacing_mm", [0.0002, 0.0002]), "metres"),
        (_entry("spatial", "pixel_spacing_mm", 0.2), "two pixel_spacing_mm"),
        (_entry("spatial", "point", [1, 2]), "three numbers or null"),
        (_entry("spatial", "T_probe_image", [[1, 0], [0, 1]]), "4 rows of 4"),
        (_entry("spatial", "T_probe_image", np.full((4, 4), np.nan).tolist()), "finite numbers"),
        (_entry("spatial", "note", "x"), "expected spatial with"),
        (_scaled, "rigid"),
        (_mirrored, "rigid"),
        (_entry("temporal", "latency_s", 268), "milliseconds"),
        (_entry("temporal", "latency_s", float("inf")), "finite number"),
        (_entry("temporal", "correlation", 1.2), "0 to 1"),
        (_entry("temporal", "n_frames", True), "finite number"),
    ],
)
def test_altered_files_are_refused(tmp_path, fitted, change, message):
    path = write_calibration(tmp_path / "c.json", *fitted)
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content)
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(StudyError, match=message) as caught:
        read_calibration(path)
    assert "\n" not in str(caught.value)


def test_no_calibration_at_all(tmp_path):
    with pytest.raises(StudyError, match="no file at"):
        read_calibration(tmp_path / "c.json")
    for content in (b"", b"[]", b"\xff\xfe", b"{}"):
        (tmp_path / "c.json").write_bytes(content)
        with pytest.raises(StudyError):
            read_calibration(tmp_path / "c.json")
