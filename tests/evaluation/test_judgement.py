from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from study.errors import StudyError
from study.evaluation import distances, judgement
from study.evaluation.distances import CloudDistances, point_errors_mm, waypoint_errors_mm
from study.evaluation.judgement import Judgement
from study.evaluation.pair import perfect
from study.evaluation.waypoints import intercostal_waypoints
from study.registration import Registration
from study.types import PointCloud, RigidTransform


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


def test_like_for_like_counts_both_directions_of_the_part_that_was_visible_on_the_ct(judged, pair, registration):
    us = pair.alignment.target.cloud.points
    both_ways = CloudDistances.between(registration.warped[pair.visible], us)
    assert np.array_equal(judged.visible_surface.forth, both_ways.forth)
    assert np.array_equal(judged.visible_surface.back, both_ways.back)
    assert 0.3 < pair.visible.mean() < 0.7  # a tube's front
    # Symmetric: the US cloud against the part measures the same.
    other_way = CloudDistances.between(us, registration.warped[pair.visible])
    for measure in ("hausdorff_mm", "hd95_mm", "mean_mm"):
        assert getattr(other_way, measure) == getattr(judged.visible_surface, measure)


def test_like_for_like_sees_no_hidden_point_and_no_method_chooses_what_is_hidden(judged, pair, registration):
    turned = registration.warped.copy()
    turned[~pair.visible] += 30.0 * judged.normal  # backs to the front
    other = Judgement(pair, replace(registration, warped=turned))
    assert other.visible_surface.hausdorff_mm == judged.visible_surface.hausdorff_mm
    assert other.surface.hausdorff_mm > judged.surface.hausdorff_mm + 10


def test_clouds_whose_visible_parts_are_the_same_have_no_distance(pair):
    seen = perfect(pair).warped[pair.visible]
    target = pair.alignment.target
    parts = pair.alignment.source.cloud.parts[pair.visible]
    same = pair.with_target(replace(target, cloud=replace(target.cloud, points=seen, parts=parts)))
    surface = Judgement(same, perfect(pair)).visible_surface
    assert surface.hausdorff_mm == surface.mean_mm == 0
    assert Judgement(same, perfect(pair)).surface.hausdorff_mm > 5


def test_a_perfect_registration_scores_less_where_both_paths_are_cut_from_fronts(pair):
    truth = Judgement(pair, perfect(pair))
    assert truth.visible_protocol_errors_mm(in_depth=True).mean() < 0.4 * truth.protocol_errors_mm(in_depth=True).mean()
    assert truth.visible_surface.hausdorff_mm < truth.surface.hausdorff_mm
    # The part was cut by the protocol itself, from the labels that the CT came with.
    source = pair.alignment.source.cloud
    seen = PointCloud(source.points[pair.visible], "seen", pair.parts_ct[pair.visible])
    assert np.array_equal(pair.visible_waypoints_ct, intercostal_waypoints(seen).points)


def test_a_shift_that_no_method_can_see_counts_end_to_end_but_not_as_registered(pair, registration):
    shift = np.array([1.0, -2.0, 0.5])
    by_shift = RigidTransform(np.eye(3), shift)
    target = pair.alignment.target
    shown = replace(pair.with_target(replace(target, cloud=target.cloud.moved(by_shift))), shift_mm=shift)
    # A method sees the US cloud alone, so its answer goes along.
    before, after = (
        Judgement(pair, registration),
        Judgement(shown, replace(registration, warped=registration.warped + shift)),
    )
    np.testing.assert_allclose(after.registered_waypoint_errors_mm(), before.registered_waypoint_errors_mm())
    np.testing.assert_allclose(before.registered_waypoint_errors_mm(), before.true_waypoint_errors_mm())
    assert np.abs(after.true_waypoint_errors_mm() - before.true_waypoint_errors_mm()).max() > 1
    assert after.surface.hausdorff_mm == pytest.approx(before.surface.hausdorff_mm)


def test_the_plane_and_depth_at_once_are_refused(judged):
    with pytest.raises(StudyError, match="in the plane or in depth, got both"):
        judged.protocol_errors_mm(in_plane=True, in_depth=True)


def test_without_the_sweeps_shift_nothing_is_said_as_registered(pair, registration):
    with pytest.raises(StudyError, match="expected a simulated sweep"):
        Judgement(replace(pair, shift_mm=None), registration).registered_waypoint_errors_mm()


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
        assert judged.visible_surface.hausdorff_mm >= judged.visible_surface.hd95_mm
        assert judged.visible_protocol_errors_mm().shape == judged.registered_waypoint_errors_mm().shape
    # One search a direction and one from the US cloud to the visible part; a path for each set of waypoints.
    assert calls == {"nearest": 3, "transfer": 2, "points": 1}
