"""A perfect registration falls to its floor step by step, and measures are known by the order they give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from study import phantom
from study.alignment.chest import find_chest
from study.alignment.frame import chest_frame
from study.errors import StudyError
from study.evaluation.controls import (
    AS_IT_IS,
    BOTH,
    NO_SWEEP_ERRORS,
    PATH_ALONE,
    STEPS,
    TRUE_ERRORS,
    TWO_SWEEPS,
    VISIBLE_HALF,
    agreement_summary,
    deciding_point,
    rank_agreement,
    truth_floor,
    truth_free_measures,
)
from study.evaluation.distances import CloudDistances
from study.evaluation.judgement import Judgement
from study.evaluation.metrics import METRICS, judge
from study.evaluation.pair import Pair, perfect
from study.evaluation.waypoints import intercostal_waypoints
from study.methods.visible_surface import faces_front
from study.types import Part, PointCloud, RigidTransform

SHIFT = np.array([0.6, -0.9, 0.7])


@pytest.fixture(scope="module")
def sheets(T_us_ras: RigidTransform) -> tuple[PointCloud, PointCloud]:
    """The patient's front in the tracker's frame, sampled twice without noise or gap."""
    patient = phantom.draw_subject("patient", 0)
    one, two = (phantom.anterior_cloud(patient, 3000, 0.0, 0, np.random.default_rng(seed)) for seed in (1, 2))
    return one.moved(T_us_ras), two.moved(T_us_ras)


@pytest.fixture(scope="module")
def undisturbed(pair: Pair, sheets: tuple[PointCloud, PointCloud]) -> Pair:
    """The pair with a cloud of its patient that has no noise and no gap."""
    chest = find_chest(replace(sheets[0], parts=None))
    return replace(pair.with_target(chest), waypoints_us=intercostal_waypoints(sheets[0]).points)


@pytest.fixture(scope="module")
def disturbed(pair: Pair) -> Pair:
    """The pair whose sweep, noisy and with gaps, also shows everything by a shift too far."""
    target, by = pair.alignment.target, RigidTransform(np.eye(3), SHIFT)
    chest = replace(target, cloud=target.cloud.moved(by))
    return replace(pair.with_target(chest), waypoints_us=pair.waypoints_us + SHIFT, shift_mm=SHIFT)


@pytest.fixture(scope="module")
def floor(disturbed: Pair, undisturbed: Pair, sheets: tuple[PointCloud, PointCloud]) -> pd.DataFrame:
    table = truth_floor(disturbed, undisturbed, sheets[1])
    assert list(table.columns) == ["pair", "step", "metric", "value", "change"]
    assert set(table["pair"]) == {"ct1/patient"}
    assert list(dict.fromkeys(table["step"])) == list(STEPS)
    return table.set_index(["step", "metric"])


def test_every_step_is_the_known_deformation_judged_by_the_metrics(
    floor: pd.DataFrame, disturbed: Pair, undisturbed: Pair
) -> None:
    as_it_is, clean = judge(disturbed, perfect(disturbed)), judge(undisturbed, perfect(undisturbed))
    for metric in ("hd", "hd95", "msd", "waypoint_error", "waypoint_error_inplane", "waypoint_error_depth"):
        value = {step: floor.loc[(step, metric), "value"] for step in (AS_IT_IS, NO_SWEEP_ERRORS, VISIBLE_HALF, BOTH)}
        assert value[AS_IT_IS] == as_it_is[metric].mean()
        assert value[NO_SWEEP_ERRORS] == clean[metric].mean()
        assert value[VISIBLE_HALF] == as_it_is[f"visible_{metric}"].mean()
        assert value[BOTH] == clean[f"visible_{metric}"].mean()
        for step, found in value.items():
            assert floor.loc[(step, metric), "change"] == found - value[AS_IT_IS]
    assert floor.loc[(PATH_ALONE, "waypoint_error"), "value"] == clean["true_waypoint_error"].mean()


def test_with_every_step_the_truth_scores_nearer_to_the_floor(floor: pd.DataFrame) -> None:
    value = floor["value"]
    for metric in ("hd95", "msd"):
        assert value[TWO_SWEEPS, metric] < value[BOTH, metric] < value[VISIBLE_HALF, metric] < value[AS_IT_IS, metric]
        # What is left is a rim: the fixture sees steeper flanks than a probe does.
        left, whole = (value[step, metric] - value[TWO_SWEEPS, metric] for step in (BOTH, AS_IT_IS))
        assert left < 0.25 * whole
    # Half a thickness is depth, and goes with the hidden half, not with the sweep's errors.
    depth = value[:, "waypoint_error_depth"]
    assert depth[NO_SWEEP_ERRORS] > 0.7 * depth[AS_IT_IS]
    assert depth[BOTH] < 0.3 * depth[AS_IT_IS]


def test_a_perfect_registration_of_what_is_visible_scores_what_sampling_does(
    pair: Pair, T_us_ras: RigidTransform
) -> None:
    people = [phantom.draw_subject(name, 0) for name in ("ct1", "patient")]
    again = phantom.reference_cloud(people[0], 4000, np.random.default_rng(9))
    there = T_us_ras.apply(phantom.truth_map(*people, again.points))
    seen = faces_front(again.points, chest_frame(again))
    shown = PointCloud(there[seen], "us", again.parts[seen])  # the same front, sampled anew
    target = pair.alignment.target
    like = replace(pair.with_target(replace(target, cloud=shown)), waypoints_us=intercostal_waypoints(shown).points)
    truth, floor = Judgement(like, perfect(pair)), CloudDistances.between(pair.true_points, there)
    assert truth.visible_surface.hd95_mm < 1.15 * floor.hd95_mm
    assert truth.visible_surface.mean_mm < 1.15 * floor.mean_mm
    assert truth.surface.hd95_mm > 3 * floor.hd95_mm
    # The path's floor is the sphere's rigid fit and the cut.
    path = truth.true_waypoint_errors_mm().mean()
    assert truth.visible_protocol_errors_mm().mean() < path + 1.0
    assert truth.visible_protocol_errors_mm(in_depth=True).mean() < path
    assert truth.protocol_errors_mm(in_depth=True).mean() > 2 * path


def test_only_what_a_floor_bounds_has_a_row(floor: pd.DataFrame) -> None:
    rows = floor.reset_index()
    assert set(rows.loc[rows["step"] == TWO_SWEEPS, "metric"]) == set(rows["metric"])
    assert all(name.startswith("waypoint_error") for name in rows.loc[rows["step"] == PATH_ALONE, "metric"])
    assert np.isfinite(rows["value"]).all()


def test_other_people_and_real_people_have_no_floor(
    disturbed: Pair, undisturbed: Pair, real_pair: Pair, sheets: tuple[PointCloud, PointCloud]
) -> None:
    with pytest.raises(StudyError, match="expected ct1/patient without sweep errors, got ct1/other"):
        truth_floor(disturbed, replace(undisturbed, target="other"), sheets[1])
    with pytest.raises(StudyError, match="deformation is known"):
        truth_floor(real_pair, real_pair, sheets[1])


# --- the point that decides ------------------------------------------------------------------------------------------


def test_the_back_that_no_probe_sees_decides_the_score_of_the_truth(undisturbed: Pair) -> None:
    truth = perfect(undisturbed)
    point = deciding_point(undisturbed, truth)
    assert point.cloud == "ct"
    assert not point.visible
    assert point.part == Part.STERNUM  # the thickest
    assert point.distance_mm == judge(undisturbed, truth)["hd"][0]
    assert np.array_equal(point.place, truth.warped[point.row])
    assert np.linalg.norm(point.place - point.partner) == pytest.approx(point.distance_mm)
    assert (undisturbed.alignment.target.cloud.points == point.partner).all(axis=1).any()
    assert f"{point.distance_mm:.1f} mm at unseen point {point.row} of the CT, STERNUM" == str(point)


@pytest.mark.parametrize("part", [Part.RIGHT_5, Part.LEFT_2])
def test_a_planted_outlier_decides_in_either_cloud(undisturbed: Pair, part: Part) -> None:
    truth, far = perfect(undisturbed), np.array([0.0, 0.0, 80.0])
    row = int(np.flatnonzero(undisturbed.visible & (undisturbed.parts_ct == part))[0])
    warped = truth.warped.copy()
    warped[row] += far
    point = deciding_point(undisturbed, replace(truth, warped=warped))
    assert (point.cloud, point.row, point.part, point.visible) == ("ct", row, part, True)

    target = undisturbed.alignment.target
    row = int(np.flatnonzero(target.cloud.parts == part)[0])
    points = target.cloud.points.copy()
    points[row] += far
    astray = undisturbed.with_target(replace(target, cloud=replace(target.cloud, points=points)))
    point = deciding_point(astray, truth)
    assert (point.cloud, point.row, point.part, point.visible) == ("us", row, part, True)


# --- who orders the methods as truth does ----------------------------------------------------------------------------

GOOD, BAD = "visible_msd", "hd"


def table(orders: dict[str, list[float]], pairs: int = 2, dataset: str = "made") -> pd.DataFrame:
    """Metrics of methods m0, m1, ... with the values of each metric; a waypoint metric has two waypoints."""
    rows = []
    for pair in range(pairs):
        for metric, values in orders.items():
            for method, value in enumerate(values):
                case = {"dataset": dataset, "source": f"ct{pair}", "target": "p", "method": f"m{method}", "seed": 0}
                spread = (-0.25, 0.25) if "waypoint" in metric else (0.0,)
                rows += [
                    {**case, "metric": metric, "index": k, "value": value + off, "unit": "mm", "status": "ok"}
                    for k, off in enumerate(spread)
                ]
    return pd.DataFrame(rows)


MADE = {
    "true_waypoint_error": [1.0, 2.0, 3.0, 4.0],
    "true_waypoint_error_inplane": [2.0, 1.0, 3.0, 4.0],
    "registered_waypoint_error": [4.0, 3.0, 2.0, 1.0],
    GOOD: [0.1, 0.2, 0.9, 50.0],  # ranks, not sizes
    BAD: [9.0, 8.0, 7.5, 7.0],
}


def test_the_same_order_is_1_the_reverse_is_minus_1() -> None:
    found = rank_agreement(table(MADE), [GOOD, BAD])
    assert len(found) == 2 * 2 * 3
    assert set(found["n"]) == {4}
    rho = found.groupby(["measure", "truth"])["rho"].agg(["min", "max"])
    assert np.allclose(rho.loc[(GOOD, "true_waypoint_error")], 1)
    assert np.allclose(rho.loc[(BAD, "true_waypoint_error")], -1)
    assert np.allclose(rho.loc[(GOOD, "registered_waypoint_error")], -1)
    assert np.allclose(rho.loc[(GOOD, "true_waypoint_error_inplane")], 0.8)  # 1 - 6 (1 + 1) / (4 * 15)


def test_each_pair_and_data_set_counts_for_itself() -> None:
    turned = table({**MADE, GOOD: MADE[BAD]}, pairs=1).assign(source="ct9")
    other = table(MADE, pairs=3, dataset="other")
    found = rank_agreement(pd.concat([table(MADE), turned, other]), [GOOD], ["true_waypoint_error"])
    summary = agreement_summary(found)
    here, there = (summary.loc[(name, GOOD, "true_waypoint_error")] for name in ("made", "other"))
    assert here.to_list() == pytest.approx([(1 + 1 - 1) / 3, -1, 1, 3])
    assert there.to_list() == pytest.approx([1, 1, 1, 3])


def test_truth_itself_and_methods_without_a_value_do_not_count() -> None:
    made = table(MADE, pairs=1)
    truth = made[made["method"] == "m0"].assign(method="truth", value=1000.0)
    lost = made.index[(made["method"] == "m3") & (made["metric"] == GOOD)]
    failed = made.loc[lost].assign(metric="case", value=np.nan, status="failed: no sternum")
    found = rank_agreement(pd.concat([made.drop(lost), failed, truth]), [GOOD], ["true_waypoint_error"])
    assert found[["rho", "n"]].to_numpy().tolist() == [[pytest.approx(1), 3]]


def test_equal_values_have_no_order_and_real_people_no_truth() -> None:
    flat = rank_agreement(table({**MADE, GOOD: [1.0] * 4}, pairs=1), [GOOD])
    assert flat["rho"].isna().all()
    assert set(agreement_summary(flat)["n"]) == {0}
    real = table({GOOD: MADE[GOOD], BAD: MADE[BAD]}, pairs=1, dataset="open")
    assert set(rank_agreement(pd.concat([table(MADE), real]), [GOOD])["dataset"]) == {"made"}
    with pytest.raises(StudyError, match="expected rows of pairs with a known truth, got none of true_waypoint_error"):
        rank_agreement(real, [GOOD])


def test_two_methods_are_too_few() -> None:
    two = table({name: values[:2] for name, values in MADE.items()}, pairs=1)
    with pytest.raises(StudyError, match="ct0/p: expected 3 methods with visible_msd and true_waypoint_error, got 2"):
        rank_agreement(two, [GOOD])


def test_all_measures_that_need_no_truth_are_compared_with_all_that_do() -> None:
    assert set(truth_free_measures()) | set(TRUE_ERRORS) <= set(METRICS)
    assert not any(METRICS[name].needs_truth for name in truth_free_measures())
    assert all(METRICS[name].needs_truth for name in TRUE_ERRORS)
    every = {name: MADE[GOOD] for name in truth_free_measures()}
    found = rank_agreement(table({**MADE, **every}, pairs=1))
    assert list(dict.fromkeys(found["measure"])) == list(truth_free_measures())
    assert list(dict.fromkeys(found["truth"])) == list(TRUE_ERRORS)
