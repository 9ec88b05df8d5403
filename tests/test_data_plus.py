"""Sweeps on disk: what is written comes back, and damaged files say what is wrong."""

import dataclasses
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from study.data.plus import read_folder, read_plus, write_folder, write_plus
from study.errors import StudyError
from study.types import RigidTransform, TrackedSweep

REAL = Path(__file__).parents[2] / "shared" / "data" / "plus" / "BoneUltrasound_L14.igs.mha"


def make_sweep(**changes):
    rng = np.random.default_rng(7)
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.02, (40, 3)), axis=0)).as_matrix()
    poses[:, :3, 3] = np.cumsum(rng.normal(size=(40, 3)), axis=0) + np.array([300, -20, 500])
    given = {
        "frame_times_s": 1000.268 + np.cumsum(rng.uniform(0.01, 0.05, 9)),
        "poses": poses,
        "pose_times_s": 1000 + 0.0123456789 * np.arange(40),
        "pose_valid": np.arange(40) != 30,
        "masks": rng.random((9, 11, 13)) < 0.3,
        "pixel_spacing_mm": (0.2, 0.1234567890123456),
        "T_probe_image": RigidTransform.random(rng),
        "latency_s": 0.268,
        "name": "us:test 1",
    }
    return TrackedSweep(**{**given, **changes})


def assert_identical(a: TrackedSweep, b: TrackedSweep) -> None:
    for field in dataclasses.fields(TrackedSweep):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            assert y is not None, field.name
            assert x.dtype == y.dtype, field.name
            np.testing.assert_array_equal(x, y, err_msg=field.name)
        elif isinstance(x, RigidTransform):
            np.testing.assert_array_equal(x.matrix, y.matrix)
        else:
            assert x == y, field.name


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
    sweep = read_plus(path)
    np.testing.assert_array_equal(sweep.poses[0, :3, 3], [0, 0, 7])
    assert list(sweep.pose_valid) == [True, False]
    assert sweep.latency_s == 0
    np.testing.assert_allclose(sweep.pixel_spacing_mm, (0.2, 0.3))
    np.testing.assert_allclose(sweep.T_probe_image.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(sweep.T_probe_image.translation, [4, 5, 6])
    # In the reference's frame: inv([[0,-1,0],[1,0,0],[0,0,1]], t = (0,5,0)) applied to (0, 0, 7).
    np.testing.assert_allclose(read_plus(path, base="Reference").poses[0, :3, 3], [-5, 0, 7], atol=1e-12)
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
        ({"ElementNumberOfChannels": "3"}, "one channel"),
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
    with pytest.raises(StudyError, match="ending in"):
        write_plus(tmp_path / "a.mha", make_sweep())
    with pytest.raises(StudyError, match="convert"):
        write_plus(path, make_sweep(masks=None, images=np.zeros((9, 2, 2))))
    with pytest.raises(StudyError, match="images in the sweep, got none"):
        write_plus(path, make_sweep(), content="images")


def test_the_real_plus_file():
    if not REAL.exists():
        pytest.skip(f"no PLUS example at {REAL}: it is not part of the repository (PlusLibData, BSD-3)")
    sweep = read_plus(REAL)
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
    np.testing.assert_allclose(T_tracker_reference @ read_plus(REAL, base="Reference").poses[0], sweep.poses[0])
    with pytest.raises(StudyError, match="got ProbeToTrackerTransform, ReferenceToTracker"):
        read_plus(REAL, probe="Needle")


def test_the_real_file_written_reads_back(tmp_path):
    if not REAL.exists():
        pytest.skip(f"no PLUS example at {REAL}: it is not part of the repository (PlusLibData, BSD-3)")
    sweep = read_plus(REAL)
    short = dataclasses.replace(sweep, frame_times_s=sweep.frame_times_s[:3], images=sweep.images[:3])
    write_plus(tmp_path / "b.igs.mha", short)
    assert_identical(read_plus(tmp_path / "b.igs.mha"), short)


# --- folders ------------------------------------------------------------------------------------------------------


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
        (lambda f: (f / "sweep.json").write_text("{"), "expected JSON"),
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
