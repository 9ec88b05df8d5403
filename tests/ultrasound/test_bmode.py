"""Simulated B-mode shows what its docstring says: a bright line, what lies behind it, and its reflection."""

import numpy as np
import pytest

from study.errors import StudyError
from study.ultrasound.bmode import BONE, CARTILAGE, simulate_bmode

SPACING = (0.2, 0.2)


def flat_masks(n=4, depth_row=60, columns=slice(0, 200)):
    masks = np.zeros((n, 175, 200), dtype=bool)
    masks[:, depth_row : depth_row + 5, columns] = True
    return masks


def profile(echo):
    """Mean grey level by row."""
    return simulate_bmode(flat_masks(), SPACING, np.random.default_rng(0), echo=echo).mean(axis=(0, 2))


def test_bone_is_a_bright_line_before_a_shadow_with_its_reflection():
    mean = profile(BONE)
    assert abs(int(mean.argmax()) - 60) <= 1
    tissue, shadow = mean[30:50].mean(), mean[75:110].mean()
    assert mean[60] > tissue + 60
    assert shadow < tissue - 40
    twice = 2 * 59.5
    assert abs(int(mean[105:135].argmax()) + 105 - twice) <= 2
    assert mean[118:121].max() > shadow + 20


def test_cartilage_lets_the_beam_through():
    mean = profile(CARTILAGE)
    back = 59.5 + CARTILAGE.thickness_mm / SPACING[1]
    assert abs(int(mean[90:120].argmax()) + 90 - back) <= 2
    assert mean[125:160].mean() > mean[70:95].mean() + 30  # tissue behind, dark inside


def test_speckle_is_that_of_many_scatterers():
    """The envelope of fully developed speckle is Rayleigh's: its mean is 1.91 of its deviation."""
    empty = np.zeros((6, 175, 200), dtype=bool)
    images = simulate_bmode(empty, SPACING, np.random.default_rng(1)).astype(float)
    envelope = 10 ** ((images / 255 * 50 - 24) / 20)
    ratios = [patch.mean() / patch.std() for patch in (envelope[:, r : r + 20, c : c + 40] for r in (60, 100, 140)
                                                       for c in (0, 60, 120)) for patch in patch]  # fmt: skip
    assert 1.5 < np.median(ratios) < 2.2


def test_draws_come_from_the_generator():
    first, again, other = (simulate_bmode(flat_masks(1), SPACING, np.random.default_rng(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5


def test_what_is_no_stack_is_refused():
    with pytest.raises(StudyError, match="frames, rows, columns"):
        simulate_bmode(np.zeros((5, 5), bool), SPACING, np.random.default_rng(0))
