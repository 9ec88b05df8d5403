from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import yaml
from phantom_files import SMALL, cached_ct_volume

from study import METHODS as METHODS_BY_NAME
from study import phantom
from study.batch import cases, open_run, run_dataset, run_parameters, run_study, runs, why_stale
from study.batch.workers import Outcome, Workers
from study.data.manifest import load_manifest
from study.datasets import Anatomy, Dataset, PhantomDataset, PlantedDataset, PlantedEveryDataset, find_dataset
from study.errors import StudyError
from study.evaluation.pair import TRUTH
from study.params import StudyParams
from study.results.journal import Journal
from study.results.metrics_csv import FAILED, read_metrics

METHODS = ("coarse", "icp")


def people(params: StudyParams = SMALL, seed: int = 0, name: str = "phantom") -> Dataset:
    return find_dataset(name, params, seed)


TWO_CTS = replace(SMALL, max_sources=2)


@pytest.fixture(autouse=True)
def drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(phantom, "ct_volume", cached_ct_volume)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with one worker."""
    out = tmp_path_factory.mktemp("runs") / "first"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(phantom, "ct_volume", cached_ct_volume)
        run_study(people(), out, methods=METHODS)
    return out


# --- what must not change a byte -------------------------------------------------------------------------------------


def test_neither_workers_nor_order_change_a_byte(first: Path, tmp_path: Path) -> None:
    run_study(people(), tmp_path, methods=reversed(METHODS), n_jobs=2)
    metrics = read_metrics(first / "metrics.csv")
    # methods and truth x (distances, the same of the visible part, true errors, quality, 4 x 3 kinds of 20 waypoints)
    assert len(metrics) == 3 * (3 + 3 + 3 + 5 + 4 * 3 * 20)
    assert set(metrics["status"]) <= {"ok", "not converged"}
    assert (tmp_path / "metrics.csv").read_bytes() == (first / "metrics.csv").read_bytes()
    assert (tmp_path / "hd_table.md").read_bytes() == (first / "hd_table.md").read_bytes()
    assert (tmp_path / "clouds.npz").read_bytes() == (first / "clouds.npz").read_bytes()


def test_one_method_alone_has_the_rows_it_has_among_others(first: Path) -> None:
    rows, _ = run_dataset(people(), methods=["icp", "icp"])
    among = read_metrics(first / "metrics.csv").query("method == 'icp'")
    alone = pd.DataFrame(rows).query("method == 'icp'").sort_values(["metric", "index"])
    assert len(alone) == len(among)
    assert alone["value"].to_list() == among.sort_values(["metric", "index"])["value"].to_list()


def test_a_perfect_registration_is_measured_as_a_method_is(first: Path) -> None:
    """Known points are exact, their path is carried by the sphere; the clouds still differ, tube against sheet."""
    truth = read_metrics(first / "metrics.csv").query("method == @TRUTH").groupby("metric")["value"].max()
    assert truth["true_error_max"] == 0
    assert 0 < truth["true_waypoint_error"] < 5.0
    assert truth["hd"] > 5.0
    assert truth["waypoint_error"] > 1.0


def test_another_seed_gives_other_numbers(first: Path) -> None:
    rows, _ = run_dataset(people(seed=1), methods=["coarse"])
    before = read_metrics(first / "metrics.csv").query("method == 'coarse' and metric == 'hd'")["value"].item()
    after = next(row["value"] for row in rows if row["metric"] == "hd")
    assert after != before
    assert after == pytest.approx(before, rel=0.5)  # another sweep of the same people


def test_a_run_leaves_tables_times_and_provenance(first: Path) -> None:
    assert {path.name for path in first.iterdir()} == {
        "metrics.csv", "timings.csv", "provenance.json", "clouds.npz", "hd_table.csv", "hd_table.md", "hd_table.tex",
        "parameters.json", "manifest.yaml", "environment.lock", "ro-crate-metadata.json",
    }  # fmt: skip
    assert " n " in (first / "hd_table.md").read_text(encoding="utf-8")
    timings = pd.read_csv(first / "timings.csv")
    assert timings["stage"].value_counts().to_dict() == {
        "anatomy": 2, "sweep": 1, "coarse ct": 1, "coarse us": 1, "register": 3
    }  # fmt: skip
    provenance = json.loads((first / "provenance.json").read_text(encoding="utf-8"))
    assert provenance["parameters"]["study"]["ct_points"] == SMALL.ct_points
    assert sorted(provenance["parameters"]["methods"]) == list(METHODS)
    assert list(provenance["inputs_sha256"]) == ["data_manifest.yaml"]
    assert 50 < provenance["peak_memory_mb"] < 100_000  # an interpreter with its libraries; less than any machine has


# --- what fails ------------------------------------------------------------------------------------------------------


Load = Callable[..., Anatomy]
ANATOMY: Load = PhantomDataset.anatomy


@cache
def known(name: str) -> Anatomy:
    return ANATOMY(people(), name)


@pytest.fixture
def known_people(monkeypatch: pytest.MonkeyPatch) -> None:
    """Anatomies of the phantom, made once."""
    monkeypatch.setattr(PhantomDataset, "anatomy", lambda _, name, *rest: known(name))


def failing(who: str, error: Exception) -> Load:
    def load(self: Dataset, name: str, *rest: Any) -> Anatomy:
        if name == who:
            raise error
        return ANATOMY(self, name, *rest)

    return load


def test_a_subject_that_fails_is_rows_with_the_reason_and_the_rest_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PhantomDataset, "anatomy", failing("ct2", StudyError("ct2: expected ribs,\n got a fish")))
    run_study(people(TWO_CTS), tmp_path, methods=METHODS)
    metrics = read_metrics(tmp_path / "metrics.csv")
    failed = metrics[metrics["source"] == "ct2"]
    assert failed["method"].to_list() == [*METHODS, TRUTH]
    assert set(failed["status"]) == {FAILED + "ct2: expected ribs, got a fish"}
    assert not metrics[metrics["source"] == "ct1"]["status"].str.startswith(FAILED).any()
    table = pd.read_csv(tmp_path / "hd_table.csv")
    ours = table[table["data"] == "this study"].set_index("method")
    assert ours["n"].to_list() == [1, 1, 1]
    assert ours["n_failed"].to_list() == [1, 1, 1]
    assert "1 failed" in (tmp_path / "hd_table.md").read_text(encoding="utf-8")


def test_a_patient_that_fails_takes_every_case_with_it_and_that_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PhantomDataset, "anatomy", failing("patient", StudyError("patient: expected ribs, got a fish")))
    with pytest.raises(StudyError, match=r"phantom: every case failed: patient: expected ribs, got a fish$"):
        run_study(people(), tmp_path, methods=METHODS)
    metrics = read_metrics(tmp_path / "metrics.csv")
    assert len(metrics) == 3
    assert metrics["status"].str.endswith("got a fish").all()


def test_a_method_that_fails_leaves_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = cases.register_aligned

    def register(alignment: Any, method: Any, *rest: Any) -> Any:
        if method == METHODS_BY_NAME["icp"]:
            raise StudyError("icp: expected overlap, got none")
        return whole(alignment, method, *rest)

    monkeypatch.setattr(cases, "register_aligned", register)
    rows, timings = run_dataset(people(), methods=METHODS)
    assert {row["method"] for row in rows if row["status"].startswith(FAILED)} == {"icp"}
    assert sum(row["method"] == "coarse" and row["status"] == "ok" for row in rows) > 80
    assert [row["method"] for row in timings if row["stage"] == "register"] == ["coarse", TRUTH]


class Odd(Exception):
    """As some libraries have it: one that cannot be sent from one process to another."""

    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


def test_whatever_one_case_raises_is_its_row_and_its_place_in_the_code_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known_people: None
) -> None:
    errors = {
        "icp": ZeroDivisionError("oops"),
        "cpd": Odd(1, 2),
        "nonrigid_icp": SystemExit(3),
        "cpd_tuned": MemoryError(),
    }
    whole = cases.register_aligned

    def register(alignment: Any, method: Any, *rest: Any) -> Any:
        for name, error in errors.items():
            if method == METHODS_BY_NAME[name]:
                raise error
        return whole(alignment, method, *rest)

    monkeypatch.setattr(cases, "register_aligned", register)
    run = run_study(people(), tmp_path / "out", methods=["coarse", *errors])
    assert dict(zip(run.failures["method"], run.failures["reason"], strict=True)) == {
        "icp": "ZeroDivisionError: oops",
        "cpd": "Odd: 1 and 2",
        "nonrigid_icp": "SystemExit: 3",
        "cpd_tuned": "MemoryError",
    }
    log = (tmp_path / "out" / "failures.log").read_text(encoding="utf-8")
    assert "ct1 patient icp register" in log
    assert log.count("in register") == len(errors)
    assert set(run.values["method"]) == {"coarse", TRUTH}
    assert run.altered is None


def test_a_value_that_is_not_finite_is_a_failed_case_and_no_lost_run(
    monkeypatch: pytest.MonkeyPatch, known_people: None
) -> None:
    monkeypatch.setattr(cases, "judge", lambda *_: {"hd": [float("nan")]})
    rows, _ = run_dataset(people(), methods=["coarse"])
    assert [row["status"] for row in rows] == [
        f"failed: ct1/{name}: expected finite hd, got [nan]; write a failed row instead" for name in ("coarse", TRUTH)
    ]


def test_a_stopped_run_does_only_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known_people: None
) -> None:
    """Ctrl-C in the second of two pairs: the first is not even looked at again."""
    whole, done = cases.register_aligned, []

    def register(alignment: Any, *rest: Any) -> Any:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(alignment.source.cloud.name)
        return whole(alignment, *rest)

    monkeypatch.setattr(cases, "register_aligned", register)
    with pytest.raises(KeyboardInterrupt):
        run_study(people(TWO_CTS), tmp_path / "out", methods=METHODS)
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(cases, "register_aligned", whole)
    monkeypatch.setattr(PhantomDataset, "anatomy", failing("ct1", AssertionError("ct1 has been done")))
    run = run_study(people(TWO_CTS), tmp_path / "out", methods=METHODS)
    assert done == ["ct:ct1", "ct:ct1"]
    assert run.failures.empty
    assert len(run.timings) == 3 + 1 + 3 + 6
    assert run.provenance["peak_memory_mb"] > 50
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_what_another_seed_made_is_not_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known_people: None
) -> None:
    def stop(_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(cases, "perfect", stop)
        with pytest.raises(KeyboardInterrupt):
            run_study(people(seed=1), tmp_path / "out", methods=["coarse"])
    assert (tmp_path / ".out.unfinished" / "finished.jsonl").is_file()
    monkeypatch.setattr(PhantomDataset, "anatomy", failing("ct1", StudyError("asked for again")))
    with pytest.raises(StudyError, match="asked for again"):
        run_study(people(seed=0), tmp_path / "out", methods=["coarse"])


def test_a_finished_case_is_known_by_its_method_and_input_files(monkeypatch: pytest.MonkeyPatch) -> None:
    step = cases.Step("ct1", "patient", "icp", "register")
    journal = Journal(None, {})

    def work(ct: str) -> cases.Work:
        inputs = {"ct1": {"scan": ct}, "patient": {}}
        return cases.Work(people(), Workers(1, show_progress=False), journal, inputs)

    work("ab").do("registrations", {step: (list, "rows")})
    known = work("ab").finished(step)
    assert known is not None
    assert known.value == list("rows")
    assert work("cd").finished(step) is None
    assert work("ab").finished(step._replace(method="cpd")) is None
    other = replace(METHODS_BY_NAME["icp"], max_iterations=3)  # type: ignore[type-var]
    monkeypatch.setattr(cases, "METHODS", {**METHODS_BY_NAME, "icp": other})
    assert work("ab").finished(step) is None


def test_a_worker_that_dies_is_told_and_nothing_hangs() -> None:
    with pytest.raises(StudyError, match=r"one that ended by itself .*: start again to go on"):
        Workers(2, show_progress=False).run("deaths", {n: (os._exit, 3) for n in range(2)})


def test_a_run_is_opened_made_or_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known_people: None
) -> None:
    monkeypatch.setattr(runs, "METHODS", {"coarse": METHODS_BY_NAME["coarse"]})
    monkeypatch.setattr(runs, "find_profile", lambda _: SMALL)
    monkeypatch.setattr(runs, "run_folder", lambda *_: tmp_path / "run")
    monkeypatch.setattr(runs, "Workers", lambda _, show: Workers(1, show))
    assert open_run("phantom", "quick").origin == "run now: there is no run yet"
    run = open_run("phantom", "quick")
    assert run.origin.startswith("loaded")
    whole = (run.folder / "metrics.csv").read_bytes()
    (run.folder / "metrics.csv").write_bytes(b"".join(whole.splitlines(keepends=True)[:40]))
    assert open_run("phantom", "quick").origin == "run now: the run has since been altered: edited metrics.csv"
    assert (run.folder / "metrics.csv").read_bytes() == whole
    assert "the seed" in str(why_stale(run, people(SMALL, 1)))
    assert "the data set" in str(run.why_stale("planted", run_parameters(people()), 0))


def test_a_run_of_chosen_methods_has_as_many_processes_as_the_notebooks_were_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known_people: None
) -> None:
    seen = []
    monkeypatch.setattr(runs, "find_profile", lambda _: SMALL)
    monkeypatch.setattr(runs, "run_folder", lambda *given: tmp_path / "+".join(given[-1]))
    monkeypatch.setattr(runs, "Workers", lambda n_jobs, show: seen.append(n_jobs) or Workers(1, show))
    monkeypatch.setenv(runs.JOBS, "7")
    assert open_run("phantom", "quick", 0, "coarse, icp").methods == ["coarse", "icp", "truth"]
    assert (tmp_path / "coarse+icp" / "metrics.csv").is_file()
    assert seen == [7]
    with pytest.raises(StudyError, match="got 'ipc'"):
        open_run("phantom", "quick", 0, "icp,ipc")
    monkeypatch.setenv(runs.JOBS, "many")
    with pytest.raises(StudyError, match="STUDY_JOBS: expected a number of processes, got 'many'"):
        open_run("phantom", "quick", 0, "icp")


def test_what_cannot_start_says_so_before_anything_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PhantomDataset, "anatomy", failing("ct1", AssertionError("nothing may be read")))
    with pytest.raises(StudyError, match=r"among coarse, icp, .*got 'ipc'"):
        run_study(people(), tmp_path / "a", methods=["ipc"])
    with pytest.raises(StudyError, match="got none"):
        run_study(people(), tmp_path / "a", methods=[])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "hd_thesis.md").write_text("years of work")
    with pytest.raises(StudyError, match=r"got hd_thesis\.md without its provenance\.json"):
        run_study(people(), tmp_path / "mine", methods=["coarse"])
    assert (tmp_path / "mine" / "hd_thesis.md").is_file()
    with pytest.raises(StudyError, match="got 'phantom2'"):
        run_study(people(name="phantom2"), tmp_path / "a", methods=["coarse"])
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        run_study(people(), tmp_path / "file" / "out", methods=["coarse"])


# --- the planted deformations ----------------------------------------------------------------------------------------


def test_the_planted_source_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    read = []
    whole = PlantedDataset.anatomy

    def load(self: Dataset, name: str, origin: Anatomy | None = None) -> Anatomy:
        if origin is not None:
            return whole(self, name, origin)
        read.append((self.name, name))
        return replace(people().anatomy("ct3"), name=name)  # at 3 mm ct1 planted is refused

    monkeypatch.setattr(PlantedDataset, "anatomy", load)
    monkeypatch.setattr(PlantedDataset, "fetch", lambda *_: None)
    rows, timings = run_dataset(people(replace(SMALL, max_targets=3), name="planted"), methods=["coarse"])
    assert read == [("planted", "lidc-0001")]
    assert {row["target"] for row in rows} == {"planted1", "planted2", "planted3"}
    done = [row for row in rows if row["target"] == "planted1"]
    assert {row["status"] for row in done} == {"ok"}
    assert {row["metric"] for row in done} >= {"true_error_mean", "true_waypoint_error"}
    assert sum(row["stage"] == "anatomy" for row in timings) == 4


def test_each_sweep_of_a_patient_is_a_case_of_its_own_and_the_first_is_the_only_ones(
    tmp_path: Path, known_people: None, first: Path
) -> None:
    raw = {"kind": "generated", "sweeps": 2, "subjects": {"ct1": {"role": "ct"}, "patient": {"role": "patient"}}}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump({"cohorts": {"phantom": raw}}))
    swept = find_dataset("phantom", SMALL, manifest=load_manifest(tmp_path / "own.yaml"))
    run = run_study(swept, tmp_path / "out", methods=["coarse"])
    assert run.failures.empty
    assert set(run.metrics["target"]) == {"patient", "patient#1"}
    assert run.timings["stage"].value_counts().to_dict() == {
        "anatomy": 2, "sweep": 2, "coarse ct": 1, "coarse us": 2, "register": 4
    }  # fmt: skip
    assert run.overview()["patients"] == 1
    again, other = (run.metrics.query("method == 'coarse' and target == @name") for name in ("patient", "patient#1"))
    alone = read_metrics(first / "metrics.csv").query("method == 'coarse'")
    assert again["value"].to_list() == alone["value"].to_list()
    assert other["value"].to_list() != alone["value"].to_list()


def test_planted_patients_of_every_ct_go_the_whole_road(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = PlantedEveryDataset.anatomy

    def load(self: Dataset, name: str, origin: Anatomy | None = None) -> Anatomy:
        return whole(self, name, origin) if origin is not None else replace(known("ct3"), name=name)

    monkeypatch.setattr(PlantedEveryDataset, "anatomy", load)
    monkeypatch.setattr(PlantedEveryDataset, "fetch", lambda *_: None)
    rows, _ = run_dataset(people(replace(SMALL, max_targets=6), name="planted_every"), methods=["coarse"])
    done = {(row["source"], row["target"]) for row in rows if row["status"] == "ok"}
    pairs = [("lidc-0001", f"lidc-0001+planted{k}") for k in range(1, 6)]
    other = ("totalseg-example", "totalseg-example+planted1")
    assert {(row["source"], row["target"]) for row in rows} == {*pairs, other}
    assert len(done) >= 4  # at 3 mm the coarse alignment may refuse one
    assert {row["metric"] for row in rows} >= {"true_error_mean", "true_waypoint_error"}


# --- workers and tables ----------------------------------------------------------------------------------------------


def halving() -> Callable[[int], float]:
    """A local function: it travels to a worker by value, where this file is no module that could be imported."""

    def half(number: int) -> float:
        if number % 2:
            raise StudyError(f"expected an even number, got {number}")
        return number / 2

    return half


half = halving()


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_outcomes_keep_their_keys_and_failures_are_passed_on(n_jobs: int) -> None:
    workers = Workers(n_jobs, show_progress=False)
    halves = workers.run("halves", {n: (half, n) for n in (8, 3, 4)})
    quarters = workers.run("quarters", {n: (half, value) for n, value in halves.items()})
    assert [(n, outcome.value) for n, outcome in quarters.items()] == [(8, 2.0), (3, None), (4, 1.0)]
    with pytest.raises(StudyError, match="got 3"):
        quarters[3].get()
    assert workers.run("nothing", {}) == {}
    assert Outcome(5).get() == 5


def test_progress_says_which_of_how_many_and_the_time_left(capsys: pytest.CaptureFixture[str]) -> None:
    Workers(1, show_progress=True).run("phantom: registrations", {n: (half, n) for n in (2, 4)})
    shown = capsys.readouterr().err
    assert "phantom: registrations: 2 of 2" in shown
    assert "left" in shown
