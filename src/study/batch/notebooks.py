"""`study notebooks`: the notebooks over a grid of parameters; what is finished and of now is not executed again."""

from __future__ import annotations

import fcntl
import hashlib
import itertools
import os
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

from study.batch.papermills import Listener, Notebook, execute, without_stderr, write_notebook
from study.batch.runs import JOBS, chosen_methods, split_methods, why_stale
from study.batch.told import Told
from study.data.fetch import fetch_all
from study.datasets import Dataset, find_dataset, reported
from study.errors import StudyError
from study.files.atomic import json_text, sha256_of
from study.files.places import CHECKOUT
from study.params import find_profile
from study.results.notebook_index import RECORD, record_of, write_index
from study.results.provenance import arithmetic
from study.results.run import Run, run_folder

AXES = ("dataset", "profile", "seed", "methods")  # of the grid, in the order of a name's parts
LONGEST = 80  # characters of a list of methods in a file's name
# Open3D's banner would be the first output, and the debugger warns of frozen modules.
QUIET = {"OPEN3D_DISABLE_WEB_VISUALIZER": "true", "PYDEVD_DISABLE_FILE_VALIDATION": "1"}


@dataclass(frozen=True)
class Task:
    """A notebook and the parameters it is executed with.

    Attributes:
        notebook: that is executed.
        given: parameters by name; the others are the notebook's own.
    """

    notebook: Notebook
    given: Mapping[str, Any]

    @property
    def parameters(self) -> dict[str, Any]:
        """Every parameter, given or the notebook's own."""
        return {**self.notebook.defaults, **self.given}

    @property
    def name(self) -> str:
        """Of its file: the notebook's, then each parameter that is not the notebook's own."""
        other = {name: value for name, value in self.given.items() if value != self.notebook.defaults[name]}
        return "-".join([self.notebook.stem, *(_word(name, other[name]) for name in AXES if name in other)])

    @property
    def makes_a_run(self) -> bool:
        """Whether it runs a data set, with as many processes as there may be, for others to read."""
        return set(AXES) <= set(self.notebook.defaults)

    def dataset(self) -> Dataset | None:
        """The data set that it is about.

        Raises:
            StudyError: no such data set, profile or method.
        """
        chosen = self.parameters
        if "methods" in chosen:
            chosen_methods(split_methods(chosen["methods"]))
        profile = find_profile(chosen.get("profile", "full"))
        return find_dataset(chosen["dataset"], profile, chosen.get("seed", 0)) if "dataset" in chosen else None


@dataclass(frozen=True)
class Executed:
    """What became of a task.

    Attributes:
        name: of the task.
        path: of the executed notebook.
        seconds: it took.
        fault: cell and error where it failed, empty where not.
        kept: whether it had been finished before and was left as it was.
    """

    name: str
    path: Path
    seconds: float
    fault: str = ""
    kept: bool = False


def plan(notebooks: Sequence[Notebook], axes: Mapping[str, Sequence[Any]]) -> list[Task]:
    """Every notebook with every combination of values of those axes that it has.

    Args:
        notebooks: to execute.
        axes: values by parameter, of `AXES`. Without ``dataset`` a notebook keeps its own, and one that makes a run
            makes those of all reported data sets.

    Raises:
        StudyError: an axis that none of the notebooks has, or a value that is no data set, profile or method.
    """
    for name in axes:
        if not any(name in notebook.defaults for notebook in notebooks):
            stems = ", ".join(notebook.stem for notebook in notebooks)
            raise StudyError(f"--{name}: expected a notebook that takes it, got {stems}; leave it out")
    tasks = []
    for notebook in notebooks:
        own = {name: list(axes[name]) for name in AXES if name in axes and name in notebook.defaults}
        if "dataset" not in axes and Task(notebook, {}).makes_a_run:
            own["dataset"] = reported()
        tasks += [Task(notebook, dict(zip(own, values, strict=True))) for values in itertools.product(*own.values())]
    for task in tasks:
        task.dataset()
    return list({task.name: task for task in tasks}.values())


def run_notebooks(
    tasks: Sequence[Task], out: Path, *, n_jobs: int = 1, fresh: bool = False, show_progress: bool = False
) -> list[Executed]:
    """Execute tasks through papermill, each into ``out/<name>.ipynb`` with its parameters and times.

    A notebook that fails is kept as far as it came, and the others go on. One that was finished with the same source,
    parameters and code, and after which no table that it may read has changed, is left as it is. Notebooks that make
    a run come first, one at a time with ``n_jobs`` processes each; then the others, ``n_jobs`` at a time.

    Args:
        tasks: see `plan`.
        out: folder of executed notebooks.
        n_jobs: processes.
        fresh: execute finished ones, too.
        show_progress: a bar and a line for each notebook on standard error.

    Raises:
        StudyError: files of a data set that cannot be fetched, or another process that is writing ``out``.
    """
    about = [dataset for task in tasks if (dataset := task.dataset()) is not None]
    for dataset in {dataset.name: dataset for dataset in about}.values():
        fetch_all(dataset.manifest, dataset.file_cohort, progress=show_progress)
    out = out.resolve()
    with _alone(out), _environment({JOBS: str(n_jobs), **QUIET}):
        told = Told({task.name: task.notebook.n_code_cells + bool(task.given) for task in tasks}, show_progress)
        done: list[Executed] = []
        with told:
            for first in (True, False):
                group = [task for task in tasks if task.makes_a_run is first]
                with ThreadPool(1 if first else n_jobs) as pool:  # kernels are processes of their own
                    for executed in pool.imap_unordered(lambda task: _one(task, out, fresh, told), group):
                        done.append(executed)
                        told.end(executed.name, executed.seconds, executed.fault, executed.kept)
                        write_index(out)
    order = [task.name for task in tasks]
    return sorted(done, key=lambda executed: order.index(executed.name))


def _word(name: str, value: Any) -> str:
    """A parameter's part of a file's name."""
    if name == "dataset":
        return Path(value).stem
    if name == "methods":
        text = "+".join(split_methods(value) or ["all"])
        return text if len(text) <= LONGEST else f"{text.count('+') + 1}methods{zlib.crc32(text.encode()):08x}"
    return f"seed{value}" if name == "seed" else str(value)


def _one(task: Task, out: Path, fresh: bool, told: Told) -> Executed:
    """Execute a task, unless what is there will do."""
    target = out / f"{task.name}.ipynb"
    before = record_of(target)
    if not fresh and before is not None and _is_of_now(task, before):
        return Executed(task.name, target, before["seconds"], kept=True)
    listener = Listener(lambda n: told.cell(task.name, n), lambda text: told.line(task.name, text))
    facts = _facts(task)  # of the code that runs, whatever is edited meanwhile
    notebook, fault = execute(task.notebook, task.given, out / ".unfinished" / f"{task.name}.ipynb", listener)
    about = notebook.metadata.pop("papermill", {})
    seconds = about.get("duration") or 0.0
    notebook.metadata["papermill"] = {  # no paths of this machine
        name: value for name, value in about.items() if name not in ("input_path", "output_path")
    }
    notebook.metadata[RECORD] = {
        "notebook": task.notebook.stem,
        "parameters": task.parameters,
        "state": "failed" if fault else "done",
        "fault": fault,
        "started": about.get("start_time"),
        "seconds": seconds,
        "made_from": facts,
        "read": _tables(task),  # after the last cell: a run that the notebook made itself is no news to it
    }
    write_notebook(without_stderr(notebook), target)
    return Executed(task.name, target, seconds, fault)


def _facts(task: Task) -> str:
    """One hash of what decides a notebook's outputs, but for the tables that it reads."""
    decides = {"source": task.notebook.text, "parameters": task.parameters, **arithmetic()}
    return hashlib.sha256(json_text(decides).encode()).hexdigest()


def _is_of_now(task: Task, before: Mapping[str, Any]) -> bool:
    """Whether a task was finished, and all that decided its outputs is as it was."""
    ended = (before["state"], before["made_from"], before["read"])
    return ended == ("done", _facts(task), _tables(task)) and _has_its_run(task)


def _tables(task: Task) -> str:
    """One hash of the tables in the repository that a notebook may read; of one that makes a run, of none."""
    root = CHECKOUT / "results"
    if task.makes_a_run:
        return ""
    found = [path.relative_to(root) for path in root.rglob("*.csv") if path.name != "timings.csv"]
    shown = sorted(path for path in found if path.parts[0] != "trials" and not any(p[0] == "." for p in path.parts))
    lines = [f"{sha256_of(root / path)}  {path.as_posix()}\n" for path in shown]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _has_its_run(task: Task) -> bool:
    """Whether the run that a notebook made is still there, and of now."""
    dataset = task.dataset()
    if not task.makes_a_run or dataset is None:
        return True
    methods = split_methods(task.parameters["methods"])
    folder = run_folder(dataset.name, task.parameters["profile"], task.parameters["seed"], methods)
    return why_stale(Run(folder), dataset, methods) is None


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Hold the right to write a folder; what a killed process left unfinished in it is removed."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StudyError(
                f"{out}: expected to be its only writer, got another process; wait for it to end or name another folder"
            ) from error
        shutil.rmtree(out / ".unfinished", ignore_errors=True)
        yield
        shutil.rmtree(out / ".unfinished", ignore_errors=True)


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Variables that kernels inherit."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
