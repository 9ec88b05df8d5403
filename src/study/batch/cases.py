"""Every case of a data set: what it needs, step by step, and its rows; what is finished is not done again."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from study.alignment.chest import Chest, find_chest
from study.batch.workers import Call, Outcome, Workers, attempt
from study.datasets import Anatomy, Dataset, Patient
from study.evaluation.judgement import Judgement
from study.evaluation.metrics import judge
from study.evaluation.pair import TRUTH, Pair, perfect
from study.files.atomic import sha256_of
from study.methods import METHODS
from study.naming import split_sweep
from study.offline import is_offline
from study.pipeline import find_method, register_aligned
from study.results.clouds import CaseName, pack
from study.results.journal import Journal
from study.results.metrics_csv import TIMING_COLUMNS, Case, Row, failed_row, metric_rows
from study.seeds import named_rng


class Step(NamedTuple):
    """A piece of a run: whom it is about, with which method, and what is done."""

    source: str
    target: str
    method: str
    stage: str


@dataclass
class Work:
    """The steps of one run: those of a run that was stopped are taken over, the others are done and kept.

    Attributes:
        dataset: who is registered to whom.
        workers: that do it.
        journal: of finished steps.
        inputs: SHA-256 of the files of each person of their own, by name and key.
        traces: where in the code steps failed that nobody foresaw.
        peak_mb: the most memory that one process held in a finished step, now or before a run was stopped.
        keeps_clouds: for pictures of each case, see `study.results.clouds`.
    """

    dataset: Dataset
    workers: Workers
    journal: Journal
    inputs: dict[str, dict[str, str]] = field(default_factory=dict)
    traces: dict[Step, str] = field(default_factory=dict)
    peak_mb: float = 0.0
    keeps_clouds: bool = True

    def do(self, label: str, calls: Mapping[Step, Call]) -> dict[Step, Outcome]:
        """Do steps; a finished one is kept at once."""
        return self.workers.run(f"{self.dataset.name}: {label}", calls, self._done)

    def finished(self, step: Step) -> Outcome | None:
        """A step that was done, now or before a run was stopped; its value where it is a registration."""
        piece = self.journal.get(self._facts(step))
        if piece is None:
            return None
        self.peak_mb = max(self.peak_mb, piece["peak_mb"])
        return Outcome(piece["value"], seconds=piece["seconds"], peak_mb=piece["peak_mb"])

    def _done(self, step: Step, outcome: Outcome) -> None:
        if outcome.error is None:  # what failed is tried again: it may have been the network, or memory
            value = outcome.value if step.stage == "register" else None
            kept = {"value": value, "seconds": outcome.seconds, "peak_mb": outcome.peak_mb}
            self.journal.keep(self._facts(step), kept)
        elif outcome.trace:
            self.traces[step] = outcome.trace

    def _facts(self, step: Step) -> dict[str, Any]:
        people = [name for name in (step.source, step.target) if name]
        return {
            "step": list(step),
            "method": asdict(METHODS[step.method]) if step.method in METHODS else None,
            "inputs": {name: self.inputs[_read_as(self.dataset, name)] for name in people},
        }


class Results(NamedTuple):
    """What a run gave: rows of ``metrics.csv`` and ``timings.csv``, and the packed clouds of each case."""

    rows: list[Row]
    timings: list[Row]
    clouds: dict[CaseName, str]


def all_cases(work: Work, methods: list[str]) -> Results:
    """Every case, see `run_dataset`."""
    dataset = work.dataset
    everybody = dataset.pairs()
    fetched = _fetch(work)
    judged = [*methods, *([TRUTH] if dataset.has_truth else [])]
    cases = {
        Step(*names, method, "register"): Case(dataset.name, *names, method, dataset.seed)
        for names in everybody
        for method in judged
    }
    outcomes = {step: outcome for step in cases if (outcome := work.finished(step))}
    if outcomes and work.workers.show_progress:
        print(f"{dataset.name}: {len(outcomes)} of {len(cases)} cases kept from a stopped run", file=sys.stderr)
    missing = [step for step in cases if step not in outcomes]
    pairs = _pairs(work, fetched, list(dict.fromkeys((step.source, step.target) for step in missing)))
    outcomes |= work.do(
        "registrations",
        {
            step: (
                run_case,
                cases[step],
                pairs[step.source, step.target],
                dataset.params.radius_mm,
                work.keeps_clouds,
            )
            for step in missing
        },
    )
    rows: list[Row] = []
    clouds: dict[CaseName, str] = {}
    for step, case in cases.items():
        outcome = outcomes[step]
        rows += [failed_row(case, str(outcome.error))] if outcome.error else outcome.value["rows"]
        if not outcome.error and work.keeps_clouds:
            clouds[step.source, step.target, step.method] = outcome.value["clouds"]
    return Results(rows, _timing_rows(work, [*_people_steps(everybody, list(fetched)), *cases]), clouds)


def _fetch(work: Work) -> dict[str, Outcome]:
    """Have everybody's files here and hashed, by one process with bars of its own; the workers then only read."""
    dataset, fetched = work.dataset, {}
    for name in dict.fromkeys(dataset.origin(name) or name for name in dataset.names()):
        outcome = attempt(dataset.fetch, name, work.workers.show_progress)
        hashed = attempt(input_hashes, dataset, name)
        work.inputs[name] = hashed.value or {}
        fetched[name] = hashed if outcome.error is None else outcome
        if is_offline():
            fetched[name].get()  # a file that is not here says nothing about a case: better no run than a failed row
        if fetched[name].trace:
            work.traces[_person(name, "files")] = fetched[name].trace
    return fetched


def _pairs(work: Work, fetched: Mapping[str, Outcome], chosen: list[tuple[str, str]]) -> dict[tuple[str, str], Outcome]:
    """Everything up to the coarse alignment, for the chosen pairs alone."""
    dataset = work.dataset
    sources = list(dict.fromkeys(source for source, _ in chosen))
    targets = list(dict.fromkeys(target for _, target in chosen))
    anatomies = _anatomies(work, fetched, list(dict.fromkeys([*sources, *map(_swept, targets)])))
    patients = work.do(
        "virtual sweeps", {_person(name, "sweep"): (dataset.patient, name, anatomies[_swept(name)]) for name in targets}
    )
    chests = work.do(
        "coarse alignment",
        {_person(name, "coarse ct"): (_chest, anatomies[name]) for name in sources}
        | {_person(name, "coarse us"): (_chest, patients[_person(name, "sweep")]) for name in targets},
    )
    pairs = work.do(
        "pairs",
        {
            Step(source, target, "", "pair"): (
                _pair,
                dataset,
                anatomies[source],
                patients[_person(target, "sweep")],
                chests[_person(source, "coarse ct")],
                chests[_person(target, "coarse us")],
            )
            for source, target in chosen
        },
    )
    return {(step.source, step.target): outcome for step, outcome in pairs.items()}


def _anatomies(work: Work, fetched: Mapping[str, Outcome], names: list[str]) -> dict[str, Outcome]:
    """Anatomies by name: first those with a CT of their own, then those that are known deformations of one."""
    dataset = work.dataset
    origins = {name: dataset.origin(name) for name in names}
    own = list(dict.fromkeys(origin or name for name, origin in origins.items()))
    first = work.do("anatomies", {_person(name, "anatomy"): (_load, fetched[name], dataset, name) for name in own})
    planted = {
        _person(name, "anatomy"): (dataset.anatomy, name, first[_person(origin, "anatomy")])
        for name, origin in origins.items()
        if origin
    }
    return {step.source: outcome for step, outcome in (first | work.do("planted patients", planted)).items()}


def _person(name: str, stage: str) -> Step:
    return Step(name, "", "", stage)


def _swept(patient: str) -> str:
    """The anatomy of a patient, whichever sweep it is."""
    return split_sweep(patient)[0]


def _read_as(dataset: Dataset, name: str) -> str:
    """Who is read from files when the CT, patient or sweep of a patient called ``name`` is needed."""
    anatomy = _swept(name)
    return dataset.origin(anatomy) or anatomy


def _people_steps(pairs: list[tuple[str, str]], own: list[str]) -> list[Step]:
    sources, targets = (dict.fromkeys(names) for names in zip(*pairs, strict=True))
    swept = dict.fromkeys(map(_swept, targets))
    stages = {"anatomy": {**dict.fromkeys(own), **sources, **swept}, "sweep": targets}
    stages |= {"coarse ct": sources, "coarse us": targets}
    return [_person(name, stage) for stage, names in stages.items() for name in names]


def _load(_fetched: None, dataset: Dataset, name: str) -> Anatomy:
    """An anatomy whose files are here, without its images."""
    return dataset.anatomy(name).without_images()


def _chest(person: Anatomy | Patient) -> Chest:
    return find_chest(person.cloud)


def _pair(dataset: Dataset, source: Anatomy, patient: Patient, ct: Chest, us: Chest) -> Pair:
    pair = dataset.pair(source, patient, (ct, us))
    _ = pair.visible_waypoints_ct  # kept on the pair: found here once, not by every method's worker
    return pair


def run_case(case: Case, pair: Pair, radius_mm: float, keeps_clouds: bool = False) -> dict[str, Any]:
    """Register and judge one pair; of method ``TRUTH``, what a perfect registration scores.

    Returns:
        ``rows`` of ``metrics.csv``; where clouds are kept, packed ``clouds``.

    Raises:
        StudyError: the method or the path transfer failed, or gave values that are not finite.
    """
    if case.method == TRUTH:
        result = perfect(pair)
    else:
        rng = named_rng(case.seed, f"{pair.name}/{case.method}")
        result = register_aligned(pair.alignment, find_method(case.method), rng)
    rows = metric_rows(case, judge(pair, result, radius_mm), converged=result.converged)
    if not keeps_clouds:
        return {"rows": rows}
    return {"rows": rows, "clouds": pack(result, Judgement(pair, result, radius_mm).moved, pair.alignment.T_us_ct)}


def _timing_rows(work: Work, steps: list[Step]) -> list[Row]:
    """Seconds of every step that succeeded, whichever run did it."""
    done = {step: outcome for step in steps if (outcome := work.finished(step))}
    return [
        dict(
            zip(
                TIMING_COLUMNS,
                (work.dataset.name, *step[:3], work.dataset.seed, step.stage, round(outcome.seconds, 3)),
                strict=True,
            )
        )
        for step, outcome in done.items()
    ]


def input_hashes(dataset: Dataset, name: str) -> dict[str, str]:
    """SHA-256 of every file of one person that is here, by key; of a series, of all its slices."""
    hashes = {}
    for key, path in dataset.files(name).items():
        slices = [sha256_of(slice_) for slice_ in (sorted(path.iterdir()) if path.is_dir() else [path])]
        hashes[key] = slices[0] if path.is_file() else hashlib.sha256("".join(slices).encode()).hexdigest()
    return hashes
