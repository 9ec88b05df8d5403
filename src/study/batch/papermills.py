"""One notebook through papermill: what it takes, what it says while it runs, what is kept of it."""

from __future__ import annotations

import ast
import logging
import re
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jupytext
import nbformat
import papermill

from study.errors import StudyError
from study.files.atomic import replacing

KERNEL = "python3"
KERNELSPEC = {"name": KERNEL, "display_name": "Python 3 (ipykernel)", "language": "python"}  # as JupyterLab writes it
# What pyproject.toml says to jupytext, whose half in JupyterLab notes it in every notebook that it saves.
FILTERS = {"cell_metadata_filter": "tags,-all", "notebook_metadata_filter": "-all"}
INJECTED = "injected-parameters"  # papermill's tag of the cell that it adds


@dataclass(frozen=True)
class Notebook:
    """A notebook of the study, as text.

    Attributes:
        source: the percent script, the half of the pair that holds no outputs.
    """

    source: Path

    @property
    def stem(self) -> str:
        """Its name, with its number."""
        return self.source.stem

    @cached_property
    def text(self) -> str:
        """The script."""
        return self.source.read_text(encoding="utf-8")

    def blank(self) -> Any:
        """A notebook without outputs, whose cells have ids that stay from run to run."""
        notebook = jupytext.reads(self.text, fmt="py:percent")
        notebook.metadata = nbformat.from_dict({"kernelspec": KERNELSPEC})
        for number, cell in enumerate(notebook.cells):
            cell["id"] = f"{self.stem}-{number}"  # stable, so that a rerun changes only what it computed
        return notebook

    @cached_property
    def defaults(self) -> dict[str, Any]:
        """Its parameters and their values when none is given.

        Raises:
            StudyError: a parameter that is not a plain value.
        """
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "blank.ipynb"
            nbformat.write(self.blank(), path)
            found = papermill.inspect_notebook(str(path))
        try:
            return {name: ast.literal_eval(entry["default"]) for name, entry in found.items()}
        except (ValueError, SyntaxError) as error:
            raise StudyError(f"{self.source.name}: expected parameters that are plain values, got: {error}") from error

    @property
    def n_code_cells(self) -> int:
        """Cells that are executed, without papermill's own."""
        return sum(cell.cell_type == "code" for cell in self.blank().cells)


def find_notebooks(folder: Path, names: tuple[str, ...] | list[str] = ()) -> list[Notebook]:
    """The notebooks of a folder, in order.

    Args:
        folder: with percent scripts whose names start with a number.
        names: only these, each a stem or the start of one; all when empty.

    Raises:
        StudyError: no notebooks there, or a name that none has.
    """
    found = [Notebook(path) for path in sorted(folder.glob("[0-9]*.py"))]
    if not found:
        raise StudyError(f"{folder}: expected notebooks, got none; name the folder of a checkout that holds them")
    for name in names:
        if not name or not any(one.stem.startswith(name) for one in found):
            stems = ", ".join(one.stem for one in found)
            raise StudyError(f"expected a notebook among {stems}, or the start of one, got {name!r}")
    return [one for one in found if not names or any(one.stem.startswith(name) for name in names)]


@dataclass(frozen=True)
class Listener:
    """Who is told how far a notebook is.

    Attributes:
        cell: called with the number of a code cell, from 1, when it starts.
        line: called with the last line that the notebook wrote on standard error, such as a progress bar.
    """

    cell: Callable[[int], None] = lambda _: None
    line: Callable[[str], None] = lambda _: None

    def write(self, text: str) -> None:
        """Take what papermill hands on of a notebook's standard error."""
        lines = [line.strip() for line in re.split(r"[\r\n]", text) if line.strip()]
        if lines:
            self.line(lines[-1])

    def flush(self) -> None:
        """Do nothing: papermill asks for it."""


def execute(
    notebook: Notebook, parameters: Mapping[str, Any], scratch: Path, listener: Listener | None = None
) -> tuple[Any, str]:
    """Execute a notebook with parameters; a cell that fails ends it.

    Args:
        notebook: that is executed, in its own folder.
        parameters: by name.
        scratch: ``.ipynb`` that papermill writes after each cell.
        listener: told of each cell.

    Returns:
        the notebook as far as it came, with papermill's metadata, and what failed, where; empty if nothing did.

    Raises:
        StudyError: a parameter that it does not have.
    """
    unknown = sorted(set(parameters) - set(notebook.defaults))
    if unknown:
        known = ", ".join(notebook.defaults) or "none"
        raise StudyError(f"{notebook.source.name}: expected parameters among {known}, got {', '.join(unknown)}")
    logging.getLogger("papermill").setLevel(logging.ERROR)  # Open3D's widgets warn that no page listens
    listener = listener or Listener()
    started: list[Any] = []

    def start(cell: Any, cell_index: int) -> None:
        if cell.cell_type != "code":
            return
        started.append(cell)
        listener.cell(len(started))

    fault = ""
    scratch.parent.mkdir(parents=True, exist_ok=True)
    blank = scratch.with_suffix(".blank.ipynb")
    nbformat.write(notebook.blank(), blank)
    try:
        papermill.execute_notebook(
            _literal(blank),
            _literal(scratch),
            dict(parameters),
            kernel_name=KERNEL,
            progress_bar=False,
            stderr_file=listener,
            on_cell_start=start,
            resources={"metadata": {"path": str(notebook.source.parent)}},  # papermill's cwd= is the whole process's
        )
    except papermill.PapermillExecutionError as error:
        fault = _fault(started, f"{error.ename}: {error.evalue}")
    except Exception as error:  # a kernel that died, a file that cannot be written
        fault = _fault(started, f"{type(error).__name__}: {error}")
    return nbformat.read(scratch if scratch.is_file() else blank, as_version=4), fault


def _literal(path: Path) -> str:
    """A path that papermill, which fills parameters into paths, leaves as it is."""
    return str(path).replace("{", "{{").replace("}", "}}")


def _fault(started: list[Any], what: str) -> str:
    """A failure in one line: the cell, its first line of code, the error."""
    told = " ".join(re.sub(r"\x1b\[[0-9;]*m", "", what).split())
    if not started:
        return f"before its first cell: {told}"
    line = next((line for line in started[-1].source.splitlines() if line.strip()), "")
    return f"cell In [{len(started)}] ({line!r}): {told}"


def write_notebook(notebook: Any, path: Path) -> None:
    """Write a notebook, whole or not at all."""
    with replacing(path) as temporary:
        nbformat.write(notebook, temporary)


def without_stderr(notebook: Any) -> Any:
    """The notebook with neither progress bars nor whatever else went to standard error, changed in place."""
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    return notebook


def tidied(notebook: Any) -> Any:
    """The notebook as the repository keeps it, changed in place: what its script says, and outputs.

    Gone are papermill's cell and metadata, times, what went to standard error and whatever else differs from run to run
    and says nothing; cells count from 1 as without papermill's.
    """
    language = {"language_info": notebook.metadata.get("language_info", {"name": "python"})}
    notebook.metadata = nbformat.from_dict({"jupytext": FILTERS, "kernelspec": KERNELSPEC, **language})
    notebook.cells = [cell for cell in notebook.cells if INJECTED not in cell.metadata.get("tags", [])]
    without_stderr(notebook)
    n_executed = 0
    for cell in notebook.cells:
        kept = {name: cell.metadata[name] for name in ("tags", "lines_to_next_cell") if cell.metadata.get(name)}
        cell.metadata = nbformat.from_dict(kept)  # the second is jupytext's: how many empty lines the script has there
        if cell.cell_type == "code" and cell.execution_count is not None:
            n_executed += 1
            cell.execution_count = n_executed
            for output in cell.outputs:
                if "execution_count" in output:
                    output["execution_count"] = n_executed
    return notebook
