"""One pair from start to end, from any pose, and from the package's front door."""

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from oracles import toy_chest
from scipy.spatial import KDTree
from threadpoolctl import threadpool_info, threadpool_limits

import study
from study import METHODS, phantom, register_pair
from study.alignment.chest import align, find_chest
from study.errors import StudyError
from study.files.clouds import read_ply
from study.files.plus import read_plus
from study.methods.coarse_only import CoarseOnly
from study.pipeline import _even_chest, find_method, register_aligned, run_method
from study.registration import Registration, transfer
from study.seeds import named_rng
from study.types import PointCloud, RigidTransform
from study.ultrasound.cloud import sweep_cloud, thin_evenly


def test_the_front_door_holds_what_others_rely_on():
    assert register_pair is study.pipeline.register_pair
    assert METHODS is study.methods.METHODS
    assert study.StudyError is StudyError
    assert (study.PointCloud, study.Registration) == (PointCloud, Registration)
    assert (study.transfer, study.sweep_cloud, study.read_plus) == (transfer, sweep_cloud, read_plus)
    assert study.__version__
    assert {getattr(study, name) is not None for name in study.__all__} == {True}
    assert set(study.__all__) <= set(dir(study))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = study.nonsense


SLOW = ("open3d", "trimesh", "pycpd")


def loaded(imports: str, *names: str) -> list[str]:
    """Which of ``names`` a fresh interpreter has after ``imports``."""
    code = f"import sys, {imports}; print(*[name for name in {names!r} if name in sys.modules])"
    return subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, encoding="utf-8"
    ).stdout.split()


def test_importing_the_package_imports_no_method():
    assert loaded("study", *SLOW, "sklearn", "numpy") == []


def test_the_names_of_the_methods_cost_no_slow_library():
    assert loaded("study.methods", *SLOW, "study.methods") == ["study.methods"]


def test_what_runs_methods_has_their_libraries_before_it_limits_the_threads():
    assert loaded("study.pipeline", *SLOW) == list(SLOW)


def test_generators_come_from_names_and_not_from_order():
    draws = {
        (seed, name): named_rng(seed, name).integers(1 << 60) for seed in (0, 1) for name in ("a/us/icp", "b/us/icp")
    }
    assert len(set(draws.values())) == 4
    assert named_rng(0, "a/us/icp").integers(1 << 60) == draws[0, "a/us/icp"]
    with pytest.raises(StudyError, match="expected a seed of 0 or more, got -1"):
        named_rng(-1, "a")


def test_an_unknown_method_is_named_with_the_known_ones():
    with pytest.raises(StudyError, match=r"expected a method among .*skeleton_graph.*, got 'icpp'"):
        find_method("icpp")


@pytest.mark.parametrize("method", ["icp", "skeleton_graph"])
def test_moving_the_clouds_moves_the_answer_with_the_us_cloud(method, ct_clouds, us_cloud):
    ct, us = ct_clouds["ct3"].points, us_cloud.points
    still = register_pair(ct, us, method)
    rng = np.random.default_rng(5)
    g, h = RigidTransform.random(rng), RigidTransform.random(rng)
    moved = register_pair(g.apply(ct), h.apply(us), method)
    # Nothing but rounding differs: 1e-13 of coordinates, carried through a thousand updates. A pose-dependent pixel
    # grid would show as 0.2-3 mm.
    assert np.linalg.norm(moved.warped - h.apply(still.warped), axis=1).max() < 1e-4
    assert moved.T_us_ct.matrix == pytest.approx((h @ still.T_us_ct @ g.inverse).matrix, abs=1e-4)
    waypoints = phantom.waypoints(phantom.draw_subject("ct3", 0)).points
    there = moved.transfer(g.apply(waypoints), radius_mm=30.0)
    assert there == pytest.approx(h.apply(still.transfer(waypoints, radius_mm=30.0)), abs=1e-4)


def test_a_pair_holds_what_the_interface_promises(ct_clouds, us_cloud):
    ct = np.array(ct_clouds["ct4"].points)
    ct.flags.writeable = False
    pair = register_pair(ct, us_cloud.points, method="skeleton_graph", seed=0)
    assert np.array_equal(pair.source, ct)  # row i is ct_points[i], in its own frame
    assert pair.warped.shape == ct.shape
    assert np.linalg.det(pair.T_us_ct.rotation) == pytest.approx(1)
    assert (pair.converged, pair.method) == (True, "skeleton_graph")
    assert pair.n_iterations > 0
    assert pair.seconds > 0
    truth = phantom.truth_map(phantom.draw_subject("ct4", 0), phantom.draw_subject("patient", 0), ct)
    assert np.linalg.norm(pair.warped - truth, axis=1).mean() < 15.0  # a wrong level is 25 mm, a wrong side 100
    same = register_pair(ct.tolist(), us_cloud.points, method="skeleton_graph", seed=0)
    assert same.warped.tobytes() == pair.warped.tobytes()


def test_a_cloud_on_a_moved_copy_of_itself_finds_the_motion(ct_clouds):
    cloud = ct_clouds["patient"].points
    motion = RigidTransform.random(np.random.default_rng(6))
    for method in ("coarse", "icp"):
        pair = register_pair(cloud, motion.apply(cloud), method)
        assert np.linalg.norm(pair.warped - motion.apply(cloud), axis=1).max() < 1e-3


def test_the_result_is_expressed_from_the_ct_clouds_own_frame(ct_clouds, us_cloud):
    pose = RigidTransform.random(np.random.default_rng(7))
    source = PointCloud(pose.apply(ct_clouds["ct1"].points), "ct")
    alignment = align(source, PointCloud(us_cloud.points, "us"))
    result = register_aligned(alignment, METHODS["icp"], np.random.default_rng(0))
    assert np.array_equal(result.source, source.points)
    assert result.warped == pytest.approx(result.T_us_ct.apply(source.points), abs=1e-9)
    assert result.method == "icp"
    assert register_aligned(alignment, METHODS["icp"], np.random.default_rng(0), "mine").method == "mine"


@dataclass(frozen=True)
class Toy:
    """Does what ``then`` does to the answer of the coarse alignment."""

    name: ClassVar[str] = "toy"

    then: Callable[[Registration], Registration]

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        return self.then(CoarseOnly().register(source, target, rng))


def run_toy(then: Callable[[Registration], Registration], name: str | None = None) -> Registration:
    cloud = toy_chest(np.random.default_rng(0), 500)
    return run_method(Toy(then), cloud, cloud, np.random.default_rng(0), name)


def test_a_run_is_timed_and_named():
    def slow(result: Registration) -> Registration:
        time.sleep(0.05)
        return replace(result, seconds=99.0, method="wrong", warnings=("thin",))

    result = run_toy(slow)
    assert 0.05 <= result.seconds < 5
    assert (result.method, result.warnings) == ("toy", ("thin",))
    assert run_toy(slow, "mine").method == "mine"


def test_a_method_runs_on_one_thread():
    seen = []

    def look(result: Registration) -> Registration:
        seen.extend((pool["user_api"], pool["num_threads"]) for pool in threadpool_info())
        return result

    with threadpool_limits(limits=2):
        run_toy(look)
        assert max(pool["num_threads"] for pool in threadpool_info()) == 2  # it is given back
    assert {"blas", "openmp"} <= {kind for kind, _ in seen}
    assert {threads for _, threads in seen} == {1}


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda p: p[:-1], r"toy: expected one warped point per point of 'toy' \(500, 3\), got \(499, 3\); a method"),
        (lambda p: p[:, :2], r"toy: expected one warped point .* got \(500, 2\)"),
        (lambda p: np.where(np.arange(500)[:, None] < 2, np.nan, p), "toy: expected finite points .* got 2 rows with"),
        (lambda p: np.where(np.arange(500)[:, None] < 1, np.inf, p), "toy: expected finite points .* got 1 rows with"),
    ],
)
def test_an_answer_that_is_none_is_refused(spoil, message):
    with pytest.raises(StudyError, match=message):
        run_toy(lambda result: replace(result, warped=spoil(result.warped)))


def test_an_answer_for_other_points_is_refused():
    with pytest.raises(StudyError, match="toy: expected one warped point per point of"):
        run_toy(lambda result: replace(result, source=result.source[1:], warped=result.warped[1:]))


# --- hostile input: right, refused or warned, never wrong in silence -------------------------------------------------


def waypoint_error(ct, us, **options) -> float:
    """Mean true error (mm) of ct1's waypoints in the patient, phantoms of cohort seed 0 in their canonical pose."""
    people = [phantom.draw_subject(name, 0) for name in ("ct1", "patient")]
    path = phantom.waypoints(people[0]).points
    pair = register_pair(ct, us, **options)
    assert pair.warnings == ()
    return float(np.linalg.norm(pair.transfer(path) - phantom.truth_map(*people, path), axis=1).mean())


def test_places_given_more_often_do_not_weigh_more(ct_clouds, us_cloud):
    ct, us = ct_clouds["ct1"].points, us_cloud.points
    rng = np.random.default_rng(8)
    plain = waypoint_error(ct, us)
    half = us[us[:, 0] > np.median(us[:, 0])]
    assert waypoint_error(ct, np.concatenate([us, *[half] * 7])) == pytest.approx(plain, abs=1.5)
    patch = ct[np.linalg.norm(ct - ct[100], axis=1) < 12.5]
    dense = [patch + rng.normal(scale=0.2, size=patch.shape) for _ in range(20)]
    assert waypoint_error(np.concatenate([ct, *dense]), us) == pytest.approx(plain, abs=1.5)


def test_every_given_point_has_its_row_however_many_there_are():
    people = [phantom.draw_subject(name, 0) for name in ("ct1", "patient")]
    rng = np.random.default_rng(9)
    us = phantom.anterior_cloud(people[1], 4000, 0.5, 2, rng).points
    errors = []
    for n in (2000, 60_000):
        ct = phantom.reference_cloud(people[0], n, rng).points
        pair = register_pair(ct, us)
        assert np.array_equal(pair.source, ct)
        truth = phantom.truth_map(*people, ct)
        errors.append(np.linalg.norm(pair.warped - truth, axis=1).mean())
    assert errors[0] == pytest.approx(errors[1], abs=1.0)


@dataclass(frozen=True)
class Spy:
    """Keeps what a method is given."""

    name: ClassVar[str] = "spy"
    seen: list[PointCloud]

    def register(self, source, target, rng):
        self.seen.append(target)
        return CoarseOnly().register(source, target, rng)


@pytest.mark.parametrize("dense", [False, True])
def test_times_reach_the_method_in_step_with_their_points(ct_clouds, us_cloud, monkeypatch, dense):
    ct, us = ct_clouds["ct1"].points, us_cloud.points
    rng = np.random.default_rng(8)
    # Even already; or so dense that both thinnings have points to average and to drop.
    us = np.concatenate([us + rng.normal(scale=0.2, size=us.shape) for _ in range(6)]) if dense else thin_evenly(us, 3)
    away = RigidTransform.random(np.random.default_rng(3))
    us = away.apply(us)
    slope = np.array([0.1, -0.2, 0.3])
    times = us @ slope + 5  # what is linear in place stays so however points are averaged
    seen = []
    monkeypatch.setattr(study.pipeline, "METHODS", {"spy": Spy(seen)})
    register_pair(ct, us, "spy", times=times)
    register_pair(ct, PointCloud(us, times=times), "spy")
    register_pair(ct, PointCloud(us, times=times + 1), "spy", times=times)  # what is given says it again
    register_pair(ct, us, "spy")
    given, own, again, without = seen
    assert (len(given) < len(us)) == dense
    np.testing.assert_allclose(given.times, given.points @ slope + 5, atol=1e-6)
    for other in (own, again):
        assert np.array_equal(other.times, given.times)
    assert without.times is None
    assert without.points.tobytes() == given.points.tobytes()  # times move no point
    assert np.array_equal(without.parts, given.parts)


@pytest.mark.parametrize("bad", [[1.0], np.zeros((3000, 1)), np.full(3000, np.nan), ["late"] * 3000])
def test_times_that_are_not_one_a_point_are_refused(ct_clouds, us_cloud, bad):
    us = us_cloud.points
    if len(bad) == 3000:
        bad = bad[: len(us)]
    with pytest.raises(StudyError, match=r"us: expected (one time per point|finite times|a time in seconds)"):
        register_pair(ct_clouds["ct1"].points, us, "coarse", times=bad)


def test_a_rigid_answer_stays_rigid_on_points_that_were_thinned(ct_clouds, us_cloud):
    doubled = np.concatenate([ct_clouds["ct1"].points] * 2)
    pair = register_pair(doubled, us_cloud.points, "icp")
    assert pair.warped == pytest.approx(pair.T_us_ct.apply(doubled), abs=1e-6)


def test_a_front_is_heeded_and_one_the_branches_contradict_refused(ct_clouds, us_cloud):
    ct, us = ct_clouds["ct1"].points, us_cloud.points
    with_front = register_pair(ct, us, "coarse", front=[0, 2.0, 0])
    assert np.array_equal(with_front.warped, register_pair(ct, us, "coarse").warped)
    assert with_front.front @ [0, 1, 0] > 0.8  # of the US cloud's chest, whose skin lies there
    right = ct[np.isin(with_front.parts, [1, 2, 3, 4])]  # RAS: the patient's right has the larger x
    assert len(with_front.parts) == len(ct)
    assert right[:, 0].mean() > ct[:, 0].mean() + 20
    handed_on = register_pair(ct, PointCloud(us, front=np.array([0, 1.0, 0])), "coarse")
    assert np.array_equal(with_front.warped, handed_on.warped)
    with pytest.raises(StudyError, match="us: expected cartilages that arch towards the `front` given"):
        register_pair(ct, us, "coarse", front=[0, -1, 0])
    for bad in ([0, 0, 0], [np.nan, 1, 0], [0, 1], "up"):
        with pytest.raises(StudyError, match="expected front as a direction"):
            register_pair(ct, us, "coarse", front=bad)


def test_a_cloud_that_is_even_but_dense_keeps_each_point_in_its_own_part() -> None:
    """The study's own sample: at 1.5 mm nothing is thinned to find the chest, and half of it for the method."""
    sample = PointCloud(read_ply(Path(__file__).parents[1] / "samples" / "us.ply"), "us")
    whole, thinned = find_chest(sample), _even_chest(sample)
    assert len(thinned.cloud) < 0.6 * len(sample)
    _, own = KDTree(sample.points).query(thinned.cloud.points)
    assert (whole.cloud.parts[own] == thinned.cloud.parts).mean() > 0.95
