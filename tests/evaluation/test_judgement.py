from collections import Counter

import numpy as np
import pytest

from study.evaluation import distances, judgement
from study.evaluation.distances import CloudDistances, point_errors_mm, waypoint_errors_mm
from study.evaluation.judgement import Judgement
from study.registration import Registration


@pytest.fixture
def judged(pair, registration):
    return Judgement(pair, registration)


def test_the_surface_is_the_warped_cloud_against_the_us_cloud(judged, pair, registration):
    direct = CloudDistances.between(registration.warped, pair.alignment.target.cloud.points)
    assert np.array_equal(judged.surface.forth, direct.forth)
    assert np.array_equal(judged.surface.back, direct.back)
    assert len(direct.forth) == len(registration.warped) != len(direct.back)


def test_the_feature_plane_is_the_patients_seen_from_the_front(judged, pair):
    assert np.array_equal(judged.normal, pair.alignment.target.T_cloud_chest.rotation @ [0, 0, 1])


@pytest.mark.parametrize("in_plane", [False, True])
def test_waypoints_are_judged_by_protocol_and_truth(judged, pair, registration, in_plane):
    moved = registration.transfer(pair.waypoints_ct, 20.0)
    normal = judged.normal if in_plane else None
    assert np.array_equal(judged.moved, moved)
    by_protocol, by_truth = (
        waypoint_errors_mm(moved, goal, normal) for goal in (pair.waypoints_us, pair.true_waypoints)
    )
    assert np.array_equal(judged.protocol_errors_mm(in_plane=in_plane), by_protocol)
    assert np.array_equal(judged.true_waypoint_errors_mm(in_plane=in_plane), by_truth)
    assert by_protocol.mean() != by_truth.mean()


def test_every_point_is_judged_by_its_own_true_place(judged, pair, registration):
    assert np.array_equal(judged.true_point_errors_mm, point_errors_mm(registration.warped, pair.true_points))


def test_the_sphere_decides_what_moves_a_waypoint(pair, registration):
    near, far = (Judgement(pair, registration, radius).moved for radius in (20.0, 40.0))
    assert np.array_equal(far, registration.transfer(pair.waypoints_ct, 40.0))
    assert np.abs(far - near).max() > 0.1


def test_what_several_metrics_share_is_computed_once(judged, monkeypatch):
    calls = Counter()

    def counted(name, function):
        def wrapper(*args, **kwargs):
            calls[name] += 1
            return function(*args, **kwargs)

        return wrapper

    monkeypatch.setattr(distances, "nearest", counted("nearest", distances.nearest))
    monkeypatch.setattr(Registration, "transfer", counted("transfer", Registration.transfer))
    monkeypatch.setattr(judgement, "point_errors_mm", counted("points", judgement.point_errors_mm))
    for _ in range(3):
        assert judged.surface.hausdorff_mm >= judged.surface.hd95_mm
        assert judged.protocol_errors_mm().shape == judged.true_waypoint_errors_mm(in_plane=True).shape
        assert judged.true_point_errors_mm.max() > 0
    assert calls == {"nearest": 2, "transfer": 1, "points": 1}  # one search a direction
