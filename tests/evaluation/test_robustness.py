"""What is not disturbed is an ordinary registration; what is refused or fails is counted, never lost."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from study.alignment.chest import align
from study.errors import StudyError
from study.evaluation import robustness
from study.evaluation.distances import waypoint_errors_mm
from study.evaluation.disturbances import Disturbance, disturbed_pair
from study.evaluation.robustness import (
    BY_HAND,
    ERROR,
    FAILED,
    IN_PLANE,
    OK,
    WARNED,
    robustness_rows,
    robustness_summary,
)
from study.pipeline import find_method, register_aligned

SMALL = Disturbance(noise_mm=0.0, ct_points=3000, us_points=2500)
METHODS = ("coarse", "icp_tuned")
DRAW = 523


def test_no_disturbance_is_the_undisturbed_registration():
    rows = robustness_rows(SMALL, DRAW, METHODS)
    pair = disturbed_pair(SMALL, DRAW)
    alignment = align(replace(pair.ct, parts=None), replace(pair.us, parts=None))
    expected = []
    for name in METHODS:
        moved = register_aligned(alignment, find_method(name), np.random.default_rng(0)).transfer(pair.waypoints)
        plane = alignment.target.T_cloud_chest.rotation[:, 2]
        expected += [waypoint_errors_mm(moved, pair.goal).mean(), waypoint_errors_mm(moved, pair.goal, plane).mean()]
    assert [row["value"] for row in rows] == expected
    assert [(row["method"], row["metric"]) for row in rows] == [(m, k) for m in METHODS for k in (ERROR, IN_PLANE)]
    assert {row["status"] for row in rows} == {OK}
    assert robustness_rows(SMALL, DRAW, METHODS) == rows


def test_what_the_coarse_alignment_refuses_is_started_by_hand_and_said():
    rows = robustness_rows(replace(SMALL, branch_share=1.0), DRAW, ("coarse",))
    assert {row["status"] for row in rows} == {BY_HAND}
    assert all("expected" in row["reason"] for row in rows)
    careful = robustness_rows(Disturbance(noise_mm=0.0), DRAW, ("coarse",))
    whole = disturbed_pair(replace(SMALL, branch_share=1.0), DRAW)
    assert len(whole.us) < SMALL.us_points
    assert rows[0]["value"] == pytest.approx(careful[0]["value"], abs=0.05)  # from there, carried by its own points


def test_a_method_that_fails_is_a_row_and_the_others_stay(monkeypatch):
    def picky(alignment, method, rng, name):
        if name == "coarse":
            raise StudyError("expected luck,\ngot none")
        return register_aligned(alignment, method, rng, name)

    monkeypatch.setattr(robustness, "register_aligned", picky)
    rows = robustness_rows(SMALL, DRAW, METHODS)
    assert [row["status"] for row in rows] == [FAILED, FAILED, OK, OK]
    assert [row["value"] is None for row in rows] == [True, True, False, False]
    assert rows[0]["reason"] == "expected luck, got none"


def test_a_pair_that_cannot_be_made_is_a_failure_of_every_method():
    rows = robustness_rows(replace(SMALL, voxel_mm=9.0), DRAW, METHODS)
    assert {row["status"] for row in rows} == {FAILED}
    assert len(rows) == 4


def test_a_summary_counts_every_draw_and_takes_its_median_over_those_with_a_value():
    status = [OK, WARNED, BY_HAND, FAILED, FAILED]
    values = [1.0, 2.0, 6.0, None, None]
    table = pd.DataFrame(
        [
            {"kind": "noise", "level": 1.0, "method": m, "metric": ERROR, "draw": k, "value": v, "status": s}
            for m in METHODS
            for k, (v, s) in enumerate(zip(values, status, strict=True))
            if m == "coarse" or s == FAILED
        ]
    )
    one, lost = robustness_summary(table).to_dict("records")
    assert (one["draws"], one["warned"], one["by_hand"], one["failed"]) == (5, 1, 1, 2)
    assert (one["median"], one["low"], one["high"]) == (2.0, 1.0, 6.0)
    assert (one["p5"], one["p95"]) == pytest.approx((1.1, 5.6))
    assert (lost["draws"], lost["failed"]) == (2, 2)
    assert np.isnan(lost["median"])
