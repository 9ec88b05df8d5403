"""Waypoints move as the cloud around them does, or not at all."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from study.errors import StudyError
from study.registration import FieldRegistration, Registration, transfer
from study.types import RigidTransform

WALL = np.random.default_rng(0).uniform([-60, -5, -60], [60, 5, 60], (2000, 3))
WAYPOINTS = np.random.default_rng(1).uniform([-50, -15, -50], [50, 15, 50], (20, 3))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.sampled_from([12.0, 20.0, 500.0]))
def test_a_rigid_transform_is_reproduced_exactly(seed, radius_mm):
    motion = RigidTransform.random(np.random.default_rng(seed))
    moved = transfer(WALL, motion.apply(WALL), WAYPOINTS, radius_mm=radius_mm)
    assert moved == pytest.approx(motion.apply(WAYPOINTS), abs=1e-9)


def test_only_the_sphere_of_the_paper_counts():
    wild = WALL.copy()
    far = np.linalg.norm(WALL - WAYPOINTS[0], axis=1) > 20.0
    wild[far] += np.random.default_rng(2).normal(scale=100, size=(far.sum(), 3))
    assert transfer(WALL, wild, WAYPOINTS[:1])[0] == pytest.approx(WAYPOINTS[0], abs=1e-9)
    assert np.linalg.norm(transfer(WALL, wild, WAYPOINTS[:1], radius_mm=40.0)[0] - WAYPOINTS[0]) > 0.1


def test_a_mirrored_cloud_moves_waypoints_by_rotations_only():
    moved = transfer(WALL, WALL * [1, -1, 1], WAYPOINTS, radius_mm=500.0)
    before, after = (np.linalg.norm(p[:, None] - p[None], axis=2) for p in (WAYPOINTS, moved))
    assert after == pytest.approx(before, abs=1e-6)  # one sphere holds all: one rigid motion
    a, b = WAYPOINTS[1:4] - WAYPOINTS[0], moved[1:4] - moved[0]
    assert np.linalg.det(b) == pytest.approx(np.linalg.det(a), rel=1e-6)  # handedness kept


def test_an_empty_sphere_is_an_error_that_names_the_waypoint():
    waypoints = np.vstack([WAYPOINTS[:2], [0, 200.0, 0]])
    with pytest.raises(StudyError, match=r"waypoint 2: expected at least 3 CT points .* within 20 mm, got 0; check"):
        transfer(WALL, WALL, waypoints)
    two = np.vstack([WALL[:1], WALL[:1] + 1.0])
    with pytest.raises(StudyError, match=r"waypoint 0: expected at least 3 CT points .* got 2"):
        transfer(two, two, two[:1])


def test_points_on_a_line_cannot_carry_a_waypoint():
    line = np.outer(np.linspace(-50, 50, 200), [1.0, 2.0, -0.5])
    with pytest.raises(StudyError, match="waypoint 0: expected at least 3 CT points off a line"):
        transfer(line, line, np.array([[0, 1.0, 0]]))


@pytest.mark.parametrize("radius_mm", [0.0, -1.0, float("nan")])
def test_a_sphere_without_a_size_is_refused(radius_mm):
    with pytest.raises(StudyError, match="expected radius_mm > 0, got"):
        transfer(WALL, WALL, WAYPOINTS, radius_mm=radius_mm)


def test_waypoints_are_checked():
    for bad, message in (([[0, 0]], "expected shape"), ([[0, 0, np.nan]], "expected finite"), ([], "expected shape")):
        with pytest.raises(StudyError, match=message):
            transfer(WALL, WALL, bad)


def test_clouds_that_do_not_pair_are_refused():
    with pytest.raises(StudyError, match=r"expected one warped point per source point, got \(2000, 3\) and"):
        transfer(WALL, WALL[:-1], WAYPOINTS)
    with pytest.raises(StudyError, match="warped: expected finite numbers, got 1 rows"):
        transfer(WALL, np.where(np.arange(2000)[:, None] == 5, np.nan, WALL), WAYPOINTS)


def test_a_registration_offers_the_verb():
    motion = RigidTransform.random(np.random.default_rng(4))
    result = Registration(WALL, motion.apply(WALL), motion, True, 1, "planted")
    assert result.transfer(WAYPOINTS.tolist()) == pytest.approx(motion.apply(WAYPOINTS), abs=1e-9)
    assert result.transfer(WAYPOINTS, radius_mm=30) == pytest.approx(motion.apply(WAYPOINTS), abs=1e-9)
    with pytest.raises(StudyError, match=r"within 0\.1 mm"):
        result.transfer(WAYPOINTS, radius_mm=0.1)


class Bend:
    """A field that no rigid fit follows."""

    def apply(self, points):
        return points + np.column_stack([0 * points[:, 0], 9 * np.sin(points[:, 0] / 9), 0 * points[:, 0]])


def bent_wall(motion):
    warped = Bend().apply(motion.apply(WALL))
    return FieldRegistration(WALL, warped, motion, True, 1, "planted", field=Bend())


def test_a_field_carries_waypoints_itself_wherever_the_ct_lies():
    motion = RigidTransform.random(np.random.default_rng(4), shift_mm=20.0)
    result = bent_wall(motion)
    truth = Bend().apply(motion.apply(WAYPOINTS))
    assert result.transfer(WAYPOINTS.tolist()) == pytest.approx(truth, abs=1e-9)
    assert np.linalg.norm(transfer(WALL, result.warped, WAYPOINTS) - truth, axis=1).max() > 1.0  # the sphere cannot
    assert result.carry(WALL) == pytest.approx(result.warped, abs=1e-9)


def test_a_field_says_nothing_far_from_the_cloud():
    waypoints = np.vstack([WAYPOINTS[:2], [0, 200.0, 0]])
    result = bent_wall(RigidTransform())
    path = result.carry_path(waypoints)
    assert path.reasons[:2] == ("", "")
    assert "expected CT points within 50 mm, got none within 195" in path.reasons[2]
    assert np.isnan(path.points[2]).all()
    assert np.isfinite(path.points[:2]).all()
    with pytest.raises(StudyError, match="waypoint 2: expected CT points within 50 mm"):
        result.transfer(waypoints, radius_mm=300.0)


def test_waypoints_for_a_field_are_checked_like_those_for_a_sphere():
    result = bent_wall(RigidTransform())
    with pytest.raises(StudyError, match="expected a path in millimetres"):
        result.transfer(WAYPOINTS / 1000)
    with pytest.raises(StudyError, match="expected finite"):
        result.transfer([[0, 0, np.nan]])


def test_a_registration_shows_itself_in_a_notebook():
    motion = RigidTransform.random(np.random.default_rng(4))
    bent = motion.apply(WALL) + motion.rotation @ [0, 3.0, 0]
    result = Registration(WALL, bent, motion, False, 1200, "limit <b>", seconds=1.26, warnings=("thin", "sparse"))
    words = result._repr_html_()
    for word in ("2,000", "no", "1,200", "limit &lt;b&gt;", "thin; sparse", "1.3", "0 to 3.0 mm", "unnamed"):
        assert f">: {word}<" in words or word in words, word
    assert "<b>limit" not in words
    assert len(words) < 20_000
    assert "Registration: icp" in replace(result, method="icp")._repr_html_()
