"""The error budget: every case has its rows, a refused sweep is started by hand, an error switched on moves points."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small_sweeps import FRONT

from study import phantom
from study.errors import StudyError
from study.evaluation import budget as budgets
from study.evaluation.budget import Budget, Scanned, SweepOf, error_budget
from study.evaluation.pair import Pair, align_pair
from study.geometry.rays import surface_distance_mm
from study.phantom.surface import canonical_surface
from study.seeds import named_rng
from study.types import Mesh, PointCloud, RigidTransform
from study.ultrasound.cloud import contour_points, sweep_cloud
from study.ultrasound.probe import Probe
from study.ultrasound.sweep_errors import SweepErrors, budget_cases
from study.ultrasound.tracked import TrackedSweep
from study.ultrasound.virtual_sweep import simulate_sweep
from study.ultrasound.visible import true_parts, visible_mesh

SPACING_MM = 3.0
COARSE_PROBE = Probe(pixel_mm=0.8, frames_per_s=10.0)  # a sweep in a fraction of a second
T_US_RAS = RigidTransform.random(np.random.default_rng(5))
CLOUD_METRICS = {"surface_distance", "covered", "moved"}
PATH_METRICS = {"waypoint_error", "waypoint_error_inplane"}


@pytest.fixture(scope="module")
def scanned() -> Scanned:
    surface, subject = canonical_surface(), phantom.draw_subject("patient", 1)
    parts = np.empty(len(surface.vertices), dtype=np.int64)
    parts[surface.faces] = surface.parts[:, None]
    mesh = Mesh(subject.phi.apply(surface.vertices), surface.faces, parts, name="patient")
    return Scanned(mesh, visible_mesh(mesh, FRONT, step_mm=1.5), T_US_RAS, phantom.waypoints(subject).points)


def sweep_over(scanned: Scanned, errors: SweepErrors, repeat: int) -> TrackedSweep:
    rng = named_rng(0, f"sweep/{repeat}")
    return simulate_sweep(
        scanned.surface, FRONT, errors, rng, T_base_patient=T_US_RAS, name="patient", probe=COARSE_PROBE
    )


@pytest.fixture(scope="module")
def pair(scanned) -> Pair:
    subject = phantom.draw_subject("ct1", 1)
    ct = phantom.reference_cloud(subject, 2000, np.random.default_rng(0))
    us = sweep_cloud(sweep_over(scanned, SweepErrors.none(), 0), spacing_mm=SPACING_MM)
    cloud = replace(us.cloud, front=us.front)
    labelled = replace(cloud, parts=true_parts(scanned.in_ras(cloud.points), scanned.surface))
    bare = PointCloud(ct.points, ct.name)
    return align_pair(bare, cloud, phantom.waypoints(subject).points, labelled, names=("ct1", "patient"))


def run(pair: Pair, scanned: Scanned, sweep_of: SweepOf | None = None, repeats: int = 1, **options: Any) -> Budget:
    def healthy(errors: SweepErrors, repeat: int) -> TrackedSweep:
        return sweep_over(scanned, errors, repeat)

    return error_budget(pair, scanned, sweep_of or healthy, seed=0, repeats=repeats, spacing_mm=SPACING_MM, **options)


@pytest.fixture(scope="module")
def every_case(pair, scanned) -> Budget:
    """All cases, with the chest of the sweep without errors for every sweep: finding it anew takes most of the time."""
    chest = pair.alignment.target

    def known(cloud: PointCloud):
        parts = true_parts(scanned.in_ras(cloud.points), scanned.surface)
        return replace(chest, cloud=replace(cloud, parts=parts))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(budgets, "find_chest", known)
        return run(pair, scanned, methods=("coarse",))


@pytest.fixture(scope="module")
def three_cases(pair, scanned) -> Budget:
    """The real coarse alignment; of the sweep with every error, the second half has nothing in its masks."""

    def sweep_of(errors: SweepErrors, repeat: int) -> TrackedSweep:
        sweep = sweep_over(scanned, errors, repeat)
        kept = np.arange(sweep.n_frames) < (sweep.n_frames // 2 if errors == SweepErrors() else sweep.n_frames)
        return replace(sweep, masks=sweep.masks & kept[:, None, None])

    chosen = [case for case in budget_cases() if case[0] in ("none", "calibration", "all")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(budgets, "budget_cases", lambda: chosen)
        return run(pair, scanned, sweep_of, methods=("coarse", "icp"))


def test_every_case_has_its_rows_in_order(every_case):
    names = [name for name, _ in budget_cases()]
    assert every_case.errors == names
    assert every_case.methods == ["coarse"]
    for name in names:
        mine = every_case.rows[every_case.rows["error"] == name]
        metrics = set(mine["metric"])
        assert metrics - {"moved"} == (CLOUD_METRICS | PATH_METRICS) - {"moved"}, name
        assert len(mine) == len(metrics), name
        assert set(mine.loc[mine["metric"].isin(CLOUD_METRICS), "method"]) == {""}
        assert set(mine.loc[mine["metric"].isin(PATH_METRICS), "method"]) == {"coarse"}
        assert np.isfinite(mine["value"]).all()
    assert every_case.refused.empty
    assert every_case.by_hand().tolist() == [0] * len(names)


def test_an_error_switched_on_moves_points_and_none_moves_none(every_case):
    moved = every_case.mean("moved")[""]
    assert moved["none"] == 0
    assert moved["calibration"] == pytest.approx(1.0, abs=0.2)  # its size, and 0.3° about the middle of the image
    assert moved["latency"] == pytest.approx(0.268 * COARSE_PROBE.speed_mm_s, rel=0.1)
    assert moved["speed of sound"] == pytest.approx(0.69, abs=0.05)
    # Other frames or columns see the surface: points do not pair.
    assert moved[["dropped frames", "missed strips", "breathing"]].isna().all()


def test_the_costs_of_the_cloud_are_those_of_its_sweep(every_case, scanned):
    errors = SweepErrors.only("latency")
    sweep = sweep_over(scanned, errors, 0)
    points = T_US_RAS.inverse.apply(sweep_cloud(sweep, spacing_mm=SPACING_MM).cloud.points)
    mean = {metric: every_case.mean(metric)[""] for metric in CLOUD_METRICS}
    assert mean["surface_distance"]["latency"] == surface_distance_mm(points, scanned.visible).mean()
    gaps = np.linalg.norm(scanned.visible.vertices[:, None] - points[None], axis=2).min(axis=1)
    assert mean["covered"]["latency"] == pytest.approx(100 * np.mean(gaps < 1.25 * SPACING_MM))
    clean = contour_points(sweep_over(scanned, SweepErrors.none(), 0))[0]
    assert mean["moved"]["latency"] == np.linalg.norm(contour_points(sweep)[0] - clean, axis=1).mean()
    assert mean["covered"]["latency"] < mean["covered"]["none"]


def test_the_error_of_a_path_is_the_distance_from_where_it_belongs(every_case, pair, scanned):
    """The coarse alignment alone moves all waypoints by its rigid motion."""
    carried = pair.alignment.T_us_ct.apply(pair.waypoints_ct)
    offsets = carried - T_US_RAS.apply(scanned.waypoints)
    normal = pair.alignment.target.T_cloud_chest.rotation[:, 2]
    flat = offsets - np.outer(offsets @ normal, normal)
    for metric, expected in (("waypoint_error", offsets), ("waypoint_error_inplane", flat)):
        value = every_case.mean(metric).loc["none", "coarse"]
        assert value == pytest.approx(np.linalg.norm(expected, axis=1).mean())


def test_a_refused_sweep_is_listed_and_started_by_hand(three_cases):
    assert three_cases.refused[["error", "sweep"]].to_numpy().tolist() == [["all", 0]]
    assert three_cases.refused["reason"].iloc[0].startswith("patient: expected")
    assert three_cases.by_hand().to_dict() == {"none": 0, "calibration": 0, "all": 1}
    # By hand is from the place of the sweep without errors: what has not moved on from there costs the same.
    for metric in PATH_METRICS:
        costs = three_cases.mean(metric)
        assert costs.loc["all", "coarse"] == costs.loc["none", "coarse"]
        assert costs.loc["all", "icp"] != costs.loc["none", "icp"]
        assert costs.loc["calibration", "coarse"] != costs.loc["none", "coarse"]


def test_a_sweep_without_errors_that_is_refused_ends_the_budget(pair, scanned, monkeypatch):
    def refuse(cloud: PointCloud):
        raise StudyError("no sternum")

    monkeypatch.setattr(budgets, "find_chest", refuse)
    with pytest.raises(StudyError, match="no sternum"):
        run(pair, scanned)


def test_each_repeat_starts_by_hand_from_its_own_sweep(pair, scanned, monkeypatch):
    """Two sweeps, both refused with their error: the first's chest must not serve the second."""
    cases = [case for case in budget_cases() if case[0] in ("none", "calibration")]
    monkeypatch.setattr(budgets, "budget_cases", lambda: cases)
    shifts = iter([0.0, None, 7.0, None])
    normal = pair.alignment.target.T_cloud_chest.rotation[:, 0]

    def find(cloud: PointCloud):
        shift = next(shifts)
        if shift is None:
            raise StudyError("refused")
        chest, parts = pair.alignment.target, true_parts(scanned.in_ras(cloud.points), scanned.surface)
        moved = RigidTransform(translation=shift * normal) @ chest.T_cloud_chest
        return replace(chest, cloud=replace(cloud, parts=parts), T_cloud_chest=moved)

    monkeypatch.setattr(budgets, "find_chest", find)
    found = run(pair, scanned, repeats=2, methods=("coarse",))
    assert found.refused[["error", "sweep"]].to_numpy().tolist() == [["calibration", 0], ["calibration", 1]]
    values = found.rows[found.rows["metric"] == "waypoint_error_inplane"].pivot(
        index="repeat", columns="error", values="value"
    )
    assert (values["none"] == values["calibration"]).all()
    assert abs(values["none"][1] - values["none"][0]) > 1


def test_all_methods_but_the_coarse_alignment_alone_are_judged_when_none_is_named(pair, scanned, monkeypatch):
    monkeypatch.setattr(budgets, "budget_cases", lambda: [("none", SweepErrors.none())])
    monkeypatch.setattr(
        budgets, "_path_costs", lambda _pair, _chest, _scanned, methods, *_: [{"method": m} for m in methods]
    )
    found = run(pair, scanned)
    assert found.methods == [name for name in budgets.METHODS if name != "coarse"]
