"""A whole dataset: every pair, every method, in any number of worker processes."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from study.coarse import Alignment, find_chest
from study.cohorts import Anatomy, Patient, load_anatomy, make_patient, pairs, truth_map
from study.data.manifest import Manifest, load_manifest
from study.errors import StudyError
from study.methods import METHODS
from study.metrics import hausdorff_mm, hd95_mm, mean_surface_distance_mm, point_errors_mm, waypoint_errors_mm
from study.params import StudyParams
from study.pipeline import find_method, named_rng, register_aligned
from study.results import (
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
from study.types import Floats, PointCloud, Registration
from study.waypoints import intercostal_waypoints


@dataclass(frozen=True)
class Case:
    """One CT, one patient, one method."""

    source: str
    target: str
    method: str


@dataclass(frozen=True)
class _Job:
    """What a worker needs for one case; arrays may come as read-only memory maps."""

    dataset: str
    case: Case
    seed: int
    alignment: Alignment
    waypoints_ct: Floats
    waypoints_us: Floats
    true_points: Floats | None
    true_waypoints: Floats | None
    radius_mm: float


def evaluate(job: _Job, result: Registration) -> dict[str, Any]:
    """The metrics of one registration (sec. IV); true errors only where the truth is known."""
    target = job.alignment.target
    normal = target.T_cloud_chest.rotation[:, 2]
    moved = result.transfer(job.waypoints_ct, job.radius_mm)
    values: dict[str, Any] = {
        "hd": hausdorff_mm(result.warped, target.cloud.points),
        "hd95": hd95_mm(result.warped, target.cloud.points),
        "msd": mean_surface_distance_mm(result.warped, target.cloud.points),
        "waypoint_error": waypoint_errors_mm(moved, job.waypoints_us),
        "waypoint_error_inplane": waypoint_errors_mm(moved, job.waypoints_us, normal),
    }
    if job.true_points is not None and job.true_waypoints is not None:
        errors = point_errors_mm(result.warped, job.true_points)
        values |= {
            "true_error_mean": errors.mean(),
            "true_error_p95": np.percentile(errors, 95),
            "true_error_max": errors.max(),
            "true_waypoint_error": waypoint_errors_mm(moved, job.true_waypoints),
            "true_waypoint_error_inplane": waypoint_errors_mm(moved, job.true_waypoints, normal),
        }
    return values


def run_case(job: _Job) -> tuple[list[Row], float]:
    """Rows and seconds of one case; a failure is a row with its reason."""
    case = job.case
    who = (job.dataset, case.source, case.target, case.method, job.seed)
    start = time.perf_counter()
    with threadpool_limits(1):  # sums then have one order, whatever the number of workers
        try:
            rng = named_rng(job.seed, f"{case.source}/{case.target}/{case.method}")
            result = register_aligned(job.alignment, find_method(case.method), rng)
            rows = metric_rows(*who, evaluate(job, result), converged=result.converged)
        except StudyError as error:
            rows = [failed_row(*who, str(error))]
    return rows, time.perf_counter() - start


def _attempt(function: Any, *arguments: Any) -> Any:
    """The result, or the `StudyError` instead of raising it."""
    with threadpool_limits(1):
        try:
            return function(*arguments)
        except StudyError as error:
            return error


def _in_parallel(calls: Sequence[tuple[Any, ...]], n_jobs: int, label: str, show: bool) -> list[Any]:
    """Run ``(function, *arguments)`` calls in processes, in order, with progress and time left."""
    if n_jobs == 1:
        results: Iterator[Any] = (_attempt(*call) for call in calls)
    else:
        results = Parallel(n_jobs=n_jobs, return_as="generator")(delayed(_attempt)(*call) for call in calls)
    return list(tqdm(results, total=len(calls), desc=label, disable=not show, unit="case"))


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
        StudyError: an unknown dataset or method; a pair that fails is a row instead.
    """
    chosen = list(METHODS) if methods is None else list(methods)
    for name in chosen:
        find_method(name)
    manifest = manifest or load_manifest()
    todo = pairs(dataset, params, manifest)
    names = list(dict.fromkeys(name for pair in todo for name in pair))
    calls: list[tuple[Any, ...]] = [(_timed, load_anatomy, dataset, name, params, seed, manifest) for name in names]
    loaded = dict(zip(names, _in_parallel(calls, n_jobs, "anatomies", show_progress), strict=True))
    targets = list(dict.fromkeys(target for _, target in todo))
    calls = [(_timed, make_patient, _anatomy(loaded[name]), params, seed) for name in targets if _ok(loaded[name])]
    seen = iter(_in_parallel(calls, n_jobs, "virtual sweeps", show_progress))
    patients = {name: next(seen) if _ok(loaded[name]) else loaded[name] for name in targets}

    clouds: list[tuple[str, PointCloud]] = []
    clouds += [(name, _anatomy(loaded[name]).cloud) for name in {s for s, _ in todo} if _ok(loaded[name])]
    clouds += [(f"us:{name}", patients[name][0].cloud) for name in targets if _ok(patients[name])]
    calls = [(_timed, find_chest, cloud) for _, cloud in clouds]
    found = _in_parallel(calls, n_jobs, "coarse alignment", show_progress)
    chests = dict(zip((name for name, _ in clouds), found, strict=True))

    rows: list[Row] = []
    timings: list[Row] = []
    jobs: list[_Job] = []
    for source, target in todo:
        cases = [Case(source, target, method) for method in chosen]
        try:
            jobs += _jobs(dataset, cases, params, seed, loaded[source], patients[target], chests)
        except StudyError as error:
            rows += [failed_row(dataset, source, target, case.method, seed, str(error)) for case in cases]
    results = _in_parallel([(run_case, job) for job in jobs], n_jobs, f"{dataset}: cases", show_progress)
    for job, (case_rows, seconds) in zip(jobs, results, strict=True):
        rows += case_rows
        timings.append(_timing(dataset, job.case.source, job.case.target, job.case.method, seed, "register", seconds))
    for stage, table in (("anatomy", loaded), ("sweep", patients), ("coarse", chests)):
        timings += [
            _timing(dataset, name, "", "", seed, stage, value[1]) for name, value in table.items() if _ok(value)
        ]
    return rows, timings


def _timed(function: Any, *arguments: Any) -> tuple[Any, float]:
    start = time.perf_counter()
    return function(*arguments), time.perf_counter() - start


def _ok(value: Any) -> bool:
    return not isinstance(value, StudyError)


def _anatomy(value: tuple[Anatomy, float]) -> Anatomy:
    return value[0]


def _timing(dataset: str, subject: str, target: str, method: str, seed: int, stage: str, seconds: float) -> Row:
    values = (dataset, subject, target, method, seed, stage, round(seconds, 3))
    return dict(zip(("dataset", "subject", "target", "method", "seed", "stage", "seconds"), values, strict=True))


def _jobs(
    dataset: str,
    cases: Sequence[Case],
    params: StudyParams,
    seed: int,
    source: tuple[Anatomy, float] | StudyError,
    target: tuple[Patient, float] | StudyError,
    chests: dict[str, Any],
) -> list[_Job]:
    """The jobs of one pair.

    Raises:
        StudyError: an earlier stage of either side failed.
    """
    if isinstance(source, StudyError):
        raise source
    if isinstance(target, StudyError):
        raise target
    anatomy, patient = source[0], target[0]
    ends = chests[cases[0].source], chests[f"us:{cases[0].target}"]
    for end in ends:
        if isinstance(end, StudyError):
            raise end
    alignment = Alignment(ends[0][0], ends[1][0])
    waypoints_us = intercostal_waypoints(patient.labelled).points
    truth = truth_map(dataset, anatomy, cases[0].target)
    true_points = None if truth is None else patient.T_us_ras.apply(truth(anatomy.cloud.points))
    true_waypoints = None if truth is None else patient.T_us_ras.apply(truth(anatomy.waypoints.points))
    return [
        _Job(
            dataset,
            case,
            seed,
            alignment,
            anatomy.waypoints.points,
            waypoints_us,
            true_points,
            true_waypoints,
            params.radius_mm,
        )
        for case in cases
    ]


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
    """Run a dataset and write ``metrics.csv``, ``timings.csv``, ``provenance.json`` and the tables into ``out``."""
    manifest = manifest or load_manifest()
    started = datetime.now(UTC)
    rows, timings = run_dataset(
        dataset, params, methods=methods, seed=seed, n_jobs=n_jobs, manifest=manifest, show_progress=show_progress
    )
    write_metrics(rows, out / "metrics.csv")
    write_timings(timings, out / "timings.csv")
    parameters = run_parameters(params, methods)
    inputs = {"data_manifest.yaml": sha256_of(manifest.path)}
    if dataset in manifest.cohorts:
        inputs |= {key: file.sha256 for key, file in manifest.files_of(dataset).items() if file.sha256}
    write_json(provenance(parameters, seed, inputs, started, datetime.now(UTC)), out / "provenance.json")
    write_tables(pd.DataFrame(rows), out)


def run_parameters(params: StudyParams, methods: Iterable[str] | None = None) -> dict[str, Any]:
    """Every parameter of a run, for its provenance."""
    chosen = list(METHODS) if methods is None else list(methods)
    return {"study": asdict(params), "methods": {name: asdict(METHODS[name]) for name in chosen}}


def load_or_run(
    dataset: str, params: StudyParams, folder: Path, *, seed: int = 0, n_jobs: int = 1, show_progress: bool = False
) -> tuple[pd.DataFrame, str]:
    """The metrics of a dataset: those in ``folder`` if the code and parameters of now made them, else of a new run.

    Returns:
        rows as `read_metrics` gives them, and a sentence that says where they are from.
    """
    reason = why_stale(folder, run_parameters(params), seed)
    if reason is not None:
        run_study(dataset, params, folder, seed=seed, n_jobs=n_jobs, show_progress=show_progress)
    metrics = read_metrics(folder / "metrics.csv")
    return metrics, "loaded: code, parameters and seed are those of now" if reason is None else f"run now: {reason}"


def write_tables(metrics: pd.DataFrame, out: Path) -> None:
    """Hausdorff tables in the shape of the paper's Table I: one a patient, columns the CTs.

    One CT with several patients (the planted deformations) is turned: columns are the patients.
    """
    targets = sorted(metrics["target"].unique())
    dataset = metrics["dataset"].iloc[0]
    if metrics["subject"].nunique() == 1:
        turned = metrics.assign(subject=metrics["target"])
        caption = f"Hausdorff distance, {dataset}: {metrics['subject'].iloc[0]} to each simulated patient"
        write_hd_table(turned, out / "hd_table", caption=caption)
        return
    for target in targets:
        stem = out / ("hd_table" if len(targets) == 1 else f"hd_table_{target}")
        caption = f"Hausdorff distance, {dataset}: each CT to the simulated patient {target}"
        write_hd_table(metrics[metrics["target"] == target], stem, caption=caption)
    if len(targets) > 1:
        pairs_named = metrics.assign(subject=metrics["subject"] + " to " + metrics["target"])
        write_hd_table(pairs_named, out / "hd_all_pairs", caption=f"Hausdorff distance, {dataset}: all ordered pairs")
