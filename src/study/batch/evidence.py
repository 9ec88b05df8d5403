"""`make evidence`: robustness, sensitivity and the data sets beside the reported ones; each goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd

from study.batch.runs import run_study, why_stale
from study.batch.workers import Call, Outcome, Workers
from study.datasets import find_dataset
from study.datasets import for_evidence as datasets_for_evidence
from study.errors import StudyError
from study.evaluation.disturbances import KINDS, SEEDS, Disturbance, Level, levels
from study.evaluation.robustness import ROBUST_METHODS, failed_rows, robustness_rows, robustness_summary
from study.evaluation.sensitivity import Setting, sensitivity_rows, sensitivity_summary, settings
from study.figures.canvas import picture_files
from study.figures.evidence import choice_pages, choices, robustness
from study.files.atomic import json_text, sha256_of, write_bytes, write_json, write_text
from study.methods import METHODS
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.params import find_profile
from study.results.claim import PROVENANCE, claimed
from study.results.evidence import (
    PEOPLE,
    ROBUSTNESS,
    SENSITIVITY,
    Evidence,
    evidence_folder,
    find_evidence,
    pairs_table,
)
from study.results.journal import Journal
from study.results.provenance import arithmetic, provenance
from study.results.run import Run
from study.results.verdicts import write_claims
from study.skeleton.som import SomParams

Rows = list[dict[str, Any]]

# What the setting is worth and what the surface, the reported data sets sort out; here that would double the time.
COMPARED = tuple(name for name in METHODS if name == "cpd_tuned_whole" or not name.endswith(("_visible", "_whole")))


@dataclass(frozen=True)
class EvidencePlan:
    """How much evidence is gathered.

    Attributes:
        base: what no level varies.
        kinds: of disturbances.
        ends_only: the first and the last level of a kind alone.
        people: cohort seeds of the pairs, a draw each.
        methods: that robustness is asked of.
        tried_on: cohort seeds of the pairs that choices are tried on.
        method_seeds: of the graph's draws, for each choice.
        graph: whose choices.
        choices: those that are tried; all when empty.
        datasets: of more people; those that the manifest calls evidence when None.
        compared: methods that are run on them.
    """

    base: Disturbance = field(default_factory=Disturbance)
    kinds: tuple[str, ...] = tuple(KINDS)
    ends_only: bool = False
    people: tuple[int, ...] = SEEDS
    methods: tuple[str, ...] = ROBUST_METHODS
    tried_on: tuple[int, ...] = SEEDS[:10]
    method_seeds: tuple[int, ...] = (0, 1)
    graph: SkeletonGraphMethod = field(default_factory=SkeletonGraphMethod)
    choices: tuple[str, ...] = ()
    datasets: tuple[str, ...] | None = None
    compared: tuple[str, ...] = COMPARED

    def levels(self) -> list[Level]:
        """The levels that are run."""
        chosen = [level for level in levels(self.base) if level.kind in self.kinds]
        ends = {kind: [level for level in chosen if level.kind == kind] for kind in self.kinds}
        return [one for kind in ends.values() for one in (kind[0], kind[-1])] if self.ends_only else chosen

    def settings(self) -> list[Setting]:
        """The choices that are tried.

        Raises:
            StudyError: a choice that is none.
        """
        known = {one.choice for one in settings(self.graph)}
        unknown = sorted(set(self.choices) - known)
        if unknown:
            raise StudyError(f"expected choices among {', '.join(sorted(known))}, got {', '.join(unknown)}")
        return [one for one in settings(self.graph) if not self.choices or one.choice in self.choices]


_SHORT = SomParams(epochs=20, samples=50)
PLANS: Mapping[str, EvidencePlan] = MappingProxyType(
    {
        "full": EvidencePlan(),
        "quick": EvidencePlan(
            base=Disturbance(ct_points=2000, us_points=2000),
            kinds=("noise", "outliers", "strips"),
            ends_only=True,
            people=SEEDS[:2],
            methods=("coarse", "icp_tuned"),
            tried_on=SEEDS[:2],
            method_seeds=(0,),
            graph=SkeletonGraphMethod(_SHORT, _SHORT),
            # Those whose options take no longer than the published one.
            choices=(
                "random draws",
                "nodes that may win a point",
                "weights of the blend (Eq. 4)",
                "parts of a cartilage (waypoints)",
                "rectangle of the sternum (coarse)",
            ),
            datasets=("population",),  # the others need files
            compared=("coarse", "icp", "cpd", "skeleton_graph", "cpd_tuned", "cpd_tuned_whole"),
        ),
    }
)


@dataclass(frozen=True)
class _Part:
    """One folder of evidence.

    Attributes:
        name: of the folder.
        parameters: everything that decides its numbers beside the code.
        calls: what gives the rows, by a key that is text.
        lost: rows of a call that failed in a way nobody foresaw.
        tables: the files' tables, by name, and the figures, from all rows.
    """

    name: str
    parameters: Mapping[str, Any]
    calls: Mapping[str, Call]
    lost: Callable[[str, StudyError], Rows]
    tables: Callable[[dict[str, Rows]], tuple[dict[str, pd.DataFrame], dict[str, bytes]]]


def run_evidence(
    out: Path, *, profile: str = "full", plan: EvidencePlan | None = None, n_jobs: int = 1, show_progress: bool = False
) -> list[Path]:
    """Gather all evidence into folders below ``out``; what is there and of now is left as it is.

    A run that is stopped, however, goes on when it is started again, case by case.

    Args:
        out: holds ``robustness``, ``sensitivity``, a folder for each data set, and ``people``, small tables of those.
        profile: ``"full"`` or ``"quick"``.
        plan: how much of robustness and sensitivity; the profile's when None.
        n_jobs: worker processes.
        show_progress: bars on standard error.

    Returns:
        the folders.

    Raises:
        StudyError: an unknown profile, a folder that is not of a run, or a data set of which every case failed.
    """
    params = find_profile(profile)
    plan = plan or PLANS[profile]
    workers = Workers(n_jobs, show_progress)
    folders = [_run_part(part, out / part.name, workers) for part in (_robustness(plan), _sensitivity(plan))]
    runs = []
    for name in datasets_for_evidence() if plan.datasets is None else plan.datasets:
        dataset, folder = find_dataset(name, params), out / name
        if why_stale(Run(folder), dataset, plan.compared) is not None:
            run_study(
                dataset,
                folder,
                methods=plan.compared,
                n_jobs=n_jobs,
                show_progress=show_progress,
                keep_clouds=False,  # of more people than anybody looks at
            )
        runs.append(Run(folder))
    return [*folders, *(run.folder for run in runs), *([_people(runs, out / PEOPLE)] if runs else [])]


def open_evidence(profile: str = "full") -> Evidence:
    """What `make evidence` left, or what is committed of it; of the quick profile, run now where it is not of now.

    Raises:
        StudyError: neither is there for the full profile, which takes an hour and is not run unasked.
    """
    if profile != "full":
        run_evidence(evidence_folder(profile), profile=profile)
    found = find_evidence(profile)
    if found is None:
        raise StudyError(f"expected evidence at {evidence_folder(profile)}, got none; run `make evidence`")
    return found


def _people(runs: list[Run], folder: Path) -> Path:
    """The small tables of runs of more people."""
    started = datetime.now(UTC)
    with claimed(folder) as claim:
        new = claim.new()
        pairs = pairs_table(runs)
        write_text(new / "pairs.csv", pairs.to_csv(index=False, lineterminator="\n", float_format="%.4f"))
        write_claims(runs, new)
        record = provenance(
            PEOPLE, {run.dataset: dict(run.provenance) for run in runs}, 0, {}, started, datetime.now(UTC)
        )
        hashes = {path.name: sha256_of(path) for path in new.iterdir()}
        write_json({**record, "files_sha256": hashes}, new / PROVENANCE)
        claim.swap_in()
    return folder


def _robustness(plan: EvidencePlan) -> _Part:
    # A level that several kinds share, as what is not disturbed, is run once, under the first one's name; one pair
    # after the other, so that a run that is stopped has whole pairs.
    names: dict[Disturbance, str] = {}
    for level in plan.levels():
        names.setdefault(level.disturbance, f"{level.kind} {level.value:g}")
    calls = {
        f"{people} {name}": (robustness_rows, disturbance, people, plan.methods)
        for people in plan.people
        for disturbance, name in names.items()
    }

    def lost(key: str, error: StudyError) -> Rows:
        people = int(key.split()[0])
        return [row for method in plan.methods for row in failed_rows(people, method, error)]

    def tables(rows: dict[str, Rows]) -> tuple[dict[str, pd.DataFrame], dict[str, bytes]]:
        found = pd.DataFrame(
            [
                {"kind": level.kind, "level": level.value, **row}
                for level in plan.levels()
                for people in plan.people
                for row in rows[f"{people} {names[level.disturbance]}"]
            ]
        )
        draws = found[["kind", "level", "draw", "method", "metric", "value", "status"]]
        refused = found.loc[found["reason"] != "", ["kind", "level", "draw", "method", "status", "reason"]]
        summary = robustness_summary(found)
        in_plane = robustness(summary, "true_waypoint_error_inplane")
        drawn = {ROBUSTNESS: robustness(summary), f"{ROBUSTNESS}_inplane": in_plane}
        return {"summary": summary, "draws": draws, "refused": refused.drop_duplicates()}, picture_files(drawn)

    parameters = {
        "levels": [asdict(level) for level in plan.levels()],
        "people": plan.people,
        "methods": {name: asdict(METHODS[name]) for name in plan.methods},
    }
    return _Part(ROBUSTNESS, parameters, calls, lost, tables)


def _sensitivity(plan: EvidencePlan) -> _Part:
    listed, seeds = plan.settings(), plan.method_seeds
    calls = {str(people): (sensitivity_rows, people, listed, seeds, plan.base) for people in plan.tried_on}

    def lost(key: str, error: StudyError) -> Rows:
        raise error

    def tables(rows: dict[str, Rows]) -> tuple[dict[str, pd.DataFrame], dict[str, bytes]]:
        found = pd.DataFrame([row for key in calls for row in rows[key]])
        wide = found.pivot_table(
            index=["choice", "option", "role", "people", "seed"], columns="metric", values="value", sort=False
        )
        summary = sensitivity_summary(found)
        failed = found.loc[found["reason"] != "", ["choice", "option", "people", "seed", "reason"]]
        tables = {"summary": summary, "draws": wide.reset_index(), "refused": failed.drop_duplicates()}
        pages = {
            f"{SENSITIVITY}{f'_{k + 1}' * (k > 0)}": choices(summary, only)
            for k, only in enumerate(choice_pages(summary))
        }
        return tables, picture_files(pages)

    parameters = {
        "settings": [asdict(one) for one in listed],
        "people": plan.tried_on,
        "method_seeds": seeds,
        "disturbance": asdict(plan.base),
    }
    return _Part(SENSITIVITY, parameters, calls, lost, tables)


def _run_part(part: _Part, folder: Path, workers: Workers) -> Path:
    """The folder of a part: as it is where code and parameters of now made it, else made."""
    started = datetime.now(UTC)
    basis = {**arithmetic(), "part": part.name, "parameters": json.loads(json_text(part.parameters))}
    if _is_of_now(Run(folder), basis):
        return folder
    with claimed(folder) as claim:
        journal = Journal(claim.journal, basis)
        outcomes = _outcomes(part, journal, workers)
        rows = {
            key: outcome.value if outcome.error is None else part.lost(key, outcome.error)
            for key, outcome in outcomes.items()
        }
        tables, pictures = part.tables(rows)
        new = claim.new()
        for name, table in tables.items():
            write_text(new / f"{name}.csv", table.to_csv(index=False, lineterminator="\n", float_format="%.4f"))
        for name, picture in pictures.items():
            write_bytes(new / name, picture)
        seconds = [f"{key},{outcome.seconds:.3f}\n" for key, outcome in outcomes.items()]  # no key holds a comma
        write_text(new / "timings.csv", "case,seconds\n" + "".join(seconds))
        record = provenance(part.name, part.parameters, 0, {}, started, datetime.now(UTC))
        record["code_sha256"] = basis["code_sha256"]  # that was run, whatever was edited since
        hashes = {path.name: sha256_of(path) for path in new.iterdir()}
        write_json({**record, "files_sha256": hashes}, new / PROVENANCE)
        claim.swap_in()
    return folder


def _is_of_now(run: Run, basis: Mapping[str, Any]) -> bool:
    try:
        before = run.provenance
        return run.altered is None and all(before.get(name) == basis[name] for name in ("code_sha256", "parameters"))
    except StudyError:  # nothing there
        return False


def _outcomes(part: _Part, journal: Journal, workers: Workers) -> dict[str, Outcome]:
    """Every call's outcome in the order of the calls: kept ones, and those that are done now and kept."""
    kept = {key: piece for key in part.calls if (piece := journal.get({"case": key})) is not None}

    def keep(key: str, outcome: Outcome) -> None:
        if outcome.error is None:  # what failed is tried again: it may have been memory
            journal.keep({"case": key}, {"rows": outcome.value, "seconds": outcome.seconds})

    todo = {key: call for key, call in part.calls.items() if key not in kept}
    done = workers.run(part.name, todo, keep)
    before = {key: Outcome(piece["rows"], seconds=piece["seconds"]) for key, piece in kept.items()}
    return {key: before[key] if key in before else done[key] for key in part.calls}
