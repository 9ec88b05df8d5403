from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planted_registration import SOURCE, T_US_CT, planted

from study import phantom
from study.errors import StudyError
from study.guidance import guide, pull_back
from study.registration import Registration
from study.types import Mesh, RigidTransform, Waypoints
from study.ultrasound.skin import Skin

PATH = Waypoints(SOURCE[:3], ("a", "b", "c"))


@pytest.mark.parametrize(("field", "limit_mm"), [(True, 1e-2), (False, 1.0)])
def test_places_go_back_to_where_they_came_from(field: bool, limit_mm: float) -> None:
    result, rng = planted(field=field), np.random.default_rng(0)
    places = SOURCE + rng.normal(0, 2, SOURCE.shape)  # between the points as well
    moved = planted().carry(places, 8)
    back, known = pull_back(result, moved)
    assert known.all()
    off_mm = np.linalg.norm(back - places, axis=1)
    assert np.percentile(off_mm, 99) < limit_mm
    assert np.linalg.norm(T_US_CT.inverse.apply(moved) - places, axis=1).mean() > 3  # the rigid part alone would not do


@pytest.mark.parametrize("field", [True, False])
def test_far_from_every_point_the_rigid_part_answers(field: bool) -> None:
    far = T_US_CT.apply(np.add(SOURCE[:4], [0.0, 400.0, 0.0]))
    back, known = pull_back(planted(field=field), far)
    assert np.allclose(back, T_US_CT.inverse.apply(far))
    assert known.all()


def test_a_fold_is_said_to_have_no_inverse() -> None:
    result = planted()

    class Fold:
        def apply(self, points: np.ndarray) -> np.ndarray:
            return T_US_CT.apply(T_US_CT.inverse.apply(points) * [-1.5, 1.0, 1.0])

    folded = replace(result, field=Fold())
    back, known = pull_back(folded, result.warped[:50])
    assert not known.any()
    assert np.allclose(back, T_US_CT.inverse.apply(result.warped[:50]))


def test_normals_are_those_of_the_skin() -> None:
    """Under ultrasound of a phantom, against the skin that a virtual probe is moved on."""
    subject, rng = phantom.draw_subject("patient", 0), np.random.default_rng(3)
    us = phantom.anterior_cloud(subject, 3000, 0.5, 2, rng).points
    way = phantom.waypoints(subject)
    whole = phantom.surface.canonical_surface()
    mesh = Mesh(subject.phi.apply(whole.vertices), whole.faces, np.zeros(len(whole.vertices), dtype=np.int64))
    skin = Skin(mesh, [0, 1, 0], [0, 0, 1], skin_mm=15.0)
    _, expected = skin.points(way.points @ skin.axes[:2].T)
    T = RigidTransform.random(rng)
    own = Registration(us, T.apply(us), T, True, 0, "known", front=T.rotation[:, 1])
    guided = guide(replace(own, target=T.apply(us)), way)
    cosine = (guided.normals * (expected @ T.rotation.T)).sum(axis=1)
    assert guided.from_surface.all()
    assert np.degrees(np.arccos(cosine)).max() < 25.0
    assert np.degrees(np.arccos(cosine)).mean() < 12.0
    assert np.linalg.norm(guided.normals, axis=1) == pytest.approx(1.0)


def test_where_no_ultrasound_is_the_normal_is_the_chests_front() -> None:
    result = planted()
    far = result.warped[np.linalg.norm(SOURCE - SOURCE[0], axis=1) > 60]
    guided = guide(replace(result, target=far), PATH)
    assert not guided.from_surface[0]
    assert np.array_equal(guided.normals[0], result.front)
    assert (guided.n_us[0], np.isnan(guided.residual_mm[0])) == (0, True)


def test_quality_of_each_waypoint_and_no_bounds_where_a_method_has_none() -> None:
    result = planted()
    path = Waypoints(np.vstack([SOURCE[0], SOURCE[1] + [0, 9000, 0], SOURCE[2]]), ("a", "far", "c"))
    lifted = result.warped + 2.0 * result.front
    guided = guide(replace(result, target=lifted), path)
    assert guided.bounds_mm is None
    assert guided.ct_distance_mm[[0, 2]].tolist() == [0, 0]
    assert guided.reasons[0] == ""
    assert "expected CT points within 50 mm" in guided.reasons[1]
    assert np.isnan(guided.points[1]).all()
    assert np.isnan(guided.normals[1]).all()
    assert 0.5 < guided.residual_mm[0] <= 2.0
    assert np.allclose(guided.points[0], result.warped[0])
    with pytest.raises(StudyError, match=r"without `front` and `target`"):
        guide(replace(result, front=None), path)
    with pytest.raises(StudyError, match="metres"):
        guide(result, Waypoints(SOURCE[:3] / 1e6, ("a", "b", "c")))
    with pytest.raises(StudyError, match="expected one or more that can be carried, got none: far"):
        guide(result, Waypoints(path.points[1:2], ("far",)))
