"""The hand: lines side by side, at its speed along the body."""

import numpy as np
import pytest
from small_sweeps import FRONT

from study.ultrasound.hand import Hand
from study.ultrasound.probe import Probe
from study.ultrasound.skin import Skin


@pytest.fixture(scope="module")
def hand(chest):
    probe = Probe()
    skin = Skin(chest, FRONT, (0.0, 0.0, 1.0), probe.skin_mm)
    return Hand.over(skin, probe, np.full(100, -probe.overlap_mm), np.random.default_rng(0))


def test_lines_run_up_and_down_side_by_side_past_the_anatomy(hand):
    lines = hand.corners.reshape(-1, 2, 2)
    assert len(lines) > 2
    assert (np.diff(lines[:, 0, 0]) > 0).all()
    assert (lines[:, 0, 0] == lines[:, 1, 0]).all()
    assert (np.sign(lines[:, 1, 1] - lines[:, 0, 1]) == (-1.0) ** np.arange(len(lines))).all()
    assert hand.corners[:, 1].min() < hand.skin.low[1]
    assert hand.corners[:, 1].max() > hand.skin.high[1]


def test_the_face_keeps_the_speed_and_follows_the_skin(hand):
    times = np.arange(0.0, hand.duration_s, 0.05)
    rotation, position = hand.poses_at(times)
    assert np.linalg.det(rotation) == pytest.approx(np.ones(len(times)))
    face = position + hand.probe.T_probe_image.translation[2] * rotation[:, :, 2]
    speed = np.linalg.norm(np.diff(face, axis=0), axis=1) / 0.05
    assert np.median(speed) == pytest.approx(hand.probe.speed_mm_s, rel=0.1)
    ab = face @ hand.skin.axes.T
    on_skin, normals = hand.skin.points(ab[:, :2])
    np.testing.assert_allclose(face, on_skin, atol=1e-6)
    tilt_deg = np.degrees(np.arccos(np.einsum("ni,ni->n", -normals, rotation[:, :, 2]).clip(-1, 1)))
    assert 0.5 < np.median(tilt_deg) < 4


def test_the_hand_rests_before_and_after(hand):
    _, position = hand.poses_at(np.array([-1.0, 0.0, hand.duration_s, hand.duration_s + 5.0]))
    np.testing.assert_array_equal(position[[0, 3]], position[[1, 2]])
