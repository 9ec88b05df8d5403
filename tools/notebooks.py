"""Run, renew and check the paired notebooks: ``run --out DIR``, ``write``, ``check``.

``run`` executes every notebook through papermill into a folder; ``write`` executes them in place, outputs kept;
``check`` fails when a pair differs in its code, has no outputs or has outgrown 1 MB. A notebook that fails is named
with its cell and error and kept as far as it came, by ``write`` as ``.failed.ipynb`` beside the one that stands; the
others go on, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jupytext
import nbformat
import papermill
from joblib import Parallel, delayed

from study.datasets import reported

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
MAX_BYTES = 1_000_000
KERNEL = "python3"


def sources() -> list[Path]:
    """The percent notebooks, in order."""
    found = sorted(NOTEBOOKS.glob("[0-9]*.py"))
    if not found:
        raise SystemExit(f"expected notebooks in {NOTEBOOKS}, got none")
    return found


def code(path: Path) -> list[str]:
    """Code cells without papermill's injected one."""
    cells = jupytext.read(path).cells
    injected = "injected-parameters"
    return [c.source.strip() for c in cells if c.cell_type == "code" and injected not in c.metadata.get("tags", [])]


def execute(source: Path, target: Path, parameters: dict[str, Any], failed: Path | None = None) -> None:
    """Execute one percent notebook with parameters; a failed cell raises with its traceback.

    What was executed is written in either case: to ``target``, or where a cell failed to ``failed`` (``target`` when
    None).
    """
    logging.getLogger("papermill").setLevel(logging.ERROR)  # Open3D's widgets warn that no page listens
    notebook = jupytext.read(source)
    notebook.metadata["kernelspec"] = {"name": KERNEL, "display_name": "Python 3", "language": "python"}
    notebook.metadata.pop("papermill", None)
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"{source.stem}-{number}"  # stable, so that a rerun changes only what it computed
    with tempfile.TemporaryDirectory() as scratch:
        plain = Path(scratch) / f"{source.stem}.ipynb"
        nbformat.write(notebook, plain)
        known = papermill.inspect_notebook(str(plain))
        unknown = sorted(set(parameters) - set(known))
        if unknown:
            raise SystemExit(f"{source.name}: expected parameters among {', '.join(known)}, got {', '.join(unknown)}")
        done = Path(scratch) / "done.ipynb"
        try:
            papermill.execute_notebook(
                str(plain), str(done), parameters, kernel_name=KERNEL, cwd=str(NOTEBOOKS), progress_bar=False
            )
        except Exception:
            if done.is_file():  # papermill writes after each cell
                keep(done, failed or target)
            raise
        keep(done, target)
        if failed is not None:
            failed.unlink(missing_ok=True)


def keep(done: Path, target: Path) -> None:
    """Put an executed notebook in its place, tidied."""
    target.parent.mkdir(parents=True, exist_ok=True)
    finished = nbformat.read(done, as_version=4)
    tidy(finished)
    temporary = target.with_name(f".{target.name}")
    nbformat.write(finished, temporary)
    temporary.replace(target)


def tidy(notebook: Any) -> None:
    """Drop what changes from run to run and says nothing: timings, paths, progress bars."""
    notebook.metadata.pop("papermill", None)
    notebook.metadata["jupytext"] = {"formats": "ipynb,py:percent"}
    for cell in notebook.cells:
        cell.metadata.pop("papermill", None)
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = [o for o in cell.outputs if o.get("name") != "stderr"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line asks; 1 when a notebook failed or a pair is at fault, 2 when the words are wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    run = verbs.add_parser("run", help="execute into a folder")
    run.add_argument("--out", type=Path, required=True)
    write = verbs.add_parser("write", help="execute in place")
    for verb in (run, write):
        verb.add_argument("names", nargs="*", help="only these, by stem or its number")
        verb.add_argument("--jobs", type=int, default=1, help="notebooks at a time")
        verb.add_argument("--profile", choices=("quick", "full"), default="full")
    verbs.add_parser("check", help="pairs agree, outputs are there, sizes are small")
    chosen = parser.parse_args(arguments)
    if chosen.verb == "check":
        return check()
    stems = [source.stem for source in sources()]
    for name in chosen.names:
        if not name or not any(stem.startswith(name) for stem in stems):
            parser.error(f"expected a notebook among {', '.join(stems)}, or the start of one, got {name!r}")
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")  # else its banner is the first output
    todo = [s for s in sources() if not chosen.names or any(s.stem.startswith(name) for name in chosen.names)]
    jobs = [(source, source.stem, {"profile": chosen.profile}) for source in todo]
    if chosen.verb == "run":  # the study of one dataset, for each of them
        jobs += [
            (source, f"{source.stem}-{dataset}", {"profile": chosen.profile, "dataset": dataset})
            for source in todo
            if source.stem.endswith("_study")
            for dataset in reported()[1:]  # the first is the notebook's own
        ]
    folder = chosen.out if chosen.verb == "run" else NOTEBOOKS
    suffix = ".ipynb" if chosen.verb == "run" else ".failed.ipynb"  # in place, a failure does not cost the good one
    calls = {
        stem: delayed(_one)(source, folder / f"{stem}.ipynb", parameters, folder / f"{stem}{suffix}")
        for source, stem, parameters in jobs
    }
    return execute_all(calls, chosen.jobs)


def execute_all(calls: Mapping[str, Any], n_jobs: int) -> int:
    """Make every call of `_one`, by stem; 1 if a notebook failed."""
    done, faults = 0, []
    for lowest, next_lowest in (("0", "5"), ("5", "6"), ("6", ":")):  # 50 may run the study that 60 reads
        group = [call for stem, call in calls.items() if lowest <= stem < next_lowest]
        for stem, seconds, fault in Parallel(n_jobs=n_jobs, return_as="generator_unordered")(group):
            done += 1
            faults += [f"{stem}: {fault}"] if fault else []
            print(f"notebook {done} of {len(calls)}: {stem}, {seconds:.0f} s{', failed' if fault else ''}", flush=True)
    for fault in faults:
        print(f"notebooks: {fault}", file=sys.stderr)
    return 1 if faults else 0


def _one(source: Path, target: Path, parameters: dict[str, Any], failed: Path) -> tuple[str, float, str]:
    """Execute one notebook: its stem, the seconds it took, and what failed, where; empty if nothing did."""
    start, fault = time.perf_counter(), ""
    try:
        execute(source, target, parameters, failed if failed != target else None)
    except papermill.PapermillExecutionError as error:
        line = next((line for line in error.source.splitlines() if line.strip()), "")
        told = " ".join(f"{error.ename}: {error.evalue}".split())
        fault = f"cell In [{error.exec_count}] ({line!r}): {told}; kept as far as it came: {failed}"
    except (Exception, SystemExit) as error:  # a kernel that died, a file that cannot be written
        fault = " ".join(f"{type(error).__name__}: {error}".split())
    return target.stem, time.perf_counter() - start, fault


def check() -> int:
    """Print what is wrong with the pairs; 1 if anything is."""
    faults = [
        f"{paired.name}: expected {paired.stem}.py beside it, got none; remove it"
        for paired in sorted(NOTEBOOKS.glob("[0-9]*.ipynb"))
        if not paired.with_suffix(".py").is_file()
    ]
    for source in sources():
        paired = source.with_suffix(".ipynb")
        if not paired.is_file():
            faults.append(f"{source.name}: expected {paired.name} beside it, got none; run 'make notebooks'")
            continue
        if code(source) != code(paired):
            faults.append(f"{paired.name}: its code is not that of {source.name}; run 'make notebooks'")
        cells = [c for c in nbformat.read(paired, as_version=4).cells if c.cell_type == "code"]
        if not any(c.outputs for c in cells):
            faults.append(f"{paired.name}: expected outputs, got none; run 'make notebooks'")
        if paired.stat().st_size >= MAX_BYTES:
            faults.append(f"{paired.name}: expected under {MAX_BYTES} bytes, got {paired.stat().st_size}")
    print("\n".join(faults) or f"{len(sources())} notebook pairs agree")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
