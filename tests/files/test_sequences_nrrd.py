"""PLUS's NRRD sequences: read as SimpleITK reads them, written and read back, refused when damaged."""

import gzip

import numpy as np
import pytest
import SimpleITK as sitk
from plus_files import PIXELS, plus_nrrd
from tracked_sweeps import assert_identical, make_sweep

from study.errors import StudyError
from study.files.nrrd_arrays import read_nrrd_array
from study.files.plus import read_plus
from study.files.plus_write import write_plus


@pytest.mark.parametrize("encoding", ["raw", "gz", "gzip"])
def test_read_as_simpleitk_reads_it(tmp_path, encoding):
    data = PIXELS.tobytes() if encoding == "raw" else gzip.compress(PIXELS.tobytes())
    path = plus_nrrd(tmp_path / "a.nrrd", encoding=encoding, pixels=data)
    sweep = read_plus(path)
    image = sitk.ReadImage(str(path))  # which takes the list of frames for channels
    np.testing.assert_array_equal(sweep.images, np.moveaxis(sitk.GetArrayFromImage(image), -1, 0))
    told = image.GetMetaData("Seq_Frame0001_ProbeToTrackerTransform").split()
    np.testing.assert_array_equal(sweep.poses[1].ravel(), np.array(told, float))
    assert sweep.frame_times_s.tolist() == [10, 11]
    assert sweep.frame_fields[10.0]["FrameNumber"] == "700"


def test_what_simpleitk_makes_of_a_metafile_reads_the_same(tmp_path):
    """A stack with the fields as metadata, three domain axes and no list, as ITK's programs save it."""
    image = sitk.ReadImage(str(plus_nrrd(tmp_path / "a.nrrd")))
    stack = sitk.GetImageFromArray(np.moveaxis(sitk.GetArrayFromImage(image), -1, 0))
    for key in image.GetMetaDataKeys():
        if key.startswith(("Seq_", "ultrasound")):
            stack.SetMetaData(key, image.GetMetaData(key))
    for name in ("b.seq.nrrd", "b.nrrd"):
        sitk.WriteImage(stack, str(tmp_path / name), name == "b.nrrd")
        assert_identical(read_plus(tmp_path / name), _named(read_plus(tmp_path / "a.nrrd"), "b"))


def _named(sweep, name):
    object.__setattr__(sweep, "name", name)
    return sweep


@pytest.mark.parametrize(
    ("sizes", "kinds", "directions"),
    [
        ("3 2 1 2", "domain domain domain list", "(1,0,0) (0,1,0) (0,0,1) none"),
        ("3 2 1 2", "domain domain domain domain", "(1,0,0) (0,1,0) (0,0,1) none"),
        ("1 3 2 2", "vector domain domain list", "none (1,0) (0,1) none"),
    ],
)
def test_four_dimensional_headers(tmp_path, sizes, kinds, directions):
    path = plus_nrrd(tmp_path / "a.nrrd", dimension="4", sizes=sizes, kinds=kinds, space_directions=directions)
    np.testing.assert_array_equal(read_plus(path).images, PIXELS.reshape(2, 2, 3))


def test_frames_that_run_fastest(tmp_path):
    data = np.ascontiguousarray(PIXELS.reshape(2, 2, 3).transpose(1, 2, 0)).tobytes()
    path = plus_nrrd(tmp_path / "a.nrrd", sizes="2 3 2", kinds="list domain domain", pixels=data)
    np.testing.assert_array_equal(read_plus(path).images, PIXELS.reshape(2, 2, 3))


def test_rgb_frames(tmp_path):
    colours = np.random.default_rng(0).integers(0, 256, (2, 2, 3, 3)).astype(np.uint8)
    path = plus_nrrd(
        tmp_path / "a.nrrd",
        dimension="4",
        sizes="3 3 2 2",
        kinds="vector domain domain list",
        space_directions="none (1,0) (0,1) none",
        pixels=colours.tobytes(),
    )
    sweep = read_plus(path)
    np.testing.assert_array_equal(sweep.images, np.rint(colours @ [0.299, 0.587, 0.114]))
    assert "RGB" in sweep.notes[0]


@pytest.mark.parametrize("name", ["s.nrrd", "s.seq.nrrd", "s.igs.nrrd"])
@pytest.mark.parametrize("compress", [True, False])
def test_a_written_sweep_reads_back_identical(tmp_path, name, compress):
    sweep = make_sweep()
    write_plus(tmp_path / name, sweep, compress=compress)
    assert_identical(read_plus(tmp_path / name), sweep)
    image = sitk.ReadImage(str(tmp_path / name))
    np.testing.assert_array_equal(np.moveaxis(sitk.GetArrayFromImage(image), -1, 0), sweep.masks * 255)
    assert image.GetMetaData("Seq_Frame0000_Status") == "OK"


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.int16, np.float32])
def test_every_kind_of_pixel(tmp_path, dtype):
    images = np.random.default_rng(0).integers(0, 99, (9, 11, 13)).astype(dtype)
    write_plus(tmp_path / "a.nrrd", make_sweep(masks=None, images=images))
    back = read_plus(tmp_path / "a.nrrd").images
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, images)


@pytest.mark.parametrize("ending", [".igs.mha", ".nrrd"])
def test_other_tools_are_kept_on_writing(tmp_path, ending):
    reference = "0 -1 0 0 1 0 0 5 0 0 1 0 0 0 0 1"
    pairs = [(f"Seq_Frame{i:04d}_ReferenceToTrackerTransform", reference) for i in range(2)]
    first = plus_nrrd(tmp_path / "a.nrrd", pairs=pairs)
    sweep = read_plus(first)
    assert sweep.frame_names == ("Probe", "Reference")
    write_plus(tmp_path / f"b{ending}", sweep)
    before, after = (sitk.ReadImage(str(path)) for path in (first, tmp_path / f"b{ending}"))
    kept = [key for key in before.GetMetaDataKeys() if key.startswith("Seq_") and not key.endswith("_Status")]
    assert len(kept) == 12
    for key in kept:
        same = before.GetMetaData(key) == after.GetMetaData(key)
        numbers = [np.array(image.GetMetaData(key).split()[-16:]) for image in (before, after)]
        assert same or np.allclose(*(one.astype(float) for one in numbers), atol=1e-12), key
    assert_identical(read_plus(tmp_path / f"b{ending}"), _named(sweep, "a"))
    with pytest.raises(StudyError, match="leave base out"):
        read_plus(tmp_path / f"b{ending}", base="Tracker")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixels": bytes(5)}, "truncated"),
        ({"pixels": bytes(13)}, "left over"),
        ({"encoding": "gzip", "pixels": gzip.compress(bytes(12))[:-4]}, "truncated"),
        ({"encoding": "gzip", "pixels": gzip.compress(bytes(12))[:-6] + bytes(6)}, "damaged"),
        ({"encoding": "gzip", "sizes": "99999 99999 2", "pixels": gzip.compress(bytes(12))}, "cannot hold"),
        ({"encoding": "text"}, "encoding raw"),
        ({"type": "block"}, "a type such as"),
        ({"type": "uint16", "drop": ("endian",)}, "little or big"),
        ({"sizes": "3 2"}, "as many 'sizes'"),
        ({"sizes": "3 -2 2"}, "as many 'sizes'"),
        ({"kinds": "domain list"}, "a kind for each of 3 axes"),
        ({"kinds": "list domain list"}, "columns, rows and frames"),
        ({"pairs": [("Seq_Frame0002_Timestamp", "3")]}, "mis-sized"),
        ({"drop": ("Seq_Frame0001_Timestamp",)}, "frame 1: expected a field Timestamp"),
        ({"pairs": [("ultrasound image orientation", "XX")]}, "like MF or UN"),
        ({"pairs": [(f"Seq_Frame{i:04d}_Status", "INVALID") for i in range(2)]}, "at least one valid frame"),
    ],
)
def test_damaged_files_say_what_is_wrong(tmp_path, changes, message):
    with pytest.raises(StudyError, match=message) as caught:
        read_plus(plus_nrrd(tmp_path / "bad.nrrd", **changes))
    assert "\n" not in str(caught.value)


def test_a_header_cut_anywhere_is_refused(tmp_path):
    whole = plus_nrrd(tmp_path / "a.nrrd").read_bytes()
    for cut in range(1, len(whole), 37):
        (tmp_path / "b.nrrd").write_bytes(whole[:cut])
        with pytest.raises(StudyError):
            read_plus(tmp_path / "b.nrrd")
    for content in (b"", b"NRRD0009\n", whole.replace(b"type: uint8", b"type: uint8\ntype: int8")):
        (tmp_path / "b.nrrd").write_bytes(content)
        with pytest.raises(StudyError):
            read_plus(tmp_path / "b.nrrd")


def test_pairs_do_not_pass_for_fields(tmp_path):
    found = read_nrrd_array(plus_nrrd(tmp_path / "a.nrrd", pairs=[("Kinds", "domain domain domain")]))
    assert found.kinds == ("domain", "domain", "list")
    assert found.fields["Kinds"] == "domain domain domain"
