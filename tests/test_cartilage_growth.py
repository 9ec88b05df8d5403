"""Cartilage grown in a drawn CT, and the landmark files and the picture it may start from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from phantom_files import ribseg_labels, scan, structure_ids

from study.cartilage_growth import parts_from_landmarks, parts_from_ribs, rib_ends
from study.chest_wall import anterior_wall_image
from study.ct import on_grid, parts_from_labels, rib_name
from study.data.landmarks import Landmarks, read_landmarks
from study.data.manifest import load_manifest
from study.errors import StudyError
from study.types import CARTILAGES, Part, RigidTransform, Volume

ROOT = Path(__file__).parents[1]
IDS = load_manifest().label_ids("ribseg_v2")
SPACING = np.array([1.4, 1.4, 2.0])
SHAPE = (150, 90, 84)
FRAME = RigidTransform(translation=np.array([-105.0, -85.0, -85.0]))
HEIGHTS = {2: (45.0, 5.0), 3: (20.0, -4.0), 4: (-5.0, -10.0), 5: (-28.0, -22.0)}  # sternal end, drop to the rib


def junction(part: Part) -> np.ndarray:
    height, drop = HEIGHTS[part.level]
    return np.array([(1 if part.side == "right" else -1) * 62.0, 2.0, height + drop])


def attachment(part: Part) -> np.ndarray:
    return np.array([(1 if part.side == "right" else -1) * 15.0, 10.0, HEIGHTS[part.level][0]])


def tube(grid: np.ndarray, a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    along = np.clip(((grid - a) @ (b - a)) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(grid - a - along[..., None] * (b - a), axis=-1) < radius


@pytest.fixture(scope="module")
def drawn() -> tuple[Volume, Volume, np.ndarray]:
    """A CT (fat, lung, muscle, cartilage, bone, noise), its rib labels, and the true parts."""
    blank = Volume(np.zeros(SHAPE, np.int16), SPACING, FRAME, "drawn")
    grid = blank.to_mm(np.moveaxis(np.indices(SHAPE), 0, -1).reshape(-1, 3)).reshape(*SHAPE, 3)
    x, y, _ = np.moveaxis(grid, -1, 0)
    wall = 10.0 - 8.0 * (x / 62.0) ** 2  # middle of the sheet
    hu = np.full(SHAPE, -1000.0)
    hu[y < wall + 25] = -100.0
    hu[(y > wall + 5.5) & (y < wall + 10)] = 55.0
    hu[(y < wall - 8) & (np.abs(x) > 25)] = -850.0
    parts = np.full(SHAPE, int(Part.UNKNOWN))
    labels = np.zeros(SHAPE, np.int16)
    for part in CARTILAGES:
        end = junction(part)
        cartilage = tube(grid, attachment(part) * (0.7, 1, 1), end, 5.5)
        hu[cartilage] = 95.0
        parts[cartilage] = part
        rib = tube(grid, end, end + np.array([np.sign(end[0]) * 30.0, -45.0, 6.0]), 5.0)
        hu[rib] = 450.0
        labels[rib] = IDS[rib_name(part.side, part.level)]
        parts[rib] = Part.UNKNOWN
    sternum = (np.abs(x) < 14) & (np.abs(y - 10) < 6.5) & (grid[..., 2] > -60) & (grid[..., 2] < 70)
    marrow = (np.abs(x) < 11) & (np.abs(y - 10) < 3.5) & (grid[..., 2] > -57) & (grid[..., 2] < 67)
    hu[sternum], parts[sternum] = 400.0, Part.STERNUM
    hu[marrow] = 20.0
    parts[(parts == Part.STERNUM) & ((grid[..., 2] > 50.5) | (grid[..., 2] < -33.5))] = Part.UNKNOWN
    hu += np.random.default_rng(0).normal(scale=12.0, size=SHAPE)
    return blank.with_values(hu.astype(np.float32)), blank.with_values(labels), parts


@pytest.fixture(scope="module")
def landmarks() -> Landmarks:
    return Landmarks(
        "drawn",
        {part: junction(part) for part in CARTILAGES},
        {part: attachment(part) for part in CARTILAGES},
        np.array([[0.0, 10.0, 55.0], [0.0, 10.0, -40.0]]),
        "test",
        "drawn",
    )


def dice(found: Volume, truth: np.ndarray, grid: Volume) -> dict[Part, float]:
    index = np.rint(found.to_index(grid.to_mm(np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3)))).astype(int)
    inside = ((index >= 0) & (index < found.shape)).all(axis=1)
    values = np.full(len(index), int(Part.UNKNOWN))
    values[inside] = found.values[tuple(index[inside].T)]
    values = values.reshape(grid.shape)
    return {
        part: float(2 * ((values == part) & (truth == part)).sum() / ((values == part).sum() + (truth == part).sum()))
        for part in Part
        if part > Part.UNKNOWN
    }


def test_rib_labels_alone_find_every_part(drawn: tuple[Volume, Volume, np.ndarray]) -> None:
    ct, labels, parts = drawn
    scores = dice(parts_from_ribs(ct, labels, IDS), parts, ct)
    assert len(scores) == 9
    assert min(scores.values()) > 0.8, scores


def test_landmarks_alone_find_every_part(drawn: tuple[Volume, Volume, np.ndarray], landmarks: Landmarks) -> None:
    ct, _, parts = drawn
    scores = dice(parts_from_landmarks(ct, landmarks), parts, ct)
    assert min(scores.values()) > 0.8, scores


def test_rib_ends_are_where_they_were_drawn(drawn: tuple[Volume, Volume, np.ndarray]) -> None:
    ends = rib_ends(drawn[1], IDS)
    assert set(ends) == set(CARTILAGES)
    for part in CARTILAGES:
        assert np.linalg.norm(ends[part] - junction(part)) < 5.0  # the tube's round cap


def test_images_and_landmarks_that_do_not_fit_are_refused(
    drawn: tuple[Volume, Volume, np.ndarray], landmarks: Landmarks
) -> None:
    ct, _, _ = drawn
    with pytest.raises(StudyError, match="Hounsfield units"):
        parts_from_landmarks(ct.with_values(ct.values + 1024), landmarks)
    with pytest.raises(StudyError, match="inside the image"):
        parts_from_landmarks(ct.crop([0, 0, 0], [80, 99, 99]), landmarks)
    hollow = replace(landmarks, sternum=landmarks.sternum - [0.0, 45.0, 0.0])
    with pytest.raises(StudyError, match="expected a sternum"):
        parts_from_landmarks(ct, hollow)
    in_lung = {**landmarks.junctions, Part.LEFT_4: junction(Part.LEFT_4) - [0.0, 28.0, 0.0]}
    with pytest.raises(StudyError, match="junction of left_4, got -"):
        parts_from_landmarks(ct, replace(landmarks, junctions=in_lung))
    bottom = int(ct.to_index([[0.0, 0.0, junction(Part.LEFT_5)[2] - 2.0]])[0, 2])
    with pytest.raises(StudyError, match="right_5, left_5 cut off by the field of view"):
        parts_from_landmarks(ct.crop([0, 0, bottom], [999, 999, 999]), landmarks)


def as_file(landmarks: Landmarks) -> dict:
    return {
        "subject": landmarks.subject,
        "frame": "RAS+ mm",
        "made_by": "test",
        "method": "drawn",
        "junctions": {part.name.lower(): landmarks.junctions[part].tolist() for part in CARTILAGES},
        "attachments": {part.name.lower(): landmarks.attachments[part].tolist() for part in CARTILAGES},
        "sternum": landmarks.sternum.tolist(),
    }


def test_landmark_file_round_trip_and_located_errors(tmp_path: Path, landmarks: Landmarks) -> None:
    path = tmp_path / "drawn.yaml"
    good = as_file(landmarks)
    path.write_text(yaml.safe_dump(good))
    read = read_landmarks(path)
    assert all((read.junctions[part] == landmarks.junctions[part]).all() for part in CARTILAGES)
    assert (read.sternum == landmarks.sternum).all()
    mirrored = {key: [-v[0], *v[1:]] for key, v in good["junctions"].items()}
    cases = [
        ({**good, "frame": "LPS mm"}, "frame"),
        ({**good, "junctions": {**good["junctions"], "left_3": [1.0, 2.0]}}, r"junctions\.left_3"),
        ({**good, "attachments": {**good["attachments"], "left_9": [1.0, 2.0, 3.0]}}, r"attachments\.left_9"),
        ({k: v for k, v in good.items() if k != "sternum"}, "sternum"),
        ({**good, "junctions": {**good["junctions"], "right_2": [1.0, "x", 3.0]}}, r"junctions\.right_2\.1"),
        ({**good, "junctions": mirrored}, "sides swapped"),
        ({**good, "sternum": good["sternum"][::-1]}, "top to bottom"),
        ({**good, "junctions": {**good["junctions"], "left_5": good["attachments"]["left_5"]}}, "left"),
        (["a list"], "the file"),
    ]
    for content, place in cases:
        path.write_text(yaml.safe_dump(content))
        with pytest.raises(StudyError, match=place):
            read_landmarks(path)
    path.write_text("a: [1, 2")
    with pytest.raises(StudyError, match="expected YAML"):
        read_landmarks(path)
    with pytest.raises(StudyError, match="nothing there"):
        read_landmarks(tmp_path / "absent.yaml")


def test_committed_landmark_files_are_chests() -> None:
    files = sorted((ROOT / "annotations").glob("*.yaml"))
    assert len(files) >= 3
    for file in files:
        landmarks = read_landmarks(file)
        assert landmarks.subject == file.stem
        assert landmarks.hard_to_see


def test_flattened_wall_gives_depth_under_a_pick(drawn: tuple[Volume, Volume, np.ndarray]) -> None:
    ct, _, _ = drawn
    wall = anterior_wall_image(ct)
    assert wall.image.shape == wall.depth_mm.shape == (len(wall.z_mm), len(wall.x_mm))
    for part in CARTILAGES:
        middle = (junction(part) + attachment(part)) / 2
        assert np.linalg.norm(wall.pick(middle[0], middle[2]) - middle) < 4.0
    bright = wall.image[np.abs(wall.z_mm - 45.0).argmin(), np.abs(wall.x_mm - 40.0).argmin()]
    gap = wall.image[np.abs(wall.z_mm - 33.0).argmin(), np.abs(wall.x_mm - 40.0).argmin()]
    assert bright > gap + 20.0
    with pytest.raises(StudyError, match="outside the picture"):
        wall.pick(900.0, 0.0)
    with pytest.raises(StudyError, match="expected lungs"):
        anterior_wall_image(ct.with_values(np.full(ct.shape, 50, np.int16)))


def test_the_sternum_of_a_round_chest_is_found_ahead_of_its_rib_ends() -> None:
    """Of this phantom the sternum lies more than the search's 14 mm in front of the plane through the rib ends."""
    image, labels = scan("ct5")
    found = on_grid(parts_from_ribs(image, ribseg_labels(labels), IDS), labels)
    truth = on_grid(parts_from_labels(labels, structure_ids()), labels)
    a, b = (volume.values > Part.UNKNOWN for volume in (found, truth))
    assert 2 * (a & b).sum() / (a.sum() + b.sum()) > 0.8
