"""A run repeated from what its folder recorded, and what is other now than it was then."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from study.batch.runs import run_study
from study.data.manifest import load_manifest
from study.datasets import Dataset, find_dataset
from study.errors import StudyError
from study.files.atomic import json_text
from study.methods import METHODS
from study.params import StudyParams, override
from study.results.run import Run

_COMPARED = {
    "code_sha256": "code",
    "lock_sha256": "lock file",
    "inputs_sha256": "input files",
    "versions": "versions",
    "machine": "machine",
}


def rerun(
    folder: Path, out: Path, *, dataset: str | None = None, n_jobs: int = 1, show_progress: bool = False
) -> tuple[Run, list[str]]:
    """Repeat the run of a folder with its recorded data set, parameters, methods and seed.

    Args:
        folder: of the run.
        out: folder of the new one.
        dataset: a manifest file of one's own, where it is now; the recorded data set when None.
        n_jobs: worker processes.
        show_progress: bars on standard error.

    Returns:
        the new run, and a sentence for each thing that was other than at the first one.

    Raises:
        StudyError: a folder without a record of a run, or with one that this version cannot repeat; as `run_study`.
    """
    if out.resolve() == folder.resolve():
        raise StudyError(f"{out}: expected a folder beside the run that is repeated, got that run's; name another")
    run = Run(folder)
    record = run.provenance
    people, methods = _recorded(folder, record, dataset)
    told = [f"the repeated run {run.condition}"] if run.condition else []
    new = run_study(people, out, methods=methods, n_jobs=n_jobs, show_progress=show_progress)
    return new, told + differences(record, new.provenance)


def _recorded(folder: Path, record: Mapping[str, Any], dataset: str | None) -> tuple[Dataset, list[str]]:
    """The data set and the methods of a record.

    Raises:
        StudyError: one that this version cannot repeat, and why.
    """
    parameters = record.get("parameters")
    if not isinstance(parameters, Mapping) or not {"study", "methods"} <= set(parameters) or "seed" not in record:
        raise StudyError(f"{folder}: expected the record of a `study run`, got one without its parameters or seed")
    try:
        params = override(StudyParams(), **parameters["study"])
    except StudyError as error:
        raise StudyError(f"{folder}: expected parameters of this version, got others: {error}{_of(record)}") from error
    for name, recorded in parameters["methods"].items():
        if name not in METHODS:
            raise StudyError(f"{folder}: expected methods of this version, got {name!r}, which it lacks{_of(record)}")
        if json.loads(json_text(asdict(METHODS[name]))) != recorded:
            raise StudyError(
                f"{folder}: expected {name} with the parameters of this version, got others in the record{_of(record)}"
            )
    name = record.get("dataset") or Run(folder).dataset
    return _people(folder, str(name), params, int(record["seed"]), dataset), list(parameters["methods"])


def _of(record: Mapping[str, Any]) -> str:
    """What to do about a record of another version."""
    return f"; check out commit {record['commit']} and run again" if record.get("commit") else "; run it anew"


def _people(folder: Path, name: str, params: StudyParams, seed: int, dataset: str | None) -> Dataset:
    if dataset is not None:
        people = find_dataset(dataset, params, seed)
        if people.name != name:
            raise StudyError(f"{folder}: expected a manifest of {name}, as the run is of, got {people.name}")
        return people
    if name in load_manifest().cohorts:
        return find_dataset(name, params, seed)
    raise StudyError(
        f"{folder}: expected a data set of data_manifest.yaml, got {name!r}; say where its manifest is now by --dataset"
    )


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """A sentence for each thing that two records have otherwise: code, lock, inputs, versions, machine."""
    told = []
    for name, words in _COMPARED.items():
        was, is_now = before.get(name), now.get(name)
        if was == is_now:
            continue
        if name == "code_sha256":
            told.append(f"other {words}: commit {_short(before)}, now {_short(now)}")
        elif isinstance(was, Mapping) and isinstance(is_now, Mapping):
            changed = sorted(key for key in {*was, *is_now} if was.get(key) != is_now.get(key))
            shown = name != "inputs_sha256"
            pairs = [f"{key} {was.get(key, '-')}, now {is_now.get(key, '-')}" if shown else key for key in changed]
            told.append(f"other {words}: {'; '.join(pairs)}")
        else:
            told.append(f"other {words}")
    return told


def _short(record: Mapping[str, Any]) -> str:
    return str(record.get("commit") or "unknown")[:10] + (" with changes" if record.get("uncommitted_changes") else "")
