"""Metafiles of this and other programs are read, and damaged ones say what is wrong."""

import dataclasses
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from tracked_sweeps import assert_identical, make_sweep

from study.errors import StudyError
from study.files.plus import read_plus
from study.files.plus_write import write_plus
from study.types import RigidTransform

REAL = Path(__file__).parents[3] / "shared" / "data" / "plus" / "BoneUltrasound_L14.igs.mha"


def foreign(path: Path, *, pixels=None, drop=(), **changes) -> Path:
    """A small PLUS file as another program writes it: two 3 x 2 frames."""
    fields = {
        "ObjectType": "Image",
        "NDims": "3",
        "CompressedData": "False",
        "DimSize": "3 2 2",
        "ElementNumberOfChannels": "1",
        "ElementType": "MET_UCHAR",
        "UltrasoundImageOrientation": "MF",
        "UltrasoundImageType": "BRIGHTNESS",
    }
    for i in range(2):
        fields |= {
            f"Seq_Frame{i:04d}_ProbeToTrackerTransform": f"1 0 0 {i} 0 1 0 0 0 0 1 7 0 0 0 1",
            f"Seq_Frame{i:04d}_ProbeToTrackerTransformStatus": "OK",
            f"Seq_Frame{i:04d}_ReferenceToTrackerTransform": "0 -1 0 0 1 0 0 5 0 0 1 0 0 0 0 1",
            f"Seq_Frame{i:04d}_ReferenceToTrackerTransformStatus": "OK",
            f"Seq_Frame{i:04d}_Timestamp": f"{10 + i}",
            f"Seq_Frame{i:04d}_ImageStatus": "OK",
        }
    fields |= changes
    lines = [f"{key} = {value}" for key, value in fields.items() if key not in drop and value is not None]
    data = bytes(range(12)) if pixels is None else pixels
    path.write_bytes("\n".join([*lines, "ElementDataFile = LOCAL\n"]).encode() + data)
    return path


@pytest.mark.parametrize(
    ("orientation", "expected"),
    [
        ("MF", [[0, 1, 2], [3, 4, 5]]),
        ("UF", [[2, 1, 0], [5, 4, 3]]),
        ("MN", [[3, 4, 5], [0, 1, 2]]),
        ("UNA", [[5, 4, 3], [2, 1, 0]]),
        ("FM", [[0, 3], [1, 4], [2, 5]]),
        ("NU", [[5, 2], [4, 1], [3, 0]]),
    ],
)
def test_images_are_turned_to_mf(tmp_path, orientation, expected):
    sweep = read_plus(foreign(tmp_path / "a.igs.mha", UltrasoundImageOrientation=orientation))
    np.testing.assert_array_equal(sweep.images[0], expected)


def test_foreign_poses_bases_and_calibration(tmp_path):
    calibrated = {f"Seq_Frame{i:04d}_ImageToProbeTransform": "0 -0.3 0 4 0.2 0 0 5 0 0 0.2 6 0 0 0 1" for i in range(2)}
    path = foreign(tmp_path / "a.igs.mha", **calibrated, Seq_Frame0001_ProbeToTrackerTransformStatus="INVALID")
    sweep = read_plus(path, base="Tracker")
    np.testing.assert_array_equal(sweep.poses[0, :3, 3], [0, 0, 7])
    assert list(sweep.pose_valid) == [True, False]
    assert sweep.latency_s == 0
    np.testing.assert_allclose(sweep.pixel_spacing_mm, (0.2, 0.3))
    np.testing.assert_allclose(sweep.T_probe_image.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(sweep.T_probe_image.translation, [4, 5, 6])
    # In the reference's frame: inv([[0,-1,0],[1,0,0],[0,0,1]], t = (0,5,0)) applied to (0, 0, 7).
    np.testing.assert_allclose(read_plus(path, base="Reference").poses[0, :3, 3], [-5, 0, 7], atol=1e-12)
    assert read_plus(path).frame_names == ("Probe", "Reference")
    np.testing.assert_array_equal(read_plus(path).poses, read_plus(path, base="Reference").poses)
    own = read_plus(path, pixel_spacing_mm=(1, 1), T_probe_image=RigidTransform(), latency_s=0.1)
    assert (own.pixel_spacing_mm, own.latency_s) == ((1, 1), 0.1)


def test_a_frame_without_an_image_keeps_its_pose(tmp_path):
    sweep = read_plus(foreign(tmp_path / "a.igs.mha", Seq_Frame0000_ImageStatus="INVALID"))
    assert sweep.n_frames == 1
    assert len(sweep.poses) == 2
    np.testing.assert_array_equal(sweep.images[0], [[6, 7, 8], [9, 10, 11]])


def test_big_endian_pixels(tmp_path):
    data = np.arange(12, dtype=">i2").tobytes()
    path = foreign(tmp_path / "a.igs.mha", pixels=data, ElementType="MET_SHORT", BinaryDataByteOrderMSB="True")
    np.testing.assert_array_equal(read_plus(path).images.ravel(), np.arange(12))


ZIPPED = {"CompressedData": "True"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixels": bytes(5)}, "truncated"),
        ({"pixels": bytes(13)}, "DimSize wrong"),
        ({"DimSize": "3 2"}, "columns, rows and frames"),
        ({"DimSize": "3 2 -2"}, "columns, rows and frames"),
        ({"DimSize": "3 2 1", "pixels": bytes(6)}, "mis-sized"),
        ({"drop": ("DimSize",)}, "columns, rows and frames"),
        ({"ElementType": "MET_DOUBLE"}, "ElementType"),
        ({"ElementNumberOfChannels": "5"}, "one channel"),
        ({"ElementNumberOfChannels": "3"}, "expected 36 bytes"),
        ({"NDims": "4"}, "NDims 4"),
        ({"DimSize": "3 1 2 2", "NDims": "4"}, "columns, rows and frames"),
        ({"UltrasoundImageOrientation": "XX"}, "UltrasoundImageOrientation"),
        ({"drop": ("ObjectType",)}, "ObjectType first"),
        ({"drop": ("Seq_Frame0001_Timestamp",)}, "frame 1: expected a field Timestamp"),
        ({"Seq_Frame0001_Timestamp": "soon"}, "1 numbers as Timestamp"),
        ({"Seq_Frame0001_Timestamp": "9"}, "rising"),
        ({"Seq_Frame0001_ProbeToTrackerTransform": "1 0 0"}, "frame 1: expected 16 numbers"),
        ({"Seq_Frame0001_ProbeToTrackerTransform": "2 " * 16}, "proper rotations"),
        (
            {f"Seq_Frame{i:04d}_ProbeToTrackerTransform": None for i in range(2)},
            "pose ProbeToTrackerTransform per frame, got ReferenceToTrackerTransform",
        ),
        ({f"Seq_Frame{i:04d}_ProbeToTrackerTransformStatus": "INVALID" for i in range(2)}, "valid poses"),
        ({"Seq_Frame0000_ImageToProbeTransform": "1 1 0 0 0 0.1 0 0 0 0 1 0 0 0 0 1"}, "square axes"),
        ({**ZIPPED, "CompressedDataSize": "99", "pixels": zlib.compress(bytes(12))}, "99 compressed bytes"),
        ({**ZIPPED, "pixels": zlib.compress(bytes(12))[:-8]}, "truncated|damaged"),
        ({**ZIPPED, "pixels": b"not deflated"}, "damaged"),
        ({**ZIPPED, "pixels": zlib.compress(bytes(11))}, "DimSize"),
        ({**ZIPPED, "pixels": zlib.compress(bytes(13))}, "got more"),
        ({**ZIPPED, "DimSize": "99999 99999 2", "pixels": zlib.compress(bytes(12))}, "cannot hold"),
    ],
)
def test_damaged_files_say_what_is_wrong(tmp_path, changes, message):
    with pytest.raises(StudyError, match=message) as caught:
        read_plus(foreign(tmp_path / "bad.igs.mha", **changes))
    assert len(str(caught.value)) < 400


TRANSPOSED = "1 0 0 0 0 1 0 0 0 0 1 0 4 5 6 1"
METRES = "0.0002 0 0 0.004 0 0.0003 0 0.005 0 0 0.0002 0.006 0 0 0 1"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Seq_Frame0001_ProbeToTrackerTransform": TRANSPOSED}, "frame 1: expected 0 0 0 1 as the last row"),
        ({"Seq_Frame0000_ImageToProbeTransform": TRANSPOSED}, "0 0 0 1 as the last row of ImageToProbeTransform"),
        ({"Seq_Frame0000_ImageToProbeTransform": METRES}, "in metres"),
        ({f"Seq_Frame{i:04d}_ImageStatus": "INVALID" for i in range(2)}, "at least one valid frame, got none of 2"),
        ({"DimSize": "3 2 2\nDimSize = 2 3 2"}, "one value of DimSize"),
        ({**ZIPPED, "pixels": zlib.compress(bytes(12))[:-1]}, "truncated|damaged"),
        ({**ZIPPED, "pixels": zlib.compress(bytes(12)) + b"x"}, "bytes behind it"),
        ({**ZIPPED, "pixels": zlib.compress(bytes(12))[:-1] + b"x"}, "damaged"),
    ],
)
def test_faults_that_read_well_are_refused(tmp_path, changes, message):
    with pytest.raises(StudyError, match=message):
        read_plus(foreign(tmp_path / "bad.igs.mha", **changes))


def test_transposed_poses_of_our_own_files_are_refused(tmp_path):
    write_plus(tmp_path / "a.igs.mha", make_sweep())
    whole = (tmp_path / "a.igs.mha").read_bytes()
    for key, told in (
        (b"Study_Pose000003", "every Study_Pose"),
        (b"Study_ProbeImageTransform", "last row of Study_Probe"),
    ):
        line = next(line for line in whole.split(b"\n") if line.startswith(key))
        (tmp_path / "b.igs.mha").write_bytes(whole.replace(line, line[: line.rindex(b" ")] + b" 2.0"))
        with pytest.raises(StudyError, match=told):
            read_plus(tmp_path / "b.igs.mha")


MASK = bytes([0, 0, 255, 0, 0, 0, 255, 0, 0, 0, 0, 0])  # asymmetric: the last column, then the first
STAMPS = [f"Seq_Frame{i:04d}_Timestamp" for i in range(2)]


@pytest.mark.parametrize("orientation", ["MF", "UF", "MN", "UN"])
def test_masks_without_an_orientation_lie_as_the_images_do(tmp_path, orientation):
    images = foreign(tmp_path / "a.igs.mha", pixels=MASK, UltrasoundImageOrientation=orientation)
    # As a program that knows nothing of ultrasound writes it.
    stack = np.frombuffer(MASK, np.uint8).reshape(2, 2, 3)
    sitk.WriteImage(sitk.GetImageFromArray(stack), str(tmp_path / "m.mha"), useCompression=True)
    sweep = read_plus(images, masks=tmp_path / "m.mha")
    np.testing.assert_array_equal(sweep.masks, sweep.images > 0)
    stated = foreign(tmp_path / "s.mha", pixels=MASK, UltrasoundImageOrientation="MF")
    np.testing.assert_array_equal(read_plus(images, masks=stated).masks, stack > 0)


def test_masks_must_be_masks_of_the_same_recording(tmp_path):
    images = foreign(tmp_path / "a.igs.mha")
    with pytest.raises(StudyError, match="got 12 grey levels; is this the B-mode"):
        read_plus(images, masks=images)
    late = {stamp: f"{10.05 + i}" for i, stamp in enumerate(STAMPS)}
    with pytest.raises(StudyError, match=r"m\.mha: frame 0: expected the time stamp of a\.igs.*another recording"):
        read_plus(images, masks=foreign(tmp_path / "m.mha", pixels=MASK, **late))
    with pytest.raises(StudyError, match="size of the images"):
        read_plus(images, masks=foreign(tmp_path / "m.mha", pixels=MASK, DimSize="2 3 2"))
    with pytest.raises(StudyError, match="says it holds images"):
        read_plus(images, masks=foreign(tmp_path / "m.mha", pixels=MASK, Study_Content="images"))
    with pytest.raises(StudyError, match="grey levels"):
        read_plus(foreign(tmp_path / "own.igs.mha", Study_Content="masks"))
    for kept in (foreign(tmp_path / "m.mha", pixels=MASK), foreign(tmp_path / "n.mha", pixels=MASK, drop=STAMPS)):
        assert read_plus(images, masks=kept).masks.sum() == 2


def test_a_bomb_is_not_inflated(tmp_path):
    path = foreign(tmp_path / "bomb.igs.mha", **ZIPPED, pixels=zlib.compress(bytes(100_000_000), 9))
    tracemalloc.start()
    with pytest.raises(StudyError, match="got more"):
        read_plus(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5_000_000


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "a.igs.mha"
    with pytest.raises(StudyError, match="nothing at"):
        read_plus(path)
    for content in (b"", b"\x89PNG\r\n\x1a\n" * 99, b"x" * 200_000, b"ObjectType = Image\nNDims = 3\n"):
        path.write_bytes(content)
        with pytest.raises(StudyError, match="truncated or not a PLUS"):
            read_plus(path)
    write_plus(path, make_sweep())
    whole = path.read_bytes()
    for cut in np.linspace(1, len(whole) - 1, 25).astype(int):
        path.write_bytes(whole[:cut])
        with pytest.raises(StudyError):
            read_plus(path)


def test_the_real_plus_file():
    if not REAL.exists():
        pytest.skip(f"no PLUS example at {REAL}: it is not part of the repository (PlusLibData, BSD-3)")
    sweep = read_plus(REAL, base="Tracker")
    assert sweep.images.shape == (21, 616, 820)
    assert sweep.images.dtype == np.uint8
    np.testing.assert_array_equal(sweep.images, sitk.GetArrayFromImage(sitk.ReadImage(str(REAL))))
    assert sweep.pose_valid.all()
    assert len(sweep.poses) == 21
    np.testing.assert_array_equal(sweep.poses[0, 0], [0.853646, -0.501315, 0.141319, 257.956])
    assert sweep.frame_times_s[0] == 232.542071
    assert sweep.frame_poses()[2].all()
    assert sweep.masks is None
    # The same in the frame of the reference that was fixed to the patient.
    T_tracker_reference = np.array(
        [
            [-0.61495, 0.0616122, -0.786156, 307.759],
            [-0.148385, -0.988175, 0.0386253, -88.1807],
            [-0.77448, 0.140406, 0.61682, -54.9176],
            [0, 0, 0, 1],
        ]
    )
    in_reference = read_plus(REAL)
    np.testing.assert_allclose(T_tracker_reference @ in_reference.poses[0], sweep.poses[0])
    assert "base frame Reference" in in_reference.notes[0]
    with pytest.raises(StudyError, match="got ProbeToTrackerTransform, ReferenceToTracker"):
        read_plus(REAL, probe="Needle")


def test_the_real_file_written_reads_back(tmp_path):
    if not REAL.exists():
        pytest.skip(f"no PLUS example at {REAL}: it is not part of the repository (PlusLibData, BSD-3)")
    sweep = read_plus(REAL)
    short = dataclasses.replace(sweep, frame_times_s=sweep.frame_times_s[:3], images=sweep.images[:3])
    write_plus(tmp_path / "b.igs.mha", short)
    assert_identical(read_plus(tmp_path / "b.igs.mha"), short)


def test_the_choice_of_base_is_said(tmp_path):
    path = foreign(tmp_path / "a.igs.mha")
    np.testing.assert_allclose(read_plus(path).poses[0, :3, 3], [-5, 0, 7], atol=1e-12)
    assert read_plus(path).notes == (
        "base frame Reference, which moves with the patient: ReferenceToTrackerTransform is in the file",
    )
    lost = {f"Seq_Frame{i:04d}_ReferenceToTrackerTransformStatus": "INVALID" for i in range(2)}
    unseen = read_plus(foreign(tmp_path / "b.igs.mha", **lost))
    assert unseen.frame_names == ("Probe", "Tracker")
    assert "not valid in any frame" in unseen.notes[0]
    without = read_plus(
        foreign(tmp_path / "c.igs.mha", drop=[f"Seq_Frame{i:04d}_ReferenceToTrackerTransform" for i in range(2)])
    )
    assert without.notes == ("base frame Tracker: no ReferenceToTrackerTransform is in the file",)
    apart = {
        "Seq_Frame0000_ReferenceToTrackerTransformStatus": "INVALID",
        "Seq_Frame0001_ProbeToTrackerTransformStatus": "INVALID",
    }
    with pytest.raises(StudyError, match="see Probe and Reference at once, got none of 2"):
        read_plus(foreign(tmp_path / "d.igs.mha", **apart))


def test_a_slice_axis_of_one_and_rgb_frames(tmp_path):
    np.testing.assert_array_equal(
        read_plus(foreign(tmp_path / "a.mha", NDims="4", DimSize="3 2 1 2")).images.ravel(), np.arange(12)
    )
    grey = np.repeat(np.arange(12, dtype=np.uint8), 3)
    sweep = read_plus(foreign(tmp_path / "b.mha", ElementNumberOfChannels="3", pixels=grey.tobytes()))
    np.testing.assert_array_equal(sweep.images.ravel(), np.arange(12))
    assert "RGB frames were turned to grey (luma of BT.601); 0.0 % of their pixels had a colour" in sweep.notes
    coloured = grey.reshape(12, 3).copy()
    coloured[:6] = [200, 0, 0]
    sweep = read_plus(foreign(tmp_path / "c.mha", ElementNumberOfChannels="3", pixels=coloured.tobytes()))
    assert (sweep.images[0] == 60).all()
    assert "50.0 % of their pixels had a colour" in sweep.notes[0]


def test_pixels_beside_the_header(tmp_path):
    whole = foreign(tmp_path / "a.mha").read_bytes()
    head, _, data = whole.partition(b"ElementDataFile = LOCAL\n")
    (tmp_path / "a.mhd").write_bytes(head + b"ElementDataFile = a.raw\n")
    with pytest.raises(StudyError, match="beside the header"):
        read_plus(tmp_path / "a.mhd")
    (tmp_path / "a.raw").write_bytes(data)
    np.testing.assert_array_equal(read_plus(tmp_path / "a.mhd").images.ravel(), np.arange(12))
