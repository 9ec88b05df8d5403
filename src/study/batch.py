"""A whole dataset: every pair, every method, in any number of worker processes."""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from study.coarse import Alignment, Chest, find_chest
from study.cohorts import (
    Anatomy,
    Patient,
    fetch_subject,
    files_of_subject,
    has_truth,
    load_anatomy,
    make_patient,
    origin_of,
    pairs,
    plant,
    truth_map,
)
from study.data.manifest import Manifest, load_manifest
from study.errors import StudyError
from study.methods import METHODS
from study.metrics import TRUTH, hausdorff_mm, hd95_mm, mean_surface_distance_mm, point_errors_mm, waypoint_errors_mm
from study.params import StudyParams
from study.pipeline import find_method, named_rng, register_aligned
from study.results import (
    FAILED,
    TIMING_COLUMNS,
    Row,
    failed_row,
    metric_rows,
    provenance,
    read_metrics,
    sha256_of,
    why_stale,
    write_hd_table,
    write_json,
    write_metrics,
    write_timings,
)
from study.types import Floats, Registration
from study.waypoints import intercostal_waypoints

K = TypeVar("K", bound=Hashable)
Step = tuple[Any, ...]  # a function and its arguments


@dataclass(frozen=True)
class Case:
    """One CT, one patient, one method."""

    source: str
    target: str
    method: str


@dataclass(frozen=True)
class Pair:
    """A CT and a patient, coarsely aligned, with what is known of the answer; the same for every method.

    Attributes:
        alignment: the two clouds and the motion that overlays their sternums.
        waypoints_ct, waypoints_us: (k, 3) mm, each in its own cloud's frame.
        true_points, true_waypoints: where the CT's points and waypoints truly lie, (n, 3) and (k, 3) mm in the US
            frame; None between two real people.
    """

    alignment: Alignment
    waypoints_ct: Floats
    waypoints_us: Floats
    true_points: Floats | None
    true_waypoints: Floats | None


@dataclass(frozen=True)
class Outcome:
    """What one step gave, a value or why it failed, and how long it took."""

    value: Any = None
    error: StudyError | None = None
    seconds: float = 0.0

    def get(self) -> Any:
        """The value.

        Raises:
            StudyError: the step, or one that it builds on, failed.
        """
        if self.error is not None:
            raise self.error
        return self.value


@dataclass(frozen=True)
class Workers:
    """Processes that run independent steps, and a bar that shows how far they are."""

    n_jobs: int
    show_progress: bool

    def run(self, label: str, steps: Mapping[K, Step]) -> dict[K, Outcome]:
        """Run every ``(function, *arguments)``; an argument that is an earlier outcome stands for its value."""
        if self.n_jobs == 1:
            outcomes: Iterator[Outcome] = (_attempt(*step) for step in steps.values())
        else:
            calls = (delayed(_attempt)(*step) for step in steps.values())
            outcomes = Parallel(n_jobs=self.n_jobs, return_as="generator")(calls)
        bar = tqdm(
            outcomes,
            total=len(steps),
            desc=label,
            bar_format="{desc}: {n_fmt} of {total_fmt} |{bar:20}| {elapsed} so far, about {remaining} left",
            mininterval=0.2 if sys.stderr.isatty() else 15,  # a log file needs a line now and then, not a moving bar
            disable=not (self.show_progress and steps),
        )
        return dict(zip(steps, bar, strict=True))


def _attempt(function: Callable[..., Any], *arguments: Any) -> Outcome:
    """Run one step; a failure, its own or an argument's, is kept instead of raised."""
    start = time.perf_counter()
    value, failure = None, None
    with threadpool_limits(1):  # sums then have one order, whatever the number of workers
        try:
            value = function(*(a.get() if isinstance(a, Outcome) else a for a in arguments))
        except StudyError as error:
            failure = error
    return Outcome(value, failure, time.perf_counter() - start)


def run_dataset(
    dataset: str,
    params: StudyParams,
    *,
    methods: Iterable[str] | None = None,
    seed: int = 0,
    n_jobs: int = 1,
    manifest: Manifest | None = None,
    show_progress: bool = False,
) -> tuple[list[Row], list[Row]]:
    """All cases of a dataset.

    Args:
        dataset: a cohort of the manifest, or ``planted``.
        params: the profile.
        methods: names in ``METHODS``; all when None.
        seed: of samples, sweeps and methods; combined with names, never with order.
        n_jobs: worker processes.
        manifest: the repository's when None.
        show_progress: bars on standard error.

    Returns:
        rows of ``metrics.csv`` and of ``timings.csv``.

    Raises:
        StudyError: an unknown dataset or method; a subject or pair that fails is rows instead.
    """
    chosen = _chosen(methods)
    manifest = manifest or load_manifest()
    todo = pairs(dataset, params, manifest)
    sources, targets = (list(dict.fromkeys(names)) for names in zip(*todo, strict=True))
    origins = {name: origin_of(dataset, name) for name in dict.fromkeys([*sources, *targets])}
    with_ct = list(dict.fromkeys(origin or name for name, origin in origins.items()))
    workers = Workers(n_jobs, show_progress)

    # One process fetches, with bars of its own; the workers then only read.
    files = {name: _attempt(fetch_subject, dataset, name, manifest, show_progress) for name in with_ct}
    anatomies = workers.run(
        f"{dataset}: anatomies", {n: (_load, files[n], dataset, n, params, seed, manifest) for n in with_ct}
    )
    anatomies |= workers.run(
        f"{dataset}: planted patients",
        {name: (plant, anatomies[origin], name) for name, origin in origins.items() if origin},
    )
    patients = workers.run(
        f"{dataset}: virtual sweeps", {name: (make_patient, anatomies[name], params, seed) for name in targets}
    )
    chests = workers.run(
        f"{dataset}: coarse alignment",
        {("ct", name): (_chest, anatomies[name]) for name in sources}
        | {("us", name): (_chest, patients[name]) for name in targets},
    )
    matched = workers.run(
        f"{dataset}: pairs",
        {(s, t): (_pair, dataset, anatomies[s], patients[t], chests["ct", s], chests["us", t]) for s, t in todo},
    )
    judged = [*chosen, TRUTH] if has_truth(dataset) else chosen
    cases = workers.run(
        f"{dataset}: registrations",
        {
            case: (run_case, dataset, case, matched[case.source, case.target], seed, params.radius_mm)
            for case in (Case(source, target, method) for source, target in todo for method in judged)
        },
    )

    rows: list[Row] = []
    for case, outcome in cases.items():
        if outcome.error is None:
            rows += outcome.value
        else:
            who = (dataset, case.source, case.target, case.method, seed)
            rows.append(failed_row(*who, str(outcome.error)))
    steps = {(name, "", "", "anatomy"): outcome for name, outcome in anatomies.items()}
    steps |= {(name, "", "", "sweep"): outcome for name, outcome in patients.items()}
    steps |= {(name, "", "", f"coarse {side}"): outcome for (side, name), outcome in chests.items()}
    steps |= {(case.source, case.target, case.method, "register"): outcome for case, outcome in cases.items()}
    timings = [
        dict(zip(TIMING_COLUMNS, (dataset, *who, seed, stage, round(outcome.seconds, 3)), strict=True))
        for (*who, stage), outcome in steps.items()
        if outcome.error is None
    ]
    return rows, timings


def _chosen(methods: Iterable[str] | None) -> list[str]:
    """Names of the methods to run, each once and known."""
    chosen = list(METHODS) if methods is None else list(dict.fromkeys(methods))
    if not chosen:
        raise StudyError(f"expected a method among {', '.join(METHODS)}, got none")
    for name in chosen:
        find_method(name)
    return chosen


def _load(_fetched: None, dataset: str, name: str, params: StudyParams, seed: int, manifest: Manifest) -> Anatomy:
    """An anatomy without its images, which are large and of no use after this; its files are here."""
    return replace(load_anatomy(dataset, name, params, seed, manifest), image=None, mask=None)


def _chest(person: Anatomy | Patient) -> Chest:
    return find_chest(person.cloud)


def _pair(dataset: str, anatomy: Anatomy, patient: Patient, chest_ct: Chest, chest_us: Chest) -> Pair:
    truth = truth_map(dataset, anatomy, patient.anatomy.name)
    return Pair(
        Alignment(chest_ct, chest_us),
        anatomy.waypoints.points,
        intercostal_waypoints(patient.labelled).points,
        None if truth is None else patient.T_us_ras.apply(truth(anatomy.cloud.points)),
        None if truth is None else patient.T_us_ras.apply(truth(anatomy.waypoints.points)),
    )


def run_case(dataset: str, case: Case, pair: Pair, seed: int, radius_mm: float) -> list[Row]:
    """The rows of one case; of method ``TRUTH``, what a perfect registration scores.

    Raises:
        StudyError: the method or the path transfer failed.
    """
    if case.method == TRUTH:
        result = _perfect(pair)
    else:
        rng = named_rng(seed, f"{case.source}/{case.target}/{case.method}")
        result = register_aligned(pair.alignment, find_method(case.method), rng)
    values = evaluate(pair, result, radius_mm)
    return metric_rows(dataset, case.source, case.target, case.method, seed, values, converged=result.converged)


def _perfect(pair: Pair) -> Registration:
    assert pair.true_points is not None
    source = pair.alignment.source.cloud.points
    return Registration(source, pair.true_points, pair.alignment.T_us_ct, True, 0, "the truth itself", method=TRUTH)


def evaluate(pair: Pair, result: Registration, radius_mm: float = 20.0) -> dict[str, Any]:
    """The metrics of one registration (sec. IV); true errors only where the truth is known."""
    target = pair.alignment.target
    normal = target.T_cloud_chest.rotation[:, 2]
    moved = result.transfer(pair.waypoints_ct, radius_mm)
    values: dict[str, Any] = {
        "hd": hausdorff_mm(result.warped, target.cloud.points),
        "hd95": hd95_mm(result.warped, target.cloud.points),
        "msd": mean_surface_distance_mm(result.warped, target.cloud.points),
        "waypoint_error": waypoint_errors_mm(moved, pair.waypoints_us),
        "waypoint_error_inplane": waypoint_errors_mm(moved, pair.waypoints_us, normal),
    }
    if pair.true_points is not None and pair.true_waypoints is not None:
        errors = point_errors_mm(result.warped, pair.true_points)
        values |= {
            "true_error_mean": errors.mean(),
            "true_error_p95": np.percentile(errors, 95),
            "true_error_max": errors.max(),
            "true_waypoint_error": waypoint_errors_mm(moved, pair.true_waypoints),
            "true_waypoint_error_inplane": waypoint_errors_mm(moved, pair.true_waypoints, normal),
        }
    return values


def run_study(
    dataset: str,
    params: StudyParams,
    out: Path,
    *,
    methods: Iterable[str] | None = None,
    seed: int = 0,
    n_jobs: int = 1,
    manifest: Manifest | None = None,
    show_progress: bool = False,
) -> None:
    """Run a dataset and write ``metrics.csv``, ``timings.csv``, ``provenance.json`` and the tables into ``out``.

    Raises:
        StudyError: an unknown dataset or method, or no case that succeeded; the rows with the reasons are written.
    """
    chosen = _chosen(methods)
    manifest = manifest or load_manifest()
    pairs(dataset, params, manifest)  # an unknown dataset leaves no folder
    out.mkdir(parents=True, exist_ok=True)  # a folder that can't be written is better known now than after the run
    started = datetime.now(UTC)
    rows, timings = run_dataset(
        dataset, params, methods=chosen, seed=seed, n_jobs=n_jobs, manifest=manifest, show_progress=show_progress
    )
    write_metrics(rows, out / "metrics.csv")
    write_timings(timings, out / "timings.csv")
    parameters = run_parameters(params, chosen)
    inputs = _input_hashes(dataset, {name for row in rows for name in (row["subject"], row["target"])}, manifest)
    write_json(provenance(parameters, seed, inputs, started, datetime.now(UTC)), out / "provenance.json")
    write_tables(pd.DataFrame(rows), out)
    if all(row["status"].startswith(FAILED) for row in rows):
        reasons = sorted({row["status"].removeprefix(FAILED) for row in rows})
        raise StudyError(f"{dataset}: every case failed: {' | '.join(reasons)}")


def run_parameters(params: StudyParams, methods: Iterable[str] | None = None) -> dict[str, Any]:
    """Every parameter of a run, for its provenance."""
    return {"study": asdict(params), "methods": {name: asdict(METHODS[name]) for name in _chosen(methods)}}


def load_or_run(
    dataset: str, params: StudyParams, folder: Path, *, seed: int = 0, n_jobs: int = 1, show_progress: bool = False
) -> tuple[pd.DataFrame, str]:
    """The metrics of a dataset: those in ``folder`` if the code and parameters of now made them, else of a new run.

    Returns:
        rows as `read_metrics` gives them, and a sentence that says where they are from.

    Raises:
        StudyError: as `run_study`.
    """
    reason = why_stale(folder, run_parameters(params), seed)
    if reason is not None:
        run_study(dataset, params, folder, seed=seed, n_jobs=n_jobs, show_progress=show_progress)
    metrics = read_metrics(folder / "metrics.csv")
    return metrics, "loaded: code, parameters and seed are those of now" if reason is None else f"run now: {reason}"


def _input_hashes(dataset: str, names: Iterable[str], manifest: Manifest) -> dict[str, str]:
    """SHA-256 of the manifest and of every file the subjects were read from; of a series, of all its slices."""
    inputs = {manifest.path.name: sha256_of(manifest.path)}
    for name in sorted({origin_of(dataset, name) or name for name in names}):
        for key, path in files_of_subject(dataset, name, manifest).items():
            slices = sorted(path.iterdir()) if path.is_dir() else [path]
            hashes = [sha256_of(slice_) for slice_ in slices]
            inputs[key] = hashes[0] if path.is_file() else hashlib.sha256("".join(hashes).encode()).hexdigest()
    return inputs


def write_tables(metrics: pd.DataFrame, out: Path) -> None:
    """Hausdorff tables in the shape of the paper's Table I: one a patient, columns the CTs.

    One CT with several patients (the planted deformations) is turned: columns are the patients.
    """
    for old in out.glob("hd_*.*"):  # of a run with other subjects
        old.unlink()
    targets = sorted(metrics["target"].unique())
    dataset = metrics["dataset"].iloc[0]
    if metrics["subject"].nunique() == 1:
        turned = metrics.assign(subject=metrics["target"])
        caption = f"Hausdorff distance, {dataset}: {metrics['subject'].iloc[0]} to each simulated patient"
        write_hd_table(turned, out / "hd_table", caption=caption)
        return
    for target in targets:
        stem = out / ("hd_table" if len(targets) == 1 else f"hd_table_{target}")
        who = "the simulated patient" if target == "patient" else f"the simulated patient {target}"
        caption = f"Hausdorff distance, {dataset}: each CT to {who}"
        write_hd_table(metrics[metrics["target"] == target], stem, caption=caption)
    if len(targets) > 1:
        pairs_named = metrics.assign(subject=metrics["subject"] + " to " + metrics["target"])
        write_hd_table(pairs_named, out / "hd_all_pairs", caption=f"Hausdorff distance, {dataset}: all ordered pairs")
