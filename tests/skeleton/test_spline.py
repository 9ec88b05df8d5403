"""The field meets affine motions exactly, any place, and gives up misses for smoothness."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from study.errors import StudyError
from study.skeleton.spline import NodeSpline
from study.types import RigidTransform

NODES = np.random.default_rng(0).uniform([-80, -8, -70], [80, 8, 70], (120, 3))
PLACES = np.random.default_rng(1).uniform([-60, -8, -60], [60, 8, 60], (40, 3))


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["thin_plate_spline", "linear"]), st.sampled_from([0.0, 30.0, 3e3]))
def test_an_affine_motion_costs_nothing(seed, kernel, smoothing):
    rng = np.random.default_rng(seed)
    matrix, shift = np.eye(3) + rng.normal(scale=0.1, size=(3, 3)), rng.normal(scale=20, size=3)
    field = NodeSpline(kernel, smoothing).field(NODES, NODES @ matrix + shift)
    assert field.apply(PLACES) == pytest.approx(PLACES @ matrix + shift, abs=1e-6)


def test_without_smoothing_every_node_is_met_and_with_it_noise_is_not():
    rng = np.random.default_rng(2)
    bent = NODES + np.column_stack([0 * NODES[:, 0], 4 * np.cos(NODES[:, 0] / 50), np.sin(NODES[:, 2] / 40)])
    noisy = bent + rng.normal(scale=1.0, size=bent.shape)
    assert NodeSpline(smoothing=0.0).field(NODES, noisy).apply(NODES) == pytest.approx(noisy, abs=1e-6)
    met, smooth = (
        np.linalg.norm(NodeSpline(smoothing=s).field(NODES, noisy).apply(NODES) - bent, axis=1).mean()
        for s in (0.0, 3000.0)
    )
    assert smooth < 0.75 * met


def test_the_smoother_is_the_field_at_the_nodes():
    moved = NODES + np.random.default_rng(3).normal(size=NODES.shape)
    spline = NodeSpline()
    at_nodes = NODES + spline.smoother(NODES) @ (moved - NODES)
    assert at_nodes == pytest.approx(spline.field(NODES, moved).apply(NODES), abs=1e-8)


def test_it_moves_with_the_frame():
    moved = NODES + np.random.default_rng(3).normal(size=NODES.shape)
    motion = RigidTransform.random(np.random.default_rng(4))
    there = NodeSpline().field(motion.apply(NODES), motion.apply(moved)).apply(motion.apply(PLACES))
    assert there == pytest.approx(motion.apply(NodeSpline().field(NODES, moved).apply(PLACES)), abs=1e-6)


@pytest.mark.parametrize("bad", [{"kernel": "gaussian"}, {"smoothing": -1.0}, {"smoothing": np.nan}])
def test_bad_parameters_are_refused(bad):
    with pytest.raises(StudyError, match="spline: expected"):
        NodeSpline(**bad)
