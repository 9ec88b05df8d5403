"""Every notebook runs on the quick profile, refuses what it does not know, and agrees with its pair."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from study.errors import StudyError

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "notebooks").glob("[0-9]*.py"))
PARAMETERS = {"dataset": "phantom", "profile": "quick", "seed": 0}
EXPECTED = ("00", "10", "15", "20", "30", "40", "45", "50", "60", "65", "66", "70")

spec = importlib.util.spec_from_file_location("notebook_tool", ROOT / "tools" / "notebooks.py")
tool = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tool)


def head(source):
    """The parameters cell and the code up to the check that follows it."""
    first, second = tool.code(source)[:2]
    check = "check_parameters(globals(), dataset=str, profile=str, seed=int)"
    assert check in second, f"{source.name}: expected the cell after the parameters to call {check}"
    return first, second[: second.index(check) + len(check)]


def start(source, **injected):
    """Run a notebook's head in this process with parameters injected as papermill does: in a cell between."""
    first, check = head(source)
    namespace = {}
    exec(first, namespace)
    namespace |= injected
    exec(check, namespace)
    return namespace


def test_the_notebooks_are_all_there():
    assert tuple(source.name[:2] for source in SOURCES) == EXPECTED


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_every_notebook_has_the_same_parameters_and_refuses_others_by_name(source):
    namespace = start(source)
    assert namespace["dataset"] in ("phantom", "open", "population")
    assert (namespace["profile"], namespace["seed"]) == ("full", 0)
    with pytest.raises(StudyError, match="unknown datset"):
        start(source, datset="open")
    with pytest.raises(StudyError, match=r"parameter seed: expected int, got '1' \(str\)"):
        start(source, seed="1")
    with pytest.raises(StudyError, match=r"parameter profile: expected str, got 3 \(int\)"):
        start(source, profile=3)


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_every_notebook_opens_with_its_question_and_says_what_is_simulated(source):
    opening = nbformat.read(source.with_suffix(".ipynb"), as_version=4).cells[0]
    assert opening.cell_type == "markdown"
    title, _, rest = opening.source.partition("\n")
    assert title.startswith("# ")
    assert title.endswith("?")
    assert any(word in rest for word in ("simulated", "synthetic", "generated"))


@pytest.mark.notebooks
@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_every_notebook_runs_on_the_quick_profile(source, tmp_path):
    done = tmp_path / f"{source.stem}.ipynb"
    parameters = {**PARAMETERS, **({"dataset": "population"} if source.stem.startswith("66") else {})}
    tool.execute(source, done, parameters)  # its own last cell asserts its claim
    cells = [cell for cell in nbformat.read(done, as_version=4).cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in cells)
    pictures = [output for cell in cells for output in cell.outputs if "image/png" in output.get("data", {})]
    assert pictures, f"{source.name}: expected at least one picture"


@pytest.mark.notebooks
def test_papermill_itself_fails_on_an_unknown_parameter_from_any_directory(tmp_path):
    notebook = ROOT / "notebooks" / "50_study.ipynb"
    command = [sys.executable, "-m", "papermill", str(notebook), "out.ipynb", "-p", "sed", "1", "-k", tool.KERNEL]
    done = subprocess.run(
        command, cwd=tmp_path, env=dict(os.environ), capture_output=True, encoding="utf-8", timeout=120
    )
    assert done.returncode != 0
    assert "got unknown sed" in done.stderr


def test_every_pair_agrees(capsys):
    assert tool.check() == 0, capsys.readouterr().out
    assert f"{len(SOURCES)} notebook pairs agree" in capsys.readouterr().out
