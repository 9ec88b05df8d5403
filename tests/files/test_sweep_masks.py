"""Masks from 3D Slicer, networks and folders end on the frames they were drawn on, or are refused."""

import numpy as np
import pytest
import SimpleITK as sitk
from plus_files import plus_nrrd

from study.errors import StudyError
from study.files.plus import read_plus

MASK = np.zeros((2, 2, 3), dtype=np.uint8)
MASK[0, 1, 2] = MASK[1, 0, 0] = MASK[1, 1, 0] = 1  # asymmetric in frames, rows and columns


def segmentation(path, stack=MASK, *, offset="0 0 0", origin=None, names=("bone",), step=(1, 1, 1), drop=()):
    """As 3D Slicer saves it: label i + 1 is segment i, the reference image's offset beside it."""
    image = sitk.GetImageFromArray(stack)
    image.SetDirection(np.diag(np.sign(step)).astype(float).ravel().tolist())
    image.SetSpacing(np.abs(step).astype(float).tolist())
    image.SetOrigin([float(part) for part in (offset.split() if origin is None else origin)])
    fields = {"Segmentation_ReferenceImageExtentOffset": offset}
    for i, name in enumerate(names):
        fields |= {f"Segment{i}_Name": name, f"Segment{i}_LabelValue": str(i + 1), f"Segment{i}_Layer": "0"}
    for key, value in fields.items():
        if key not in drop:
            image.SetMetaData(key, value)
    sitk.WriteImage(image, str(path), True)
    return path


@pytest.fixture
def recording(tmp_path):
    return plus_nrrd(tmp_path / "a.nrrd")


def test_a_segmentation_of_slicer(tmp_path, recording):
    sweep = read_plus(recording, masks=segmentation(tmp_path / "m.seg.nrrd"))
    np.testing.assert_array_equal(sweep.masks, MASK > 0)
    assert len(sweep.notes) == 1  # the base frame
    # Slicer crops to the box of what was drawn, and says where it lay.
    box = segmentation(tmp_path / "c.seg.nrrd", MASK[1:, :, :1], offset="0 0 1")
    kept = read_plus(recording, masks=box).masks
    np.testing.assert_array_equal(kept, np.stack([np.zeros((2, 3)), MASK[1]]) > 0)
    moved = segmentation(tmp_path / "d.seg.nrrd", MASK[1:, :, :1], offset="0 0 1", origin=(7.3, 0, 0))
    sweep = read_plus(recording, masks=moved)
    np.testing.assert_array_equal(sweep.masks, kept)
    assert "placed by its offset 0 0 1" in sweep.notes[-1]


def test_a_stack_that_runs_backwards_is_turned(tmp_path, recording):
    backwards = segmentation(tmp_path / "m.seg.nrrd", MASK[:, ::-1, ::-1], step=(-1, -1, 1), origin=(2, 1, 0))
    np.testing.assert_array_equal(read_plus(recording, masks=backwards).masks, MASK > 0)


def test_segments_are_named(tmp_path, recording):
    labels = MASK.copy()
    labels[1, 0, 0] = 2
    path = segmentation(tmp_path / "m.seg.nrrd", labels, names=("bone", "shadow"))
    with pytest.raises(StudyError, match="expected one segment, got bone, shadow"):
        read_plus(recording, masks=path)
    np.testing.assert_array_equal(read_plus(recording, masks=path, segments=["bone"]).masks, labels == 1)
    np.testing.assert_array_equal(read_plus(recording, masks=path, segments=["bone", "shadow"]).masks, labels > 0)
    with pytest.raises(StudyError, match="check the names"):
        read_plus(recording, masks=path, segments=["rib"])


def test_layers_of_segments_that_overlap(tmp_path, recording):
    layers = np.stack([MASK, np.roll(MASK, 1, axis=2)], axis=-1)  # ITK's channels are Slicer's list of layers
    image = sitk.GetImageFromArray(layers, isVector=True)
    for i, name in enumerate(("bone", "skin")):
        for key, value in (("Name", name), ("LabelValue", "1"), ("Layer", str(i))):
            image.SetMetaData(f"Segment{i}_{key}", value)
    sitk.WriteImage(image, str(tmp_path / "m.seg.nrrd"))
    listed = (tmp_path / "m.seg.nrrd").read_bytes().replace(b"kinds: vector", b"kinds: list  ")
    (tmp_path / "m.seg.nrrd").write_bytes(listed)
    sweep = read_plus(recording, masks=tmp_path / "m.seg.nrrd", segments=["skin"])
    np.testing.assert_array_equal(sweep.masks, np.roll(MASK, 1, axis=2) > 0)


@pytest.mark.parametrize("name", ["m.nrrd", "m.mha", "m.nii", "m.nii.gz"])
def test_plain_stacks(tmp_path, recording, name):
    sitk.WriteImage(sitk.GetImageFromArray(MASK), str(tmp_path / name))
    np.testing.assert_array_equal(read_plus(recording, masks=tmp_path / name).masks, MASK > 0)


def test_another_grid_is_said(tmp_path, recording):
    image = sitk.GetImageFromArray(MASK)
    image.SetSpacing((0.2, 0.3, 1.0))
    sitk.WriteImage(image, str(tmp_path / "m.nii.gz"))
    sweep = read_plus(recording, masks=tmp_path / "m.nii.gz")
    np.testing.assert_array_equal(sweep.masks, MASK > 0)
    assert "another grid than the recording: taken frame by frame" in sweep.notes[-1]


def test_masks_lie_as_the_recording_does(tmp_path):
    recording = plus_nrrd(tmp_path / "a.nrrd", pairs=[("ultrasound image orientation", "UN")])
    expected = MASK[:, ::-1, ::-1] > 0
    sitk.WriteImage(sitk.GetImageFromArray(MASK), str(tmp_path / "m.nii.gz"))
    for path in (segmentation(tmp_path / "m.seg.nrrd"), tmp_path / "m.nii.gz"):
        np.testing.assert_array_equal(read_plus(recording, masks=path).masks, expected)


def png(path, pixels):
    sitk.WriteImage(sitk.GetImageFromArray(pixels), str(path))


def test_a_folder_of_pngs_in_the_order_of_its_numbers(tmp_path, recording):
    folder = tmp_path / "masks"
    folder.mkdir()
    png(folder / "frame_10.png", MASK[1] * 255)
    png(folder / "frame_9.png", MASK[0] * 255)
    np.testing.assert_array_equal(read_plus(recording, masks=folder).masks, MASK > 0)
    png(folder / "frame_11.png", MASK[0])
    with pytest.raises(StudyError, match=r"a numbered PNG for each of the 2 frames of a\.nrrd, got 3"):
        read_plus(recording, masks=folder)
    (folder / "frame_11.png").unlink()
    (folder / "frame_10.png").rename(folder / "frame_09.png")
    with pytest.raises(StudyError, match="got 2 with 1 different numbers"):
        read_plus(recording, masks=folder)
    (folder / "frame_09.png").unlink()
    png(folder / "frame_10.png", np.zeros((5, 5), np.uint8))
    with pytest.raises(StudyError, match="3 x 2 pixels as in the first mask"):
        read_plus(recording, masks=folder)
    (folder / "frame_10.png").write_bytes(b"\x89PNG\r\n\x1a\nno")
    with pytest.raises(StudyError, match="readable image"):
        read_plus(recording, masks=folder)


def test_what_is_no_mask_of_this_recording(tmp_path, recording):
    for name, stack, message in (
        ("a.nii.gz", np.arange(12, dtype=np.uint8).reshape(2, 2, 3), "12 grey levels"),
        ("b.nii.gz", np.zeros((3, 2, 3), np.uint8), "size of the images"),
        ("c.nrrd", np.zeros((2, 3, 2), np.uint8), "size of the images"),
    ):
        sitk.WriteImage(sitk.GetImageFromArray(stack), str(tmp_path / name))
        with pytest.raises(StudyError, match=message):
            read_plus(recording, masks=tmp_path / name)
    with pytest.raises(StudyError, match="nothing at"):
        read_plus(recording, masks=tmp_path / "none.seg.nrrd")
    plain = segmentation(tmp_path / "p.seg.nrrd", names=())
    with pytest.raises(StudyError, match="expected segments"):
        read_plus(recording, masks=plain)
    with pytest.raises(StudyError, match="a label and a layer"):
        read_plus(recording, masks=_without_label(tmp_path / "l.seg.nrrd"))
    with pytest.raises(StudyError, match="leave them out"):
        read_plus(recording, masks=tmp_path / "c.nrrd", segments=["bone"])
    for name in ("m.seg.nrrd", "m.nii.gz"):
        whole = (segmentation(tmp_path / name) if "seg" in name else tmp_path / "b.nii.gz").read_bytes()
        (tmp_path / name).write_bytes(whole[:-6])
        with pytest.raises(StudyError, match="truncated"):
            read_plus(recording, masks=tmp_path / name)


def _without_label(path):
    whole = segmentation(path).read_bytes()
    path.write_bytes(whole.replace(b"Segment0_LabelValue:=1", b"Segment0_LabelValue:=x"))
    return path
