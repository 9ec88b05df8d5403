"""Every level does what it is called, and nothing else: the levels of a pair share all other draws."""

from dataclasses import fields, replace

import numpy as np
import pytest

from study.errors import StudyError
from study.evaluation.disturbances import KINDS, SEEDS, Disturbance, disturbed_pair, levels
from study.geometry.points import nearest
from study.params import PHANTOM_SEED, POPULATION_SEED
from study.phantom import anterior_cloud, draw_subject
from study.seeds import named_rng
from study.types import Part

SMALL = Disturbance(ct_points=800, us_points=1500)
SEED = 523


def us_of(**changes):
    return disturbed_pair(replace(SMALL, **changes), SEED).us


def test_levels_are_listed_by_kind_and_one_of_each_is_a_careful_acquisition():
    listed = levels(SMALL)
    assert list(dict.fromkeys(level.kind for level in listed)) == list(KINDS)
    for kind in ("noise", "outliers", "strips", "branch", "deformation"):
        mine = [level for level in listed if level.kind == kind]
        assert [level.value for level in mine] == sorted(level.value for level in mine)
        assert sum(level.disturbance == SMALL for level in mine) == 1
    for level in listed:  # the points of a density are two fields, a strip's width comes with strips
        changed = [f.name for f in fields(Disturbance) if getattr(level.disturbance, f.name) != getattr(SMALL, f.name)]
        assert len(changed) <= (2 if level.kind in ("density", "strip_width") else 1)


def test_the_people_are_those_of_nobody_else():
    others = {0, PHANTOM_SEED, POPULATION_SEED, *range(101, 127), *range(201, 209), *range(301, 307), *range(401, 411)}
    assert len(SEEDS) >= 20
    assert not others & set(SEEDS)


def test_noise_is_noise_on_the_same_points():
    clean, noisy = us_of(noise_mm=0.0), us_of(noise_mm=4.0)
    np.testing.assert_array_equal(
        clean.points,
        anterior_cloud(draw_subject("patient", SEED), 1500, 0.0, 0, named_rng(SEED, "robustness/us")).points,
    )
    assert (noisy.points - clean.points).std() == pytest.approx(4.0, rel=0.05)


def test_outliers_are_that_share_of_all_and_leave_the_others():
    base, worse = us_of(), us_of(outlier_share=0.3)
    np.testing.assert_array_equal(worse.points[: len(base)], base.points)
    assert 1 - len(base) / len(worse) == pytest.approx(0.3, abs=0.001)


def test_strips_take_points_the_wider_the_more_and_move_none():
    base, some, wide = us_of(), us_of(strips=4), us_of(strips=4, strip_mm=18.0)
    assert len(wide) < len(some) < len(base)
    rows = {tuple(row) for row in base.points}
    assert all(tuple(row) in rows for row in wide.points)


def test_a_branch_loses_its_lateral_end_then_all_of_it():
    base, half, none = (us_of(noise_mm=0.0, branch_share=share) for share in (0.0, 0.5, 1.0))
    count = [np.bincount(cloud.parts, minlength=9) for cloud in (base, half, none)]
    (part,) = np.flatnonzero(count[0] - count[2])
    assert part > Part.STERNUM
    assert count[2][part] == 0
    assert count[1][part] == pytest.approx(count[0][part] / 2, abs=8)
    middle = base.only(Part.STERNUM)[:, 0].mean()
    reach = [np.abs(cloud.only(Part(part))[:, 0] - middle).max() for cloud in (base, half)]
    assert reach[1] < reach[0] - 5


def test_swept_points_and_their_outliers_have_times():
    swept = us_of(noise_mm=0.0, calibration_mm=1.0)
    worse = us_of(noise_mm=0.0, calibration_mm=1.0, outlier_share=0.2, strips=4)
    assert us_of().times is None
    assert len(worse.times) == len(worse)
    when = dict(zip(map(tuple, swept.points), swept.times, strict=True))
    known = [(when[point], time) for point, time in zip(map(tuple, worse.points), worse.times, strict=True)
             if point in when]  # fmt: skip
    assert 0.5 * len(swept) < len(known) < len(swept)
    assert all(mine == theirs for mine, theirs in known)
    assert swept.times.min() <= worse.times.min() < worse.times.max() <= swept.times.max()


def test_a_twin_lies_where_the_person_does():
    twin = disturbed_pair(replace(SMALL, deformation=0.0), SEED)
    np.testing.assert_allclose(twin.goal, twin.waypoints, atol=1e-6)
    other = disturbed_pair(SMALL, SEED)
    np.testing.assert_array_equal(other.waypoints, twin.waypoints)
    assert np.linalg.norm(other.goal - other.waypoints, axis=1).mean() > 2


def test_a_calibration_error_moves_the_sweep_by_its_size():
    right, off = (us_of(calibration_mm=mm, noise_mm=0.0).points.mean(axis=0) for mm in (0.0, 4.0))
    assert 2.5 < np.linalg.norm(off - right) < 5.5


def test_voxels_make_a_cloud_near_the_exact_surface():
    coarse = disturbed_pair(replace(SMALL, voxel_mm=2.5), SEED)
    exact = disturbed_pair(replace(SMALL, ct_points=6000), SEED).ct.points
    distance, _ = nearest(coarse.ct.points, exact)
    assert len(coarse.ct) == 800
    assert 0.2 < distance.mean() < 1.5


@pytest.mark.parametrize("wrong", [{"noise_mm": -1.0}, {"outlier_share": 1.0}, {"branch_share": 1.1}, {"strips": -1}])
def test_sizes_that_are_none_are_refused(wrong):
    with pytest.raises(StudyError, match="expected"):
        Disturbance(**wrong)
