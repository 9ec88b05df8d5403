"""Run, renew and check the paired notebooks: ``run --out DIR``, ``write``, ``check``.

``run`` executes every notebook through papermill into a folder; ``write`` executes them in place, outputs kept;
``check`` fails when a pair differs in its code, has no outputs or has outgrown 1 MB.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import tempfile
import time
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


def execute(source: Path, target: Path, parameters: dict[str, Any]) -> None:
    """Execute one percent notebook with parameters; a failed cell raises with its traceback."""
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
        papermill.execute_notebook(
            str(plain), str(done), parameters, kernel_name=KERNEL, cwd=str(NOTEBOOKS), progress_bar=False
        )
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


def main() -> int:
    """Do what the command line asks."""
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
    chosen = parser.parse_args()
    if chosen.verb == "check":
        return check()
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
    done = 0
    for lowest, next_lowest in (("0", "5"), ("5", "6"), ("6", ":")):  # 50 may run the study that 60 reads
        group = [job for job in jobs if lowest <= job[1] < next_lowest]
        calls = [delayed(_one)(source, folder / f"{stem}.ipynb", parameters) for source, stem, parameters in group]
        for stem, seconds in Parallel(n_jobs=chosen.jobs, return_as="generator_unordered")(calls):
            done += 1
            print(f"notebook {done} of {len(jobs)}: {stem}, {seconds:.0f} s", flush=True)
    return 0


def _one(source: Path, target: Path, parameters: dict[str, Any]) -> tuple[str, float]:
    start = time.perf_counter()
    execute(source, target, parameters)
    return target.stem, time.perf_counter() - start


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
