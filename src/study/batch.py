"""A whole data set: every pair, every method, in any number of worker processes."""

from __future__ import annotations

import hashlib
import os
import sys
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from study.alignment.chest import Chest, find_chest
from study.datasets import Anatomy, Dataset, Patient, find_dataset
from study.errors import StudyError
from study.evaluation.metrics import judge
from study.evaluation.pair import TRUTH, Pair, perfect
from study.files.atomic import sha256_of
from study.methods import METHODS
from study.params import find_profile
from study.pipeline import find_method, register_aligned
from study.results.metrics_csv import TIMING_COLUMNS, Case, Row, failed_row, metric_rows
from study.results.run import Run, run_folder, write_run
from study.seeds import named_rng

K = TypeVar("K", bound=Hashable)
Call = tuple[Any, ...]  # a function and its arguments


@dataclass(frozen=True)
class Outcome:
    """What one call gave, a value or why it failed, and how long it took."""

    value: Any = None
    error: StudyError | None = None
    seconds: float = 0.0

    def get(self) -> Any:
        """The value.

        Raises:
            StudyError: the call, or one that it builds on, failed.
        """
        if self.error is not None:
            raise self.error
        return self.value


@dataclass(frozen=True)
class Workers:
    """Processes that run independent calls, and a bar that shows how far they are."""

    n_jobs: int
    show_progress: bool

    def run(self, label: str, calls: Mapping[K, Call]) -> dict[K, Outcome]:
        """Run every ``(function, *arguments)``; an argument that is an earlier outcome stands for its value."""
        if self.n_jobs == 1:
            outcomes: Iterator[Outcome] = (_attempt(*call) for call in calls.values())
        else:
            todo = (delayed(_attempt)(*call) for call in calls.values())
            outcomes = Parallel(n_jobs=self.n_jobs, return_as="generator")(todo)
        bar = tqdm(
            outcomes,
            total=len(calls),
            desc=label,
            bar_format="{desc}: {n_fmt} of {total_fmt} |{bar:20}| {elapsed} so far, about {remaining} left",
            mininterval=0.2 if sys.stderr.isatty() else 15,  # a log file needs a line now and then, not a moving bar
            disable=not (self.show_progress and calls),
        )
        return dict(zip(calls, bar, strict=True))


def _attempt(function: Callable[..., Any], *arguments: Any) -> Outcome:
    """Make one call; a failure, its own or an argument's, is kept instead of raised."""
    start = time.perf_counter()
    value, failure = None, None
    with threadpool_limits(1):  # sums then have one order, whatever the number of workers
        try:
            value = function(*(a.get() if isinstance(a, Outcome) else a for a in arguments))
        except StudyError as error:
            failure = error
    return Outcome(value, failure, time.perf_counter() - start)


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
    workers = Workers(n_jobs, show_progress)
    judged = [*chosen_methods(methods), *([TRUTH] if dataset.has_truth else [])]
    anatomies = _anatomies(dataset, workers)
    patients = workers.run(
        f"{dataset.name}: virtual sweeps",
        {name: (dataset.patient, name, anatomies[name]) for name in dict.fromkeys(t for _, t in dataset.pairs())},
    )
    chests = workers.run(
        f"{dataset.name}: coarse alignment",
        {("ct", name): (_chest, anatomies[name]) for name in dict.fromkeys(s for s, _ in dataset.pairs())}
        | {("us", name): (_chest, patient) for name, patient in patients.items()},
    )
    pairs = workers.run(
        f"{dataset.name}: pairs",
        {
            (s, t): (_pair, dataset, anatomies[s], patients[t], chests["ct", s], chests["us", t])
            for s, t in dataset.pairs()
        },
    )
    cases = workers.run(
        f"{dataset.name}: registrations",
        {
            Case(dataset.name, *names, method, dataset.seed): (
                run_case,
                method,
                pair,
                dataset.seed,
                dataset.params.radius_mm,
            )
            for names, pair in pairs.items()
            for method in judged
        },
    )
    steps = {(name, "", "", "anatomy"): outcome for name, outcome in anatomies.items()}
    steps |= {(name, "", "", "sweep"): outcome for name, outcome in patients.items()}
    steps |= {(name, "", "", f"coarse {side}"): outcome for (side, name), outcome in chests.items()}
    steps |= {(case.source, case.target, case.method, "register"): outcome for case, outcome in cases.items()}
    return _metric_rows(cases), _timing_rows(dataset, steps)


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


def _anatomies(dataset: Dataset, workers: Workers) -> dict[str, Outcome]:
    """Everybody's anatomy: first those with a CT of their own, then those that are known deformations of one."""
    origins = {name: dataset.origin(name) for name in dataset.names()}
    own = list(dict.fromkeys(origin or name for name, origin in origins.items()))
    # One process fetches, with bars of its own; the workers then only read.
    fetched = {name: _attempt(dataset.fetch, name, workers.show_progress) for name in own}
    anatomies = workers.run(f"{dataset.name}: anatomies", {name: (_load, fetched[name], dataset, name) for name in own})
    return anatomies | workers.run(
        f"{dataset.name}: planted patients",
        {name: (dataset.anatomy, name, anatomies[origin]) for name, origin in origins.items() if origin},
    )


def _load(_fetched: None, dataset: Dataset, name: str) -> Anatomy:
    """An anatomy whose files are here, without its images."""
    return dataset.anatomy(name).without_images()


def _chest(person: Anatomy | Patient) -> Chest:
    return find_chest(person.cloud)


def _pair(dataset: Dataset, source: Anatomy, patient: Patient, ct: Chest, us: Chest) -> Pair:
    return dataset.pair(source, patient, (ct, us))


def run_case(method: str, pair: Pair, seed: int, radius_mm: float) -> tuple[dict[str, Any], bool]:
    """Register and judge one pair; of method ``TRUTH``, what a perfect registration scores.

    Returns:
        values by metric, and whether the method converged.

    Raises:
        StudyError: the method or the path transfer failed.
    """
    if method == TRUTH:
        result = perfect(pair)
    else:
        result = register_aligned(pair.alignment, find_method(method), named_rng(seed, f"{pair.name}/{method}"))
    return judge(pair, result, radius_mm), result.converged


def _metric_rows(cases: Mapping[Case, Outcome]) -> list[Row]:
    rows: list[Row] = []
    for case, outcome in cases.items():
        if outcome.error is None:
            values, converged = outcome.value
            rows += metric_rows(case, values, converged=converged)
        else:
            rows.append(failed_row(case, str(outcome.error)))
    return rows


def _timing_rows(dataset: Dataset, steps: Mapping[tuple[str, str, str, str], Outcome]) -> list[Row]:
    return [
        dict(zip(TIMING_COLUMNS, (dataset.name, *who, dataset.seed, stage, round(outcome.seconds, 3)), strict=True))
        for (*who, stage), outcome in steps.items()
        if outcome.error is None
    ]


def run_study(
    dataset: Dataset,
    out: Path,
    *,
    methods: Iterable[str] | None = None,
    n_jobs: int = 1,
    show_progress: bool = False,
) -> Run:
    """Run a data set and write ``metrics.csv``, ``timings.csv``, ``provenance.json`` and the tables into ``out``.

    Args:
        dataset: see `run_dataset`.
        out: folder of results.
        methods: names in ``METHODS``; all when None.
        n_jobs: worker processes.
        show_progress: bars on standard error.

    Raises:
        StudyError: as `run_dataset`, or no case that succeeded; the rows with the reasons are written.
    """
    chosen = chosen_methods(methods)
    dataset.pairs()  # nobody to pair leaves no folder
    out.mkdir(parents=True, exist_ok=True)  # a folder that can't be written is better known now than after the run
    started = datetime.now(UTC)
    rows, timings = run_dataset(dataset, methods=chosen, n_jobs=n_jobs, show_progress=show_progress)
    inputs = input_hashes(dataset)
    return write_run(out, rows, timings, run_parameters(dataset, chosen), dataset.seed, inputs, started)


def run_parameters(dataset: Dataset, methods: Iterable[str] | None = None) -> dict[str, Any]:
    """Every parameter of a run, for its provenance."""
    chosen = chosen_methods(methods)
    return {"study": asdict(dataset.params), "methods": {name: asdict(METHODS[name]) for name in chosen}}


def input_hashes(dataset: Dataset) -> dict[str, str]:
    """SHA-256 of the manifest and of every file the people were read from; of a series, of all its slices."""
    inputs = {dataset.manifest.path.name: sha256_of(dataset.manifest.path)}
    for name in sorted({dataset.origin(name) or name for name in dataset.names()}):
        for key, path in dataset.files(name).items():
            slices = sorted(path.iterdir()) if path.is_dir() else [path]
            hashes = [sha256_of(slice_) for slice_ in slices]
            inputs[key] = hashes[0] if path.is_file() else hashlib.sha256("".join(hashes).encode()).hexdigest()
    return inputs


def open_run(dataset: str, profile: str = "full", seed: int = 0, *, show_progress: bool = False) -> Run:
    """The run of a data set: its folder's if the code and parameters of now made it, else a new one.

    Args:
        dataset: name of a data set.
        profile: ``"full"`` or ``"quick"``.
        seed: of the run.
        show_progress: bars on standard error.

    Raises:
        StudyError: as `run_study`.
    """
    chosen = find_dataset(dataset, find_profile(profile), seed)
    folder = run_folder(chosen.name, profile, seed)
    reason = Run(folder).why_stale(run_parameters(chosen), seed)
    if reason is None:
        return Run(folder, "loaded: code, parameters and seed are those of now")
    run_study(chosen, folder, n_jobs=min(2, os.cpu_count() or 1), show_progress=show_progress)
    return Run(folder, f"run now: {reason}")
