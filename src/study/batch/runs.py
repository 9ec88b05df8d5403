"""A run of a data set: rows, or a folder of results that is made, gone on with, or found to be of now."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from study.batch.cases import Work, all_cases, input_hashes
from study.batch.workers import Workers
from study.data.manifest import default_manifest_path
from study.datasets import Dataset, find_dataset
from study.errors import StudyError
from study.files.atomic import sha256_of
from study.files.places import CHECKOUT, is_checkout
from study.methods import METHODS
from study.params import find_profile
from study.pipeline import find_method
from study.results.claim import Claim, claimed
from study.results.journal import Journal
from study.results.metrics_csv import Row
from study.results.provenance import arithmetic, provenance
from study.results.run import Run, run_folder, write_run

JOBS = "STUDY_JOBS"  # environment variable: how many processes a run that a notebook makes may have


def run_dataset(
    dataset: Dataset, *, methods: Iterable[str] | None = None, n_jobs: int = 1, show_progress: bool = False
) -> tuple[list[Row], list[Row]]:
    """All cases of a data set.

    Args:
        dataset: who is registered to whom, how finely, with which seed.
        methods: names in ``METHODS``; all when None.
        n_jobs: worker processes.
        show_progress: bars on standard error.

    Returns:
        rows of ``metrics.csv`` and of ``timings.csv``.

    Raises:
        StudyError: nobody to pair, or an unknown method; a person or pair that fails is rows instead.
    """
    work = Work(dataset, Workers(n_jobs, show_progress), Journal(None, {}), keeps_clouds=False)
    results = all_cases(work, chosen_methods(methods))
    return results.rows, results.timings


def chosen_methods(methods: Iterable[str] | None) -> list[str]:
    """Names of the methods to run, each once and known; all when None.

    Raises:
        StudyError: none, or an unknown one.
    """
    chosen = list(METHODS) if methods is None else list(dict.fromkeys(methods))
    if not chosen:
        raise StudyError(f"expected a method among {', '.join(METHODS)}, got none")
    for name in chosen:
        find_method(name)
    return chosen


def run_study(
    dataset: Dataset,
    out: Path,
    *,
    methods: Iterable[str] | None = None,
    n_jobs: int = 1,
    show_progress: bool = False,
    scheduler: str | None = None,
    keep_clouds: bool = True,
) -> Run:
    """Run a data set and put ``metrics.csv``, ``timings.csv``, ``provenance.json`` and tables into ``out``, at once.

    Finished cases are kept beside ``out`` until then: a run that is stopped, however, goes on when it is started again.

    Args:
        dataset: see `run_dataset`.
        out: folder of results, new or of an earlier run; files in it that are not a run's stay.
        methods: names in ``METHODS``; all when None.
        n_jobs: worker processes.
        show_progress: bars on standard error.
        scheduler: of a Dask cluster whose workers do it instead, as in ``tcp://127.0.0.1:8786``.
        keep_clouds: what `study report --html` draws, about 50 kB a case.

    Raises:
        StudyError: as `run_dataset`; a folder that is not a run's or that another process is writing; or no case that
            succeeded, the rows with the reasons are written then.
    """
    chosen = chosen_methods(methods)
    dataset.pairs()  # nobody to pair leaves no folder
    with claimed(out) as claim:  # a folder that can't be written is better known now than after the run
        _run_claimed(dataset, claim, chosen, Workers(n_jobs, show_progress, scheduler), keep_clouds)
    return _with_values(Run(out))


def _run_claimed(
    dataset: Dataset, claim: Claim, methods: list[str], workers: Workers, keep_clouds: bool = True
) -> None:
    started = datetime.now(UTC)
    basis = {
        **arithmetic(),
        "dataset": dataset.name,
        "manifest": sha256_of(dataset.manifest.path),
        "study": asdict(dataset.params),
        "seed": dataset.seed,
    }
    work = Work(dataset, workers, Journal(claim.journal, basis), keeps_clouds=keep_clouds)
    results = all_cases(work, methods)
    inputs = {dataset.manifest.path.name: basis["manifest"]}
    inputs |= {key: sha256 for files in work.inputs.values() for key, sha256 in files.items()}
    parameters = run_parameters(dataset, methods)
    record = provenance(dataset.name, parameters, dataset.seed, inputs, started, datetime.now(UTC))
    record["peak_memory_mb"] = round(work.peak_mb)  # of one process; the timing rows have asked for every step
    record["code_sha256"] = basis["code_sha256"]  # that was run, whatever was edited since
    record["own_manifest"] = (
        dataset.manifest.path != default_manifest_path()
    )  # whose people are no others' of the paper
    failures = [f"{' '.join(filter(None, step))}\n{trace}" for step, trace in work.traces.items()]
    write_run(claim, results.rows, results.timings, record, "\n".join(failures), _made_with(dataset), results.clouds)


def _made_with(dataset: Dataset) -> dict[str, Path]:
    """Files that belong beside a run: its manifest, and the lock where there is a checkout."""
    lock = CHECKOUT / "environment.lock"
    return {"manifest.yaml": dataset.manifest.path} | ({lock.name: lock} if is_checkout() and lock.is_file() else {})


def _with_values(run: Run) -> Run:
    """A run in which some case succeeded.

    Raises:
        StudyError: every case failed, with the reasons.
    """
    if run.values.empty:
        raise StudyError(f"{run.dataset}: every case failed: {' | '.join(sorted(set(run.failures['reason'])))}")
    return run


def run_parameters(dataset: Dataset, methods: Iterable[str] | None = None) -> dict[str, Any]:
    """Every parameter of a run, for its provenance."""
    chosen = chosen_methods(methods)
    return {"study": asdict(dataset.params), "methods": {name: asdict(METHODS[name]) for name in chosen}}


def why_stale(run: Run, dataset: Dataset, methods: Iterable[str] | None = None) -> str | None:
    """Why a run cannot stand for one of ``methods`` (all when None) made now, see `Run.why_stale`; None when it can."""
    inputs = {dataset.manifest.path.name: sha256_of(dataset.manifest.path)}
    for name in dict.fromkeys(dataset.origin(name) or name for name in dataset.names()):
        inputs |= input_hashes(dataset, name)
    return run.why_stale(dataset.name, run_parameters(dataset, methods), dataset.seed, inputs)


def split_methods(text: str) -> list[str] | None:
    """Names of methods from one word, ``"icp,cpd"``; None, which stands for all, when it is empty."""
    return [name.strip() for name in text.split(",")] if text else None


def _n_jobs() -> int:
    """Processes of a run that a notebook makes.

    Raises:
        StudyError: ``STUDY_JOBS`` is not a number of processes.
    """
    told = os.environ.get(JOBS, "")
    if told and not (told.isdecimal() and int(told) > 0):
        raise StudyError(f"{JOBS}: expected a number of processes, got {told!r}; unset it or give one from 1")
    return int(told) if told else min(2, os.cpu_count() or 1)


def open_run(
    dataset: str, profile: str = "full", seed: int = 0, methods: str = "", *, show_progress: bool = False
) -> Run:
    """The run of a data set: its folder's if the code, parameters and inputs of now made it, else a new one.

    A run that another process is making is waited for. A new one has as many processes as the environment variable
    ``STUDY_JOBS`` says, which `study notebooks` sets for its notebooks; two, where there are as many cores, without it.

    Args:
        dataset: name of a data set, or the path of a manifest file.
        profile: ``"full"`` or ``"quick"``.
        seed: of the run.
        methods: names with commas between, ``"icp,cpd"``, all when empty: a parameter that papermill can give.
        show_progress: bars on standard error.

    Raises:
        StudyError: as `run_study`.
    """
    chosen = find_dataset(dataset, find_profile(profile), seed)
    those = split_methods(methods)
    folder = run_folder(chosen.name, profile, seed, those)
    reason = why_stale(Run(folder), chosen, those)
    if reason is not None:
        with claimed(folder, wait=True) as claim:
            reason = why_stale(Run(folder), chosen, those)  # of now: who was waited for may have made it
            if reason is not None:
                _run_claimed(chosen, claim, chosen_methods(those), Workers(_n_jobs(), show_progress))
    made = "loaded: code, parameters and seed are those of now" if reason is None else f"run now: {reason}"
    return _with_values(Run(folder, made))
