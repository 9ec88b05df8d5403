"""The configuration that PLUS leaves beside a recording gives the calibration, and nothing else gets in by it."""

import numpy as np
import pytest
import SimpleITK as sitk
from plus_files import plus_nrrd

from study.errors import StudyError
from study.files.plus import read_plus

MATRIX = "0 -0.3 0 4  0.2 0 0 5  0 0 0.2 6  0 0 0 1"
OTHER = '<Transform From="StylusTip" To="Stylus" Matrix="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/>'


def config(path, matrix=MATRIX, *, head="", transforms=None):
    inside = f'<Transform From="Image" To="Probe" Matrix="\n{matrix}\n" Error="0.6" Date="x"/>'
    path.write_text(
        f'<?xml version="1.0"?>{head}<PlusConfiguration version="2.1"><CoordinateDefinitions>{OTHER}'
        f"{inside if transforms is None else transforms}</CoordinateDefinitions></PlusConfiguration>",
        encoding="utf-8",
    )
    return path


@pytest.mark.parametrize("name", ["a_config.xml", "a.igs_config.xml"])
def test_the_file_beside_the_recording_is_used_and_said(tmp_path, name):
    path = plus_nrrd(tmp_path / "a.igs.nrrd")
    assert read_plus(path).T_probe_image is None
    config(tmp_path / name)
    sweep = read_plus(path)
    np.testing.assert_allclose(sweep.pixel_spacing_mm, (0.2, 0.3))
    np.testing.assert_allclose(sweep.T_probe_image.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(sweep.T_probe_image.translation, [4, 5, 6])
    assert f"calibration of {name}, beside the recording" in sweep.notes
    # The same place by ITK: pixel (3, 5) through the matrix of the file.
    affine = sitk.AffineTransform(3)
    affine.SetMatrix([0, -0.3, 0, 0.2, 0, 0, 0, 0, 0.2])
    affine.SetTranslation([4, 5, 6])
    np.testing.assert_allclose(
        affine.TransformPoint((3.0, 5.0, 0.0)), sweep.T_probe_image.apply([[3 * 0.2, 5 * 0.3, 0]])[0], atol=1e-12
    )


def test_the_one_asked_for_wins_and_two_that_differ_are_refused(tmp_path):
    key = "Seq_Frame0000_ImageToProbeTransform"
    path = plus_nrrd(tmp_path / "a.nrrd", pairs=[(key, "0.1 0 0 0 0 0.1 0 0 0 0 0.1 0 0 0 0 1")])
    assert read_plus(path).pixel_spacing_mm == (0.1, 0.1)
    other = config(tmp_path / "other.xml")
    assert read_plus(path, config=other).T_probe_image.translation.tolist() == [4, 5, 6]
    config(tmp_path / "a_config.xml")
    with pytest.raises(StudyError, match=r"got its own and that of a_config\.xml, .* mm apart"):
        read_plus(path)
    assert "calibration of other.xml, as asked" in read_plus(path, config=other).notes
    config(tmp_path / "a_config.xml", "0.1 0 0 0 0 0.1 0 0 0 0 0.1 0 0 0 0 1")
    assert read_plus(path).pixel_spacing_mm == (0.1, 0.1)


def test_the_identity_is_no_calibration(tmp_path):
    path = plus_nrrd(tmp_path / "a.nrrd")
    config(tmp_path / "a_config.xml", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1")
    sweep = read_plus(path)
    assert (sweep.T_probe_image, sweep.pixel_spacing_mm) == (None, None)
    assert any("identity, as before a calibration: not used" in note for note in sweep.notes)
    with pytest.raises(StudyError, match="none but the identity"):
        read_plus(path, config=tmp_path / "a_config.xml")


ENTITY = '<!DOCTYPE x [<!ENTITY a "0.2">]>'


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"head": ENTITY}, "without a document type"),
        ({"head": '<!DOCTYPE x SYSTEM "file:///etc/hostname">'}, "without a document type"),
        ({"matrix": "1 2 3"}, "16 numbers"),
        ({"matrix": MATRIX.replace("4", "nan")}, "finite"),
        ({"matrix": "1 0 0 0 0 1 0 0 0 0 1 0 4 5 6 1"}, "0 0 0 1 as the last row"),
        ({"matrix": "1 1 0 0 0 0.1 0 0 0 0 1 0 0 0 0 1"}, "square axes"),
        ({"matrix": "0.0002 0 0 0 0 0.0002 0 0 0 0 1 0 0 0 0 1"}, "in metres"),
        ({"transforms": "<Transform"}, "expected XML"),
        (
            {"transforms": f'<Transform From="Image" To="Probe" Matrix="{MATRIX}"/>'
             f'<Transform From="Image" To="Probe" Matrix="{MATRIX.replace("5", "9")}"/>'},
            "2 that differ",
        ),
    ],
)  # fmt: skip
def test_faulty_configurations_are_refused(tmp_path, changes, message):
    config(tmp_path / "a_config.xml", **changes)
    with pytest.raises(StudyError, match=message) as caught:
        read_plus(plus_nrrd(tmp_path / "a.nrrd"))
    assert "\n" not in str(caught.value)


def test_what_is_no_configuration(tmp_path):
    path = plus_nrrd(tmp_path / "a.nrrd")
    with pytest.raises(StudyError, match="nothing at"):
        read_plus(path, config=tmp_path / "none.xml")
    (tmp_path / "b.xml").write_text("<html/>", encoding="utf-8")
    with pytest.raises(StudyError, match="PlusConfiguration"):
        read_plus(path, config=tmp_path / "b.xml")
    with pytest.raises(StudyError, match="Image to Probe"):
        read_plus(path, config=config(tmp_path / "c.xml", transforms=""))
    for name in ("a_config.xml", "a.igs_config.xml"):
        config(tmp_path / name)
    with pytest.raises(StudyError, match="one configuration beside it"):
        read_plus(plus_nrrd(tmp_path / "a.igs.nrrd"))
