import pickle
from dataclasses import replace

import numpy as np
import pytest

from study.alignment.chest import find_chest
from study.errors import StudyError
from study.evaluation import pair as module
from study.evaluation.pair import TRUTH, align_pair, perfect
from study.evaluation.waypoints import intercostal_waypoints


def test_a_pair_is_aligned_and_its_patient_cut_by_the_protocol(real_pair, ct_clouds, us_cloud):
    assert (real_pair.source, real_pair.target, real_pair.name) == ("ct1", "patient", "ct1/patient")
    source, target = real_pair.alignment.source, real_pair.alignment.target
    assert np.array_equal(source.cloud.points, ct_clouds["ct1"].points)
    assert len(target.cloud) == len(us_cloud)
    labelled = replace(target.cloud, parts=us_cloud.parts)  # row i is point i in any frame
    assert np.array_equal(real_pair.waypoints_us, intercostal_waypoints(labelled).points)
    # After coarse alignment of two phantoms waypoints are millimetres apart; unaligned they are decimetres.
    carried = real_pair.alignment.T_us_ct.apply(real_pair.waypoints_ct)
    assert np.linalg.norm(carried - real_pair.waypoints_us, axis=1).mean() < 15


def test_chests_at_hand_are_not_searched_again(real_pair, monkeypatch):
    monkeypatch.setattr(module, "find_chest", None)
    chests = real_pair.alignment.source, real_pair.alignment.target
    clouds = [chest.cloud for chest in chests]
    again = align_pair(*clouds, real_pair.waypoints_ct, clouds[1], names=("a", "b"), chests=chests)
    assert (again.alignment.source, again.alignment.target) == chests


def test_another_cloud_of_the_patient_changes_nothing_else(pair, us_cloud):
    chest = find_chest(us_cloud)
    other = pair.with_target(chest)
    assert other.alignment.target is chest
    assert other.alignment.source is pair.alignment.source
    assert replace(other, alignment=pair.alignment) == pair


def test_a_ct_without_parts_of_its_own_is_cut_by_those_of_the_coarse_alignment(real_pair, ct_clouds):
    chests = real_pair.alignment.source, real_pair.alignment.target
    bare = replace(ct_clouds["ct1"], parts=None)
    found = align_pair(bare, chests[1].cloud, real_pair.waypoints_ct, chests[1].cloud, names=("a", "b"), chests=chests)
    assert found.parts_ct is None
    assert np.array_equal(found.visible, real_pair.visible)
    as_segmented = replace(found, parts_ct=chests[0].cloud.parts)
    assert np.array_equal(found.visible_waypoints_ct, as_segmented.visible_waypoints_ct)
    assert not np.array_equal(found.visible_waypoints_ct, real_pair.visible_waypoints_ct)


def test_what_is_visible_is_found_once_and_goes_along_to_the_workers(real_pair, monkeypatch):
    seen, waypoints = real_pair.visible, real_pair.visible_waypoints_ct
    there = pickle.loads(pickle.dumps(real_pair))
    monkeypatch.setattr(module, "faces_front", None)
    monkeypatch.setattr(module, "intercostal_waypoints", None)
    assert np.array_equal(there.visible, seen)
    assert np.array_equal(there.visible_waypoints_ct, waypoints)


def test_a_perfect_registration_is_the_truth_itself(pair):
    result = perfect(pair)
    assert pair.has_truth
    assert result.method == TRUTH
    assert result.converged
    assert np.array_equal(result.warped, pair.true_points)
    assert result.source is pair.alignment.source.cloud.points
    # Waypoints follow the points around them: to within what a local rigid fit leaves of a smooth deformation.
    assert np.linalg.norm(result.transfer(pair.waypoints_ct) - pair.true_waypoints, axis=1).max() < 2


def test_two_real_people_have_no_perfect_registration(real_pair):
    assert not real_pair.has_truth
    with pytest.raises(StudyError, match="ct1/patient: expected a pair whose deformation is known, got two real"):
        perfect(real_pair)
