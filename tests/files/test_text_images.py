"""Every fault of an NRRD or MetaImage header has its own error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from stored_images import stored_image

from study.errors import StudyError
from study.files.text_images import META_LETTERS
from study.files.volumes import read_volume

DIRECTIONS = "space directions: (0.69999999999999996,0,0) (0,0.90000000000000002,0) (0,0,2.5)"


def changed(path: Path, old: str, new: str) -> Path:
    sitk.WriteImage(stored_image(), str(path))
    raw = path.read_bytes()
    assert raw.count(old.encode()) == 1
    path.write_bytes(raw.replace(old.encode(), new.encode()))
    return path


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("NRRD0004", "NRRD0009", "magic"),
        ("NRRD0004", "BOOO0004", "magic"),
        (DIRECTIONS, DIRECTIONS.replace("2.5", "nan"), "finite numbers as a space direction"),
        (DIRECTIONS, DIRECTIONS.replace("2.5", "0"), "positive voxel spacing"),
        (DIRECTIONS, DIRECTIONS.replace("(0,0,2.5)", "none"), "3 space directions"),
        (DIRECTIONS, DIRECTIONS + "\nspacings: 0.7 0.9 3.5", "one voxel spacing"),
        (DIRECTIONS, DIRECTIONS + "\nspace units: \"m\" \"m\" \"m\"", "mm as the unit"),
        (DIRECTIONS, DIRECTIONS + "\nunits: \"cm\" \"cm\" \"cm\"", "one voxel spacing and unit"),
        (DIRECTIONS, DIRECTIONS + "\n" + DIRECTIONS.replace("2.5", "3.5"), "once in the header"),
        ("space: left-posterior-superior", "space: scanner-xyz", "the space left-posterior-superior"),
        ("space: left-posterior-superior", "space: left-anterior-superior", "the space left-post"),
        ("space: left-posterior-superior", "space dimension: 3", "unknown orientation"),
        ("space origin: (-120,80,-340)\n", "", "'space origin' in the NRRD header, got none"),
        ("(-120,80,-340)", "(-120,inf,-340)", "finite numbers as the space origin"),
        ("(-120,80,-340)", "(-120,80)", "finite numbers as the space origin"),
        ("kinds: domain domain domain", "kinds: vector domain domain", "colour or vector"),
        ("sizes: 6 7 5", "sizes: 6 7", "as many 'sizes'"),
        ("dimension: 3", "dimension: 4", "as many 'sizes'"),
        ("type: short", "type: block", "a type such as short"),
        ("endian: little\n", "", "'endian'"),
        ("encoding: raw", "encoding: hex", "encoding raw, gzip or bzip2"),
        ("encoding: raw", "encoding: raw\nbyte skip: 4", "no skipped bytes"),
    ],
)  # fmt: skip
def test_each_fault_of_nrrd_is_told(tmp_path: Path, old: str, new: str, told: str) -> None:
    with pytest.raises(StudyError, match=rf"^a\.nrrd: expected .*{told}"):
        read_volume(changed(tmp_path / "a.nrrd", old, new))


SPACING_LINE = "ElementSpacing = 0.69999999999999996 0.90000000000000002 2.5"


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("ObjectType = Image", "ObjectType = Mesh", "ObjectType Image"),
        ("ObjectType = Image", "\x89PNG", "MetaImage header"),
        (SPACING_LINE, "ElementSpacing = 0.7 nan 2.5", "finite numbers as ElementSpacing"),
        (SPACING_LINE, "ElementSpacing = 0.7 0 2.5", "positive voxel spacing"),
        (SPACING_LINE, "ElementSpacing = 0.7 -0.9 2.5", "positive voxel spacing"),
        (SPACING_LINE, "ElementSpacing = 0.7 0.9", "3 finite numbers as ElementSpacing"),
        (SPACING_LINE, SPACING_LINE + "\nElementSize = 0.7 0.9 3.5", "one ElementSpacing"),
        (SPACING_LINE, SPACING_LINE + "\nElementSpacing = 0.7 0.9 3.5", "once in the header"),
        (SPACING_LINE, SPACING_LINE + "\nDistanceUnits = cm", "mm as the unit"),
        ("Offset = -120 80 -340\n", "", "got no origin"),
        ("Offset = -120 80 -340", "Offset = -120 80 nan", "finite numbers as Offset"),
        ("Offset = -120 80 -340", "Offset = -120 80 -340\nPosition = 0 0 0", "one Offset"),
        ("TransformMatrix = 1 0 0 0 1 0 0 0 1", "TransformMatrix = 1 0 0 0 1 0 0 0 inf", "numbers as TransformMatrix"),
        ("AnatomicalOrientation = RAI", "AnatomicalOrientation = LPI", "which contradicts it"),
        ("TransformMatrix = 1 0 0 0 1 0 0 0 1", "TransformMatrix = -1 0 0 0 -1 0 0 0 1", "which contradicts it"),
        ("ElementType = MET_SHORT", "ElementType = MET_OTHER", "ElementType MET_CHAR"),
        ("DimSize = 6 7 5", "DimSize = 6 7", "as many sizes"),
        ("BinaryData = True", "BinaryData = False", "binarydata true"),
        ("ElementType = MET_SHORT", "HeaderSize = 12\nElementType = MET_SHORT", "headersize 0"),
        ("ElementType = MET_SHORT", "ElementToIntensityFunctionSlope = 2\nElementType = MET_SHORT", "slope 1"),
        ("ElementDataFile = LOCAL\n", "", "a header that ends"),
    ],
)
def test_each_fault_of_metaimage_is_told(tmp_path: Path, old: str, new: str, told: str) -> None:
    with pytest.raises(StudyError, match=rf"^a\.mha: expected .*{told}"):
        read_volume(changed(tmp_path / "a.mha", old, new))


def test_the_letters_of_an_orientation_are_those_that_itk_writes(tmp_path: Path) -> None:
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        for sign in (1.0, -1.0):
            direction = np.eye(3)[:, list(order)] * np.array([sign, 1.0, 1.0])
            sitk.WriteImage(stored_image(direction), str(tmp_path / "a.mha"))
            read_volume(tmp_path / "a.mha")
            text = (tmp_path / "a.mha").read_bytes().decode("latin-1")
            letters = text.split("AnatomicalOrientation = ")[1][:3]
            assert letters == "".join(
                META_LETTERS[axis][int(value < 0)] for axis, value in zip(order, (sign, 1, 1), strict=True)
            )


def test_what_real_writers_do_is_read(tmp_path: Path) -> None:
    sitk.WriteImage(stored_image(), str(tmp_path / "whole.nrrd"))
    expected = read_volume(tmp_path / "whole.nrrd")
    units = changed(tmp_path / "a.nrrd", DIRECTIONS, DIRECTIONS + '\nspace units: "mm" "mm" "mm"')
    unknown = changed(tmp_path / "a.mha", "AnatomicalOrientation = RAI", "AnatomicalOrientation = ???")
    other = changed(tmp_path / "b.mha", "Offset = -120", "DistanceUnits = mm\nHeaderSize = 0\nPosition = -120")
    for path in (units, unknown, other):
        volume = read_volume(path)
        np.testing.assert_array_equal(volume.values, expected.values)
        np.testing.assert_allclose(volume.affine, expected.affine)
    # The same place in the other space: R and A run against L and P.
    turned = DIRECTIONS.replace("(0.6", "(-0.6").replace("(0,0.9", "(0,-0.9")
    path = changed(tmp_path / "r.nrrd", DIRECTIONS, turned)
    raw = path.read_bytes().replace(b"left-posterior-superior", b"right-anterior-superior")
    path.write_bytes(raw.replace(b"(-120,80,-340)", b"(120,-80,-340)"))
    np.testing.assert_allclose(read_volume(path).affine, expected.affine)
