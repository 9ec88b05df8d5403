from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from study.errors import StudyError
from study.evaluation import distances
from study.evaluation.distances import CloudDistances, hausdorff_mm, point_errors_mm, waypoint_errors_mm
from study.evaluation.judgement import Judgement
from study.evaluation.metrics import METRICS, Unit, judge
from study.evaluation.pair import perfect
from study.geometry.points import nearest
from study.quality import measure_quality


def test_every_metric_states_a_tolerance_below_half_a_millimetre_and_its_reason():
    assert len(METRICS) >= 8
    for metric in METRICS.values():
        assert 0 < metric.tolerance < 0.5
        assert metric.reason
        assert metric.unit in ("mm", "1")


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_has_a_title_a_unit_and_a_measure_that_runs(name, pair, registration):
    metric = METRICS[name]
    assert isinstance(metric.unit, Unit)
    assert metric.title
    assert [other.title for other in METRICS.values()].count(metric.title) == 1
    values = np.atleast_1d(metric.measure(Judgement(pair, registration)))
    assert values.shape in ((1,), (20,))
    assert np.isfinite(values).all()
    assert (values >= 0).all()
    assert values.any() or metric.unit == Unit.FRACTION


def test_judge_measures_what_the_plain_functions_do(pair, registration):
    pair = replace(pair, shift_mm=np.array([0.4, -0.8, 1.2]))
    us = pair.alignment.target.cloud.points
    normal = pair.alignment.target.T_cloud_chest.rotation[:, 2]
    moved, visible_moved = (registration.transfer(at, 20.0) for at in (pair.waypoints_ct, pair.visible_waypoints_ct))
    seen = CloudDistances.between(registration.warped[pair.visible], us)
    paths = {
        "waypoint_error": (moved, pair.waypoints_us),
        "visible_waypoint_error": (visible_moved, pair.waypoints_us),
        "true_waypoint_error": (moved, pair.true_waypoints),
        "registered_waypoint_error": (moved, pair.true_waypoints + pair.shift_mm),
    }
    waypoints = {}
    for name, path in paths.items():
        waypoints[name] = waypoint_errors_mm(*path)
        waypoints[f"{name}_inplane"] = waypoint_errors_mm(*path, normal)
        waypoints[f"{name}_depth"] = waypoint_errors_mm(*path, normal, depth=True)
    surface = CloudDistances.between(registration.warped, us)
    points = point_errors_mm(registration.warped, pair.true_points)
    quality = measure_quality(pair.alignment, registration.warped)
    expected = {
        "hd": hausdorff_mm(registration.warped, us),
        "hd95": surface.hd95_mm,
        "msd": surface.mean_mm,
        "visible_hd": seen.hausdorff_mm,
        "visible_hd95": seen.hd95_mm,
        "visible_msd": seen.mean_mm,
        **waypoints,
        "true_error_mean": points.mean(),
        "true_error_p95": np.percentile(points, 95),
        "true_error_max": points.max(),
        "residual_share": (nearest(us, registration.warped)[0] > 5.0).mean(),
        "wrong_part_share": quality.wrong_part_share,
        "further_motion": quality.further_motion_mm,
        "stretched_share": quality.stretched_share,
        "folded_share": quality.folded_share,
    }
    found = judge(pair, registration)
    assert list(found) == list(METRICS) == list(expected)
    for name, value in expected.items():
        assert found[name].dtype == np.float64
        assert np.array_equal(found[name], np.atleast_1d(value)), name


def test_the_truth_is_judged_only_where_it_is_known(pair, real_pair, registration):
    known, unknown = judge(pair, registration), judge(real_pair, registration)
    by_truth = ("true_", "registered_")
    assert set(known) - set(unknown) == {name for name in METRICS if name.startswith(by_truth)}
    assert all(METRICS[name].needs_truth == name.startswith(by_truth) for name in METRICS)
    for name, values in unknown.items():
        assert np.array_equal(values, known[name])


def test_as_registered_is_judged_only_where_the_shift_is_known(pair, registration):
    known, unknown = judge(pair, registration), judge(replace(pair, shift_mm=None), registration)
    assert set(known) - set(unknown) == {name for name in METRICS if name.startswith("registered_")}
    assert all(METRICS[name].needs_shift == name.startswith("registered_") for name in METRICS)


def test_depth_and_plane_make_up_the_whole(pair, registration):
    found = judge(pair, registration)
    whole = [name for name in found if name.endswith("waypoint_error")]
    assert len(whole) == 4
    for name in whole:
        inplane, depth = found[f"{name}_inplane"], found[f"{name}_depth"]
        np.testing.assert_allclose(inplane**2 + depth**2, found[name] ** 2, rtol=1e-9)
        assert depth.max() > 0.5
        assert inplane.max() > 0.5


def test_a_perfect_registration_has_no_error_by_the_truth_but_some_by_the_protocol(pair):
    found = judge(pair, perfect(pair))
    assert found["true_error_max"] == 0
    assert found["hd"] > 2  # the back of the tubes has no partner on the sheet
    assert found["waypoint_error"].mean() > found["true_waypoint_error"].mean()


def test_the_clouds_are_searched_once_for_all_metrics(pair, registration, monkeypatch):
    calls = Counter()

    def counted(a, b):
        calls[len(a), len(b)] += 1
        return np.ones(len(a)), np.zeros(len(a), dtype=np.int64)

    monkeypatch.setattr(distances, "nearest", counted)
    judge(pair, registration)
    n, m = len(registration.warped), len(pair.alignment.target.cloud)
    assert calls == {(n, m): 1, (m, n): 1, (m, pair.visible.sum()): 1}


def test_the_sphere_is_passed_on_and_a_waypoint_out_of_reach_is_refused(pair, registration):
    near, far = (judge(pair, registration, radius)["waypoint_error"] for radius in (20.0, 40.0))
    assert np.abs(near - far).max() > 0.1
    with pytest.raises(StudyError, match="waypoint 0: expected at least 3 CT points"):
        judge(replace(pair, waypoints_ct=pair.waypoints_ct + 1000.0), registration)
