"""Branches of a planted drawing, and of the phantom seen from the front."""

from itertools import product

import numpy as np
import pytest

from study.alignment.branches import MAX_OFFSET_MM, _facing, find_branches, sternum_edge_mm
from study.errors import StudyError

ROWS = (-38.0, -14.0, 12.0, 38.0)


def drawing(half_width: float = 15.0, skip: tuple[int, int] | None = None, gap_mm: float = 0.0):
    """A plate and four bars a side with their true numbers: 0, then 1-4 at x < 0 and 5-8 at x > 0 by rising y."""
    rng = np.random.default_rng(0)
    points, numbers = [rng.uniform([-half_width, -46], [half_width, 46], (4000, 2))], [np.zeros(4000)]
    for s, side in enumerate((-1, 1)):
        for k, row in enumerate(ROWS):
            if (side, k) == skip:
                continue
            along = rng.uniform(half_width, 70, 600)
            if gap_mm:
                along = along[(along < 45) | (along > 45 + gap_mm)]
            bar = np.column_stack([side * along, row + (along - half_width) * 0.15 + rng.uniform(-5, 5, len(along))])
            points.append(bar)
            numbers.append(np.full(len(bar), 1 + 4 * s + k))
    return np.concatenate(points), np.concatenate(numbers).astype(int)


@pytest.mark.parametrize("half_width", [13.0, 16.0, 20.0])
def test_the_edge_of_the_sternum_is_found_on_both_sides(half_width):
    points, _ = drawing(half_width)
    for sign in (-1, 1):
        assert sternum_edge_mm(points, 90.0, sign) == pytest.approx(half_width, abs=3.0)  # 1.5 pixels


@pytest.mark.parametrize("gap_mm", [0.0, 8.0])
def test_planted_branches_get_their_numbers_across_a_missing_strip_too(gap_mm):
    points, numbers = drawing(gap_mm=gap_mm)
    found = find_branches(points, 90.0)
    beyond = np.abs(points[:, 0]) > max(found.half_widths_mm) + 2
    assert np.mean(found.branch[beyond] == numbers[beyond]) == 1.0
    assert (found.branch[np.abs(points[:, 0]) < 10] == 0).all()
    assert found.seeds.shape == (8, 2)
    assert np.sign(found.seeds[:, 0]).tolist() == [-1] * 4 + [1] * 4
    for side in (found.seeds[:4], found.seeds[4:]):
        assert (np.diff(side[:, 1]) > 15).all()


@pytest.mark.parametrize(("seed", "slope", "strip", "short"), [(303, 0.7, (19, 26), 26.0), (458, 1.1, (18, 27), 25.0)])
def test_a_strip_missed_beside_the_sternum_does_not_cost_a_branch(seed, slope, strip, short):
    """It leaves little of a short branch while a steep one fills many rows: only some bands, and starts from the gaps,
    show four roots that face those of the other side."""
    rng = np.random.default_rng(seed)
    points, numbers = [rng.uniform([-15, -46], [15, 46], (4000, 2))], [np.zeros(4000)]
    for s, side in enumerate((-1, 1)):
        for k, row in enumerate(ROWS):
            end, rise = short if k == 0 else 70, slope if k == 3 else 0.15
            along = rng.uniform(15, end, int(600 * (end - 15) / 55))
            bar = np.column_stack([side * along, row + (along - 15) * rise + rng.uniform(-5, 5, len(along))])
            if side == 1:
                bar = bar[(bar[:, 0] < strip[0]) | (bar[:, 0] > strip[1])]
            points.append(bar)
            numbers.append(np.full(len(bar), 1 + 4 * s + k))
    cloud, true = np.concatenate(points), np.concatenate(numbers)
    found = find_branches(cloud, 90.0)
    beyond = np.abs(cloud[:, 0]) > max(found.half_widths_mm) + 2
    assert np.mean(found.branch[beyond] == true[beyond]) > 0.99


def test_a_piece_far_from_every_branch_belongs_to_none():
    points, _ = drawing()
    island = np.random.default_rng(1).uniform([95, 80], [105, 90], (100, 2))
    found = find_branches(np.concatenate([points, island]), 90.0)
    assert (found.branch[-100:] == -1).all()
    assert (found.branch[:-100] >= 0).all()


@pytest.mark.parametrize("skip", [(side, k) for side in (-1, 1) for k in range(4)])
def test_three_branches_on_a_side_are_refused(skip):
    points, _ = drawing(skip=skip)
    where = "left" if skip[0] < 0 else "right"
    with pytest.raises(StudyError, match=f"toy: expected 4 separate cartilages at the {where} of the sternum"):
        find_branches(points, 90.0, "toy")


def test_a_plate_without_branches_is_refused():
    points, _ = drawing()
    with pytest.raises(StudyError, match="expected 4 separate cartilages"):
        find_branches(points[np.abs(points[:, 0]) < 15], 90.0)


def test_the_answer_does_not_depend_on_the_order_of_the_points():
    points, _ = drawing()
    order = np.random.default_rng(2).permutation(len(points))
    assert np.array_equal(find_branches(points[order], 90.0).branch, find_branches(points, 90.0).branch[order])


@pytest.mark.parametrize("scale_mm", [2.0, 8.0, 30.0])  # at most: the first pair fits, a later one, none
def test_the_nearest_pair_of_bands_that_face_each_other_is_chosen(scale_mm):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        left, right = (list(rng.normal(scale=scale_mm, size=(rng.integers(1, 6), 4, 2))) for _ in range(2))
        order = sorted(product(range(len(left)), range(len(right))), key=sum)
        pairs = [(left[i], right[j]) for i, j in order]
        offsets = [np.abs(one[:, 1] - other[:, 1]).max() for one, other in pairs]
        chosen = next((k for k, mm in enumerate(offsets) if mm <= MAX_OFFSET_MM), int(np.argmin(offsets)))
        assert np.array_equal(_facing(iter(left), iter(right)), np.concatenate(pairs[chosen]))
