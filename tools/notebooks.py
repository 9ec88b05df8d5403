"""Keep the paired notebooks: ``write``, ``tidy``, ``check``.

``write`` executes them in place, outputs kept; a notebook that fails is named with its cell and error and kept as
``.failed.ipynb`` beside the one that stands, the others go on, and the exit code is 1. ``tidy`` drops what Jupyter or
papermill left in an ``.ipynb`` and the repository does not keep. ``check`` fails when a pair differs in its text, is
not tidy, has no outputs or has outgrown 1 MB. Pairing itself is jupytext's: ``jupytext --sync notebooks/*.py``.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

import nbformat

from study.batch.notebooks import QUIET
from study.batch.papermills import Notebook, execute, find_notebooks, tidied, write_notebook
from study.errors import StudyError

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
MAX_BYTES = 1_000_000


def pair_of(notebook: Notebook) -> Path:
    """The half of the pair that holds the outputs."""
    return notebook.source.with_suffix(".ipynb")


def text_of(notebook: Any) -> list[tuple[str, str]]:
    """Kind and text of every cell."""
    return [(cell.cell_type, cell.source.strip()) for cell in notebook.cells]


def write(notebook: Notebook, profile: str) -> str:
    """Execute a notebook in place; what failed, where; empty if nothing did."""
    parameters = {"profile": profile} if profile != "full" else {}
    failed = notebook.source.with_suffix(".failed.ipynb")
    try:
        with tempfile.TemporaryDirectory() as scratch:
            done, fault = execute(notebook, parameters, Path(scratch) / "done.ipynb")
    except StudyError as error:
        return str(error)
    write_notebook(tidied(done), failed if fault else pair_of(notebook))
    if fault:
        return f"{fault}; kept as far as it came: {failed}"
    failed.unlink(missing_ok=True)
    return ""


def write_all(notebooks: list[Notebook], profile: str, n_jobs: int) -> int:
    """Execute notebooks in place; 1 if one failed."""
    os.environ.update(QUIET)
    faults = []
    with ThreadPool(n_jobs) as pool:
        ended = pool.imap_unordered(lambda notebook: (notebook.stem, write(notebook, profile)), notebooks)
        for number, (stem, fault) in enumerate(ended, 1):
            faults += [f"{stem}: {fault}"] if fault else []
            print(f"notebook {number} of {len(notebooks)}: {stem}{', failed' if fault else ''}", flush=True)
    for fault in faults:
        print(f"notebooks: {fault}", file=sys.stderr)
    return 1 if faults else 0


def tidy(notebooks: list[Notebook]) -> int:
    """Tidy every pair's outputs."""
    for notebook in notebooks:
        write_notebook(tidied(nbformat.read(pair_of(notebook), as_version=4)), pair_of(notebook))
    return 0


def fault_of(notebook: Notebook) -> str | None:
    """What is wrong with a pair, and what to do about it."""
    path = pair_of(notebook)
    if not path.is_file():
        return f"{notebook.source.name}: expected {path.name} beside it, got none; run 'make notebooks'"
    kept = nbformat.read(path, as_version=4)
    if not any(cell.get("outputs") for cell in kept.cells):
        return f"{path.name}: expected outputs, got none; run 'make notebooks'"
    if path.stat().st_size >= MAX_BYTES:
        return f"{path.name}: expected under {MAX_BYTES} bytes, got {path.stat().st_size}"
    if tidied(nbformat.read(path, as_version=4)) != kept:
        return f"{path.name}: expected outputs and nothing else of a run; run 'python tools/notebooks.py tidy'"
    if text_of(notebook.blank()) != text_of(kept):
        return f"{path.name}: its text is not that of {notebook.source.name}; run 'make notebooks' or 'jupytext --sync'"
    return None


def check(notebooks: list[Notebook]) -> int:
    """Print what is wrong with the pairs; 1 if anything is."""
    faults = [
        f"{path.name}: expected {path.stem}.py beside it, got none; remove it"
        for path in sorted(NOTEBOOKS.glob("[0-9]*.ipynb"))
        if not path.with_suffix(".py").is_file()
    ]
    faults += [fault for notebook in notebooks if (fault := fault_of(notebook))]
    print("\n".join(faults) or f"{len(notebooks)} notebook pairs agree")
    return 1 if faults else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line asks; 1 when a notebook failed or a pair is at fault, 2 when the words are wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb, what in (("write", "execute in place"), ("tidy", "drop what the repository does not keep")):
        one = verbs.add_parser(verb, help=what)
        one.add_argument("names", nargs="*", help="only these, by stem or its number")
        if verb == "write":
            one.add_argument("--jobs", type=int, default=1, help="notebooks at a time")
            one.add_argument("--profile", choices=("quick", "full"), default="full")
    verbs.add_parser("check", help="pairs agree, outputs are there, sizes are small")
    chosen = parser.parse_args(arguments)
    try:
        notebooks = find_notebooks(NOTEBOOKS, getattr(chosen, "names", ()))
    except StudyError as error:
        parser.error(str(error))
    if chosen.verb == "write":
        return write_all(notebooks, chosen.profile, chosen.jobs)
    return tidy(notebooks) if chosen.verb == "tidy" else check(notebooks)


if __name__ == "__main__":
    sys.exit(main())
