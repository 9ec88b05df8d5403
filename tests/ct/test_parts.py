"""The region of interest from labels, on a chest drawn voxel by voxel."""

from __future__ import annotations

import numpy as np
import pytest

from study.ct.parts import check_rib_labels, on_grid, parts_from_labels, rib_name
from study.data.manifest import load_manifest
from study.errors import StudyError
from study.types import CARTILAGES, Part, RigidTransform, Volume

IDS = load_manifest().label_ids("totalsegmentator_v2")
SPACING = np.array([1.5, 1.5, 2.0])
LEVELS = {2: (50.0, 5.0), 3: (27.0, -2.0), 4: (3.0, -8.0), 5: (-20.0, -20.0), 6: (-32.0, -40.0)}
# height of a cartilage's sternal end, and how much lower its rib's end lies; mm
FRAME = RigidTransform(translation=np.array([-110.0, -60.0, -80.0]))


def tube(grid: np.ndarray, corners: list[tuple[float, float, float]], radius: float) -> np.ndarray:
    inside = np.zeros(grid.shape[:-1], dtype=bool)
    for a, b in zip(np.array(corners)[:-1], np.array(corners)[1:], strict=True):
        along = np.clip(((grid - a) @ (b - a)) / ((b - a) @ (b - a)), 0, 1)
        inside |= np.linalg.norm(grid - a - along[..., None] * (b - a), axis=-1) < radius
    return inside


@pytest.fixture(scope="module")
def chest() -> tuple[Volume, dict[str, np.ndarray]]:
    """Labels, and where each cartilage was drawn; the 6th touches the 5th half-way, as an arch does."""
    shape = (148, 62, 90)
    blank = Volume(np.zeros(shape, np.int16), SPACING, FRAME, "drawn")
    grid = blank.to_mm(np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)).reshape(*shape, 3)
    values = np.zeros(shape, np.int16)
    drawn = {}
    for side, sign in (("right", 1.0), ("left", -1.0)):
        for level, (height, drop) in LEVELS.items():
            end = (sign * 70.0, 0.0, height + drop)
            drawn[f"{side}_{level}"] = tube(grid, [(sign * 14.0, 10.0, height), end], 5.0)
            rib = tube(grid, [end, (sign * 95.0, -45.0, height + drop + 5.0)], 4.0)
            values[rib] = IDS[rib_name(side, level)]
        bridge = tube(grid, [(sign * 45.0, 4.5, -31.0), (sign * 45.0, 4.5, -54.0)], 3.0)
        values[bridge] = IDS["costal_cartilages"]
    for cartilage in drawn.values():
        values[cartilage] = IDS["costal_cartilages"]
    values[(np.abs(grid) < (12.0, 99.0, 99.0)).all(-1) & (np.abs(grid[..., 1] - 10) < 5) & (grid[..., 2] > -45)] = IDS[
        "sternum"
    ]
    values[..., -4:] = 0
    return blank.with_values(values), drawn


@pytest.fixture(scope="module")
def mask(chest: tuple[Volume, dict[str, np.ndarray]]) -> Volume:
    return parts_from_labels(chest[0], IDS)


def marked(mask: Volume, labels: Volume, part: Part) -> np.ndarray:
    """A part as a boolean array on the labels' own grid."""
    whole = np.zeros(labels.shape, dtype=bool)
    index = np.rint(labels.to_index(mask.to_mm(np.argwhere(mask.values == part)))).astype(int)
    whole[tuple(index.T)] = True
    return whole


def test_every_cartilage_is_whole_and_apart(mask: Volume, chest: tuple[Volume, dict[str, np.ndarray]]) -> None:
    labels, drawn = chest
    assert set(np.unique(mask.values)) == {int(part) for part in Part}
    for part in CARTILAGES:
        truth = drawn[f"{part.side}_{part.level}"] & (labels.values == IDS["costal_cartilages"])
        found = marked(mask, labels, part)
        dice = 2 * (truth & found).sum() / (truth.sum() + found.sum())
        assert dice > (0.9 if part.level == 5 else 0.999), (part.name, dice)  # the 5th keeps half the bridge to the 6th


def test_the_sternum_spans_levels_2_to_5(mask: Volume) -> None:
    z = mask.to_mm(np.argwhere(mask.values == Part.STERNUM))[:, 2]
    assert z.max() == pytest.approx(55.0, abs=3.0)  # the 2nd cartilage's axis + its radius
    assert z.min() == pytest.approx(-25.0, abs=3.0)  # the 5th's - its radius


def test_labels_in_the_wrong_place_are_refused(chest: tuple[Volume, dict[str, np.ndarray]]) -> None:
    labels, drawn = chest
    swapped = {**IDS, **{rib_name("left", n): IDS[rib_name("right", n)] for n in range(1, 13)}}
    swapped |= {rib_name("right", n): IDS[rib_name("left", n)] for n in range(1, 13)}
    with pytest.raises(StudyError, match="swapped"):
        check_rib_labels(labels, swapped)
    upside_down = labels.with_values(labels.values[:, :, ::-1])
    with pytest.raises(StudyError, match="upside down"):
        check_rib_labels(upside_down, IDS)
    with pytest.raises(StudyError, match="label ids of sternum, costal_cartilages"):
        parts_from_labels(labels, load_manifest().label_ids("ribseg_v2"))
    without = labels.values.copy()
    without[without == IDS["rib_left_3"]] = 0
    with pytest.raises(StudyError, match="got none of rib_left_3"):
        parts_from_labels(labels.with_values(without), IDS)
    without = labels.values.copy()
    without[drawn["right_4"] & (without == IDS["costal_cartilages"])] = 0
    with pytest.raises(StudyError, match="right rib 4"):
        parts_from_labels(labels.with_values(without), IDS)
    stump = labels.values.copy()
    stump[:95][drawn["right_3"][:95]] = 0
    stump[: 80 + 25][drawn["right_3"][: 80 + 25]] = 0
    with pytest.raises(StudyError, match=r"right rib 3 to reach the sternum, got a gap of \d+ mm"):
        parts_from_labels(labels.with_values(stump), IDS)


def test_a_field_of_view_that_cuts_a_part_is_refused(chest: tuple[Volume, dict[str, np.ndarray]]) -> None:
    labels, _ = chest
    front = int(labels.to_index([[0.0, 12.0, 0.0]])[0, 1])
    with pytest.raises(StudyError, match=r"sternum.* cut off by the field of view"):
        parts_from_labels(labels.crop([0, 0, 0], [999, front, 999]), IDS)


def test_parts_move_to_another_grid_by_the_nearest_voxel() -> None:
    rng = np.random.default_rng(3)
    turn = RigidTransform.random(rng)
    parts = rng.integers(-1, 9, (12, 10, 8)).astype(np.int8)
    mask = Volume(parts, np.array([1.0, 1.0, 1.0]), turn, "mask")
    first = turn.apply(np.array([[-2.2, 1.1, 0.4]]))[0]  # starts outside the mask
    like = Volume(np.zeros((9, 6, 5)), np.array([0.7, 1.3, 2.5]), RigidTransform(turn.rotation, first), "ct")
    moved = on_grid(mask, like)
    for index in np.ndindex(like.shape):
        at = np.rint(mask.to_index(like.to_mm(np.array([index])))[0]).astype(int)
        inside = (at >= 0).all() and (at < mask.shape).all()
        assert moved.values[index] == (parts[tuple(at)] if inside else Part.UNKNOWN)
    with pytest.raises(StudyError, match="axes of ct"):
        on_grid(Volume(parts, mask.spacing_mm, RigidTransform(), "straight"), like)
