"""Front and foot are told by the arch and the bend of branches whose shape is known."""

import numpy as np
import pytest

from study.alignment.branches import Branches, branch_lengths_mm
from study.alignment.chest import find_chest
from study.alignment.orientation import MIN_FRONT_COSINE, bend_mm, bulge_mm, find_foot, find_front, sternum_front_mm
from study.alignment.sternum import SternumParams
from study.errors import StudyError
from study.types import Part, PointCloud

ROWS = (-38.0, -14.0, 12.0, 38.0)


def branch(row: float, side: int, reach: float = 70.0, bend: float = 0.0, arch: float = 0.0) -> np.ndarray:
    """A bar from x = 15 outwards that bends by ``bend`` mm along y and arches by ``arch`` mm along z."""
    x = np.repeat(np.linspace(15, reach, 200), 3)
    t = 2 * (x - 15) / (reach - 15) - 1
    y = row + np.tile([-4.0, 0.0, 4.0], 200) + bend * (1 - t * t)
    return np.column_stack([side * x, y, arch * (1 - t * t)])


def drawn(low: dict[str, float], high: dict[str, float]) -> tuple[Branches, np.ndarray]:
    """Four branches a side whose lowest and highest have a reach, bend and arch of their own."""
    plate = np.random.default_rng(0).uniform([-15, -45, 0], [15, 45, 0.01], (2000, 3))
    bars = [
        branch(row, side, **(low if k == 0 else high if k == 3 else {"arch": 1.0}))
        for side in (-1, 1)
        for k, row in enumerate(ROWS)
    ]
    numbers = [np.zeros(len(plate)), *(np.full(len(bar), 1 + k) for k, bar in enumerate(bars))]
    seeds = np.array([[side * 20.0, row] for side in (-1, 1) for row in ROWS])
    return Branches(np.concatenate(numbers).astype(np.int64), (15.0, 15.0), seeds), np.concatenate([plate, *bars])


@pytest.mark.parametrize("sign", [1, -1])
def test_a_planted_arch_has_its_sign_and_size(sign):
    bar = branch(0.0, 1, arch=sign * 5.0)
    sternum = np.column_stack([np.zeros(50), np.linspace(-10, 10, 50), np.zeros(50)])
    # The rise above the chord between the 5th and 95th percentile of the bar, and no fall of the ends worth naming.
    assert sign * bulge_mm(bar, sternum) == pytest.approx(4.0, abs=0.6)
    assert bulge_mm(bar[:, :] * [1, 1, 0], sternum) == pytest.approx(0.0, abs=1e-9)


def test_a_fall_beside_the_sternum_counts_where_the_sternum_is():
    bar = branch(0.0, 1)
    bar[:, 2] = -((bar[:, 0] / 70) ** 2) * 10
    sternum = np.column_stack([np.zeros(50), np.linspace(-10, 10, 50), np.zeros(50)])
    far = sternum + np.array([0.0, 500.0, 0.0])
    assert bulge_mm(bar, sternum) > bulge_mm(bar, far) > 0


@pytest.mark.parametrize("bend", [0.0, 3.0, 10.0])
def test_a_planted_bend_is_measured_whatever_its_direction(bend):
    for side, sign in ((1, 1), (-1, 1), (1, -1)):
        assert bend_mm(branch(12.0, side, bend=sign * bend)) == pytest.approx(bend, rel=0.15, abs=0.3)


def test_a_piece_of_a_neighbour_does_not_bend_a_branch():
    bar = branch(0.0, 1)
    piece = np.random.default_rng(1).uniform([40, 20, 0], [50, 26, 0.1], (60, 3))
    assert bend_mm(np.concatenate([bar, piece])) < 1.5  # 20 mm off where it lies


@pytest.mark.parametrize(("sign", "at_high_y"), [(1, True), (-1, False)])
def test_the_foot_is_where_the_branches_bend_and_reach_most(sign, at_high_y):
    bent, short = {"bend": 8.0, "reach": 70.0, "arch": 1.0}, {"bend": 1.0, "reach": 45.0, "arch": 1.0}
    branches, local = drawn(short, bent) if at_high_y else drawn(bent, short)
    foot = find_foot(branches, local, "toy")
    assert foot.at_high_y is at_high_y
    assert foot.bend_ratio > 3.0
    assert foot.length_ratio > 1.5
    assert branch_lengths_mm(branches, local)[[0, 3]] == pytest.approx([55.0, 30.0][::-sign], abs=2.0)
    looks_to_front, arch_mm = find_front(branches, local, None, "toy")
    assert looks_to_front
    assert arch_mm > 0.2
    assert find_front(branches, local * [1, 1, -1], None, "toy") == (False, pytest.approx(arch_mm))


def test_a_long_branch_that_does_not_bend_contradicts_the_foot():
    straight, bent = {"reach": 70.0, "arch": 1.0}, {"reach": 45.0, "bend": 8.0, "arch": 1.0}
    branches, local = drawn(straight, bent)
    with pytest.raises(StudyError, match=r"toy: expected 5th cartilages, those that bend most, .* head and foot"):
        find_foot(branches, local, "toy")


def test_a_given_front_decides_but_may_not_contradict_the_arch_or_lie_in_the_plane():
    branches, local = drawn({"reach": 70.0}, {"reach": 45.0})
    _, arch_mm = find_front(branches, local, None, "toy")
    assert find_front(branches, local, 0.7, "toy") == (True, pytest.approx(arch_mm))
    assert find_front(branches, local * [1, 1, -1], -0.7, "toy") == (False, pytest.approx(arch_mm))
    assert find_front(branches, local * [1, 1, 0], -0.7, "toy") == (False, pytest.approx(0.0))
    with pytest.raises(StudyError, match=r"toy: expected cartilages that arch towards the `front` given, got .* away"):
        find_front(branches, local, -0.7, "toy")
    with pytest.raises(StudyError, match=r"toy: expected a `front` across the feature plane .* got 0\.10"):
        find_front(branches, local, MIN_FRONT_COSINE / 2, "toy")
    with pytest.raises(StudyError, match="toy: expected cartilages that arch"):
        find_front(branches, local * [1, 1, 0], None, "toy")


def test_the_sternums_front_is_its_foremost_surface_whatever_lies_behind():
    params = SternumParams()
    rng = np.random.default_rng(3)
    sheet = rng.uniform([-14, -44, 6.5], [14, 44, 7.0], (4000, 3))
    tube = np.concatenate([sheet, rng.uniform([-14, -44, -7], [14, 44, 6.5], (4000, 3))])
    assert sternum_front_mm(sheet, params) == pytest.approx(7.0, abs=0.1)
    assert sternum_front_mm(tube, params) == pytest.approx(7.0, abs=0.2)
    beyond = np.concatenate([sheet, rng.uniform([30, -44, 40], [50, 44, 60], (500, 3))])
    assert sternum_front_mm(beyond, params) == sternum_front_mm(sheet, params)
    with pytest.raises(StudyError, match="expected points"):
        sternum_front_mm(beyond[-500:], params)


def test_a_bend_that_the_lengths_contradict_is_refused(ct_clouds):
    """Shifted lines of a sweep bend any cartilage; a chest called upside down by its bend would look plausible."""
    cloud = ct_clouds["ct2"]
    points = cloud.points.copy()
    middle = cloud.only(Part.STERNUM)[:, 0].mean()
    for part in (Part.LEFT_2, Part.RIGHT_2):  # a parabola of 15 mm in the feature plane
        mine = cloud.parts == part
        along = np.abs(points[mine, 0] - middle)
        t = (along - along.min()) / np.ptp(along)
        points[mine, 2] += 60.0 * t * (1 - t)
    with pytest.raises(StudyError, match=r"bent: expected 5th cartilages, those that bend most, .* head and foot"):
        find_chest(PointCloud(points, "bent"))


def test_a_flat_chest_needs_its_front(ct_clouds):
    cloud = ct_clouds["ct1"]
    flat = cloud.points * [1, 0, 1]
    with pytest.raises(StudyError, match=r"expected cartilages that arch 0\.2 mm or more to the front, got 0\.00 mm"):
        find_chest(PointCloud(flat, "flat"))
    for sign in (1.0, -1.0):
        chest = find_chest(PointCloud(flat, "flat", front=np.array([0, sign, 0])))
        assert chest.T_cloud_chest.rotation[:, 2] == pytest.approx([0, sign, 0], abs=1e-6)
