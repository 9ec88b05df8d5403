"""Two boxes laid over each other: Dice and distances by arithmetic."""

import numpy as np
import pytest

from study.ct import agreement
from study.ct.agreement import Agreement, compare_parts
from study.types import Mesh, Part, RigidTransform, Volume


def box(shape: tuple[int, int, int], low: int, high: int) -> Volume:
    """A mask with one part from voxel ``low`` to before ``high`` along every axis."""
    values = np.full(shape, int(Part.UNKNOWN), dtype=np.int8)
    values[low:high, low:high, low:high] = int(Part.STERNUM)
    return Volume(values, np.ones(3))


@pytest.fixture(autouse=True)
def corners_for_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """A box's surface is that of its eight corners; smoothing and cleaning are tested with `surface`."""

    def surface(mask: Volume) -> Mesh:
        found = mask.to_mm(np.argwhere(mask.values == Part.STERNUM))
        low, high = found.min(axis=0), found.max(axis=0)
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
        faces = [[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5]]
        faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
        return Mesh(corners, np.array(faces), np.zeros(8, dtype=np.int64))

    monkeypatch.setattr(agreement, "surface", surface)


def test_a_mask_agrees_with_itself():
    mask = box((40, 40, 40), 5, 30)
    same = compare_parts(mask, mask, mask)
    assert same.dice == 1
    assert same.distances_mm.max() < 1e-5


def test_a_smaller_box_inside_a_larger_one():
    inner, outer = box((40, 40, 40), 10, 20), box((40, 40, 40), 10, 25)
    found = compare_parts(inner, outer, outer)
    assert found.dice == pytest.approx(2 * 10**3 / (10**3 + 15**3))
    # Seven of the inner corners lie on the outer box's faces or edges, the eighth 5 mm below all three others.
    assert np.sort(found.distances_mm[:8]) == pytest.approx([0] * 7 + [5], abs=1e-5)
    assert found.distances_mm.max() == pytest.approx(5 * np.sqrt(3), abs=1e-4)
    assert found.worst_place == pytest.approx([24, 24, 24])
    assert found.dice == compare_parts(outer, inner, outer).dice


def test_masks_on_other_grids_are_counted_on_the_voxels_asked_for():
    fine = box((40, 40, 40), 10, 20)
    values = box((20, 20, 20), 5, 10).values
    coarse = Volume(values, np.full(3, 2.0), RigidTransform(translation=np.full(3, 0.5)))  # eight fine voxels each
    assert compare_parts(fine, coarse, fine).dice == 1
    assert compare_parts(fine, coarse, coarse).dice == 1


def test_the_worst_place_belongs_to_the_largest_distance():
    places = np.arange(9.0).reshape(3, 3)
    assert Agreement(0.5, np.array([1.0, 7.0, 2.0]), places).worst_place.tolist() == [3.0, 4.0, 5.0]
