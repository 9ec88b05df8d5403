"""Every notebook runs on the quick profile, refuses what it does not know, and agrees with its pair."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from jupytext.cli import jupytext

from study.batch import run_study
from study.batch.papermills import INJECTED, KERNEL, Notebook, execute
from study.datasets import find_dataset
from study.errors import StudyError
from study.params import find_profile
from study.results.run import run_folder

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "notebooks").glob("[0-9]*.py"))
PARAMETERS = {"dataset": "phantom", "profile": "quick", "seed": 0}
EXPECTED = ("00", "10", "15", "20", "30", "40", "45", "50", "60", "65", "66", "70")


def code(source):
    return [cell.source for cell in Notebook(source).blank().cells if cell.cell_type == "code"]


def head(source):
    """The parameters cell and the code up to the check that follows it."""
    first, second = code(source)[:2]
    methods = ", methods=str" if source.stem == "50_study" else ""  # the one that runs a data set
    check = f"check_parameters(globals(), dataset=str, profile=str, seed=int{methods})"
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
    parameters = {**PARAMETERS, **({"dataset": "population"} if source.stem.startswith("66") else {})}
    done, fault = execute(Notebook(source), parameters, tmp_path / "done.ipynb")  # its last cell asserts its claim
    assert not fault
    cells = [cell for cell in done.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in cells)
    pictures = [output for cell in cells for output in cell.outputs if "image/png" in output.get("data", {})]
    assert pictures, f"{source.name}: expected at least one picture"


def papermill(notebook, done, *parameters, cwd):
    """What plain papermill says of a committed notebook."""
    command = [sys.executable, "-m", "papermill", str(notebook), str(done), "-k", KERNEL]
    for name, value in parameters:
        command += ["-p", name, str(value)]
    return subprocess.run(
        command, cwd=cwd, env=dict(os.environ), capture_output=True, encoding="utf-8", timeout=600, check=False
    )


@pytest.mark.notebooks
def test_papermill_itself_fails_on_an_unknown_parameter_from_any_directory(tmp_path):
    done = papermill(ROOT / "notebooks" / "50_study.ipynb", "out.ipynb", ("sed", 1), cwd=tmp_path)
    assert done.returncode != 0
    assert "got unknown sed" in done.stderr


@pytest.mark.notebooks
def test_plain_papermill_gives_the_numbers_of_a_run_of_the_same_data_set_seed_and_methods(tmp_path):
    given = {"dataset": "phantom", "profile": "quick", "seed": 3, "methods": "icp,cpd"}
    folder = run_folder("phantom", "quick", 3, ["icp", "cpd"])
    shutil.rmtree(folder, ignore_errors=True)
    done = papermill("notebooks/50_study.ipynb", tmp_path / "out.ipynb", *given.items(), cwd=ROOT)
    assert done.returncode == 0, done.stderr
    people = find_dataset("phantom", find_profile("quick"), 3)
    run = run_study(people, tmp_path / "run", methods=["icp", "cpd"])
    assert (folder / "metrics.csv").read_bytes() == (tmp_path / "run" / "metrics.csv").read_bytes()
    assert run.methods == ["icp", "cpd", "truth"]


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_jupytext_leaves_a_clean_pair_clean_from_either_side(source, tmp_path):
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "notebooks").mkdir()
    script, pair = (Path(shutil.copy(path, tmp_path / "notebooks")) for path in (source, source.with_suffix(".ipynb")))
    before = (script.read_bytes(), pair.read_bytes())
    for newer, side in ((script, script), (pair, script), (script, pair), (pair, pair)):
        for path in (script, pair):  # jupytext takes the text of the newer one
            os.utime(path, (1e9 + (path == newer), 1e9 + (path == newer)))
        assert jupytext(["--quiet", "--sync", str(side)]) == 0
        assert (script.read_bytes(), pair.read_bytes()) == before
    assert jupytext(["--quiet", "--test", str(pair), "--to", "py:percent"]) == 0
    assert jupytext(["--quiet", "--test", str(script), "--to", "ipynb"]) == 0
    assert INJECTED.encode() not in b"".join(before)


def test_the_cell_that_papermill_adds_does_not_get_into_the_script(tmp_path):
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    source = ROOT / "notebooks" / "45_best_method.py"
    for folder in ("notebooks", "executed"):
        (tmp_path / folder).mkdir()
    script = Path(shutil.copy(source, tmp_path / "notebooks"))
    notebook = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
    notebook.cells.insert(2, nbformat.v4.new_code_cell("seed = 3", metadata={"tags": [INJECTED]}))
    nbformat.write(notebook, tmp_path / "executed" / "45_best_method.ipynb")
    os.utime(script, (1e9, 1e9))
    jupytext(["--quiet", "--sync", str(tmp_path / "executed" / "45_best_method.ipynb")])  # of no pair
    assert script.read_bytes() == source.read_bytes()
    assert [path.name for path in (tmp_path / "executed").iterdir()] == ["45_best_method.ipynb"]
