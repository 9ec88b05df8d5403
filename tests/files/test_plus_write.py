"""A written metafile comes back as it was, and other programs read it too."""

import numpy as np
import pytest
import SimpleITK as sitk
from tracked_sweeps import assert_identical, make_sweep

from study.errors import StudyError
from study.files.plus import read_plus
from study.files.plus_write import write_plus


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"pixel_spacing_mm": None, "T_probe_image": None, "latency_s": 0.0},
        {"masks": None, "images": np.random.default_rng(0).integers(0, 256, (9, 11, 13)).astype(np.uint8)},
        {"masks": None, "images": np.random.default_rng(0).integers(-9999, 9999, (9, 11, 13)).astype(np.int16)},
        {"masks": np.zeros((9, 200, 300), bool)},
    ],
)
def test_a_written_sweep_reads_back_identical(tmp_path, changes, compress):
    sweep = make_sweep(**changes)
    path = tmp_path / "sweep.igs.mha"
    write_plus(path, sweep, compress=compress)
    assert_identical(read_plus(path), sweep)
    assert [file.name for file in tmp_path.iterdir()] == ["sweep.igs.mha"]


def test_bmode_with_masks_is_two_files(tmp_path):
    sweep = make_sweep(images=np.random.default_rng(0).integers(0, 256, (9, 11, 13)).astype(np.uint8))
    with pytest.raises(StudyError, match="two files"):
        write_plus(tmp_path / "s.seq.mha", sweep)
    write_plus(tmp_path / "s.seq.mha", sweep, content="images")
    write_plus(tmp_path / "m.seq.mha", sweep, content="masks")
    assert_identical(read_plus(tmp_path / "s.seq.mha", masks=tmp_path / "m.seq.mha"), sweep)
    write_plus(tmp_path / "m.seq.mha", make_sweep(masks=np.ones((9, 5, 5), bool)), content="masks")
    with pytest.raises(StudyError, match="size of the images"):
        read_plus(tmp_path / "s.seq.mha", masks=tmp_path / "m.seq.mha")


@pytest.mark.parametrize("compress", [True, False])
def test_other_programs_read_the_same_pixels_and_fields(tmp_path, compress):
    sweep = make_sweep()
    path = tmp_path / "sweep.seq.mha"
    write_plus(path, sweep, compress=compress)
    image = sitk.ReadImage(str(path))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image), sweep.masks * 255)
    # In the header, as in PLUS files: the image in pixels to the probe, the probe at the time the frame shows.
    header = path.read_bytes().split(b"ElementDataFile")[0].decode()
    fields = dict(line.split(" = ") for line in header.splitlines())
    assert max(map(len, header.splitlines())) < 1000  # the readers of PLUS and Slicer keep no more of a line
    pose = np.array(fields["Seq_Frame0000_ProbeToTrackerTransform"].split(), float).reshape(4, 4)
    np.testing.assert_array_equal(pose, sweep.frame_poses()[0][0])
    scaled = np.array(fields["Seq_Frame0000_ImageToProbeTransform"].split(), float).reshape(4, 4)
    pixel, mm = np.array([3, 5, 0, 1]), np.array([[3 * 0.2, 5 * sweep.pixel_spacing_mm[1], 0]])
    np.testing.assert_allclose((scaled @ pixel)[:3], sweep.T_probe_image.apply(mm)[0])
    lost = [fields[f"Seq_Frame{i:04d}_ProbeToTrackerTransformStatus"] for i in range(9)]
    assert lost == ["OK" if tracked else "INVALID" for tracked in sweep.frame_poses()[2]]


def test_what_a_metafile_cannot_hold_is_refused(tmp_path):
    path = tmp_path / "a.igs.mha"
    with pytest.raises(StudyError, match="ending in"):
        write_plus(tmp_path / "a.mha", make_sweep())
    with pytest.raises(StudyError, match="convert"):
        write_plus(path, make_sweep(masks=None, images=np.zeros((9, 2, 2))))
    with pytest.raises(StudyError, match="images in the sweep, got none"):
        write_plus(path, make_sweep(), content="images")
    assert not list(tmp_path.iterdir())
