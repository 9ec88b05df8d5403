"""`study notebooks`: the grid, what is kept, what is left as it is, what a kill leaves."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import nbformat
import pytest

from study.batch import notebooks
from study.batch.notebooks import Task, plan, run_notebooks
from study.batch.papermills import FILTERS, KERNELSPEC, find_notebooks, tidied
from study.cli import main
from study.datasets import reported
from study.errors import StudyError
from study.files.places import CHECKOUT
from study.results.notebook_index import record_of

HELPER = Path(__file__).parents[1] / "short_notebooks.py"
SUM = '# %% [markdown]\n# # One and one?\n\n# %% tags=["parameters"]\nseed = 1\n\n# %%\nprint(seed + 1)\n'
FAILS = '# %% tags=["parameters"]\nprofile = "full"\n\n# %%\nprint(40)\n\n# %%\n\n1 / 0\n\n# %%\nprint(41)\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two notebooks, one of which fails."""
    (tmp_path / "00_sum.py").write_text(SUM, encoding="utf-8")
    (tmp_path / "10_fails.py").write_text(FAILS, encoding="utf-8")
    return tmp_path


def names(tasks: list[Task]) -> list[str]:
    return [task.name for task in tasks]


def printed(path: Path) -> list[str]:
    cells = nbformat.read(path, as_version=4).cells
    return [output.text for cell in cells for output in cell.get("outputs", []) if output.output_type == "stream"]


def test_a_notebook_gets_only_the_parameters_it_has_and_is_not_multiplied_by_others(folder: Path) -> None:
    tasks = plan(find_notebooks(folder), {"seed": [0, 1, 2], "profile": ["quick"]})
    assert names(tasks) == ["00_sum-seed0", "00_sum", "00_sum-seed2", "10_fails-quick"]
    assert [task.given for task in tasks] == [{"seed": 0}, {"seed": 1}, {"seed": 2}, {"profile": "quick"}]
    with pytest.raises(StudyError, match=r"--dataset: expected a notebook that takes it, got 00_sum, 10_fails"):
        plan(find_notebooks(folder), {"dataset": ["phantom"]})


def test_the_studys_own_grid_runs_every_reported_data_set_once() -> None:
    tasks = plan(find_notebooks(CHECKOUT / "notebooks"), {})
    made = [task for task in tasks if task.makes_a_run]
    assert [task.given["dataset"] for task in made] == reported()
    assert names(made) == ["50_study", *(f"50_study-{name}" for name in reported()[1:])]
    assert len(tasks) == len(find_notebooks(CHECKOUT / "notebooks")) + len(reported()) - 1
    assert all(not task.given for task in tasks if not task.makes_a_run)


def test_every_axis_multiplies_the_notebook_of_the_runs() -> None:
    axes: dict[str, list[Any]] = {"dataset": ["open", "phantom"], "seed": [0, 3], "methods": ["icp,cpd", ""]}
    tasks = plan(find_notebooks(CHECKOUT / "notebooks", ["50"]), axes)
    assert len(set(names(tasks))) == 8
    assert "50_study-open-seed3-icp+cpd" in names(tasks)
    assert "50_study" in names(tasks)
    every = ",".join(["icp", "cpd", "coarse"] * 30)
    assert len(plan(find_notebooks(CHECKOUT / "notebooks", ["50"]), {"methods": [every]})[0].name) < 60


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["61"], "expected a notebook among 00_data, "),
        (["50", "--dataset", "phantm"], "phantm"),
        (["50", "--methods", "icp,cdp"], "got 'cdp'"),
        (["50", "--profile", "fast"], "got 'fast'"),
        (["50", "--seed", "0,-1"], "--seed: expected whole numbers from 0 as in 0,1,2, got '0,-1'"),
        (["30", "--methods", "icp"], "--methods: expected a notebook that takes it, got 30_skeleton_graph"),
    ],
)
def test_a_name_that_nothing_has_is_refused_before_anything_runs(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(notebooks, "execute", None)
    assert main(["notebooks", *words, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_data_that_cannot_be_had_are_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STUDY_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setattr(notebooks, "execute", None)
    assert main(["notebooks", "00", "--dataset", "ribseg", "--out", str(tmp_path / "out")]) == 2
    assert "ribseg" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_failed_is_named_and_kept_and_what_is_finished_is_left_alone(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = folder / "out"
    monkeypatch.setattr(notebooks, "_tables", lambda _: "tables")
    tasks = plan(find_notebooks(folder), {"seed": [2]})
    done, failed = run_notebooks(tasks, out, n_jobs=2, show_progress=True)
    assert not done.fault
    assert failed.fault == "cell In [3] ('1 / 0'): ZeroDivisionError: division by zero"
    assert (printed(done.path), printed(failed.path)) == (["3\n"], ["40\n"])
    told = capsys.readouterr().err
    assert "notebook 2 of 2" in told
    assert "10_fails, " in told
    kept = nbformat.read(done.path, as_version=4).metadata
    assert kept["study"]["parameters"] == {"seed": 2}
    assert kept["papermill"]["parameters"] == {"seed": 2}
    assert kept["study"]["seconds"] == kept["papermill"]["duration"] > 0
    assert str(folder) not in json.dumps(kept)
    page = (out / "index.html").read_text(encoding="utf-8")
    assert 'href="00_sum-seed2.ipynb"' in page
    assert "seed 2" in page
    assert "failed</span>: cell In [3] (&#39;1 / 0&#39;): ZeroDivisionError" in page
    assert sorted(path.name for path in out.iterdir()) == [
        ".lock",
        "00_sum-seed2.ipynb",
        "10_fails.ipynb",
        "index.html",
    ]

    (folder / "10_fails.py").write_text(FAILS.replace("1 / 0", "1 / 1"), encoding="utf-8")
    tasks = plan(find_notebooks(folder), {"seed": [2]})
    before = done.path.read_bytes()
    again = run_notebooks(tasks, out)
    assert [(one.kept, one.fault) for one in again] == [(True, ""), (False, "")]
    assert done.path.read_bytes() == before
    assert again[0].seconds == done.seconds
    assert printed(failed.path) == ["40\n", "41\n"]
    assert run_notebooks(tasks[:1], out, fresh=True)[0].kept is False


def test_source_parameters_code_and_tables_decide_what_is_finished(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def execute(notebook: Any, given: Any, *_: Any) -> tuple[Any, str]:
        seen.append(given)
        return notebook.blank(), ""

    monkeypatch.setattr(notebooks, "execute", execute)
    monkeypatch.setattr(notebooks, "_tables", lambda _: "tables")

    def executes(seed: int = 2) -> bool:
        seen.clear()
        run_notebooks(plan(find_notebooks(folder, ["00"]), {"seed": [seed]}), folder / "out")
        return bool(seen)

    assert executes()
    assert not executes()
    assert executes(seed=3)
    monkeypatch.setattr(notebooks, "_tables", lambda _: "other tables")
    assert executes()
    monkeypatch.setattr(notebooks, "arithmetic", lambda: {"code_sha256": "other code"})
    assert executes()
    (folder / "00_sum.py").write_text(SUM.replace("seed + 1", "seed + 2"), encoding="utf-8")
    assert executes()
    (folder / "out" / "00_sum-seed2.ipynb").write_text("{", encoding="utf-8")
    assert executes()
    assert not executes()


def test_a_notebook_whose_run_is_gone_is_not_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = plan(find_notebooks(CHECKOUT / "notebooks", ["50"]), {"dataset": ["phantom"], "profile": ["quick"]})[0]
    monkeypatch.setattr(notebooks, "run_folder", lambda *_: tmp_path / "none")
    monkeypatch.setattr(notebooks, "execute", lambda notebook, *_: (notebook.blank(), ""))
    run_notebooks([task], tmp_path / "out")
    assert not run_notebooks([task], tmp_path / "out")[0].kept
    monkeypatch.setattr(notebooks, "why_stale", lambda *_: None)
    assert run_notebooks([task], tmp_path / "out")[0].kept


def test_a_folder_has_one_writer(folder: Path) -> None:
    with notebooks._alone(folder / "out"), pytest.raises(StudyError, match="expected to be its only writer"):
        run_notebooks(plan(find_notebooks(folder, ["00"]), {}), folder / "out")


def test_a_batch_killed_three_times_finishes_and_executes_nothing_twice(tmp_path: Path) -> None:
    for number in range(4):
        source = (
            f"# %%\nimport time\nfrom pathlib import Path\nwith open('log', 'a') as log:\n    log.write('{number}')\n"
        )
        wait = f"\n# %%\ntime.sleep({0.0 if number == 3 else 0.2})\n"
        (tmp_path / f"0{number}_waits.py").write_text(source + wait, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(HELPER), str(tmp_path), "3"],
        capture_output=True,
        encoding="utf-8",
        timeout=300,
        check=True,
    )
    assert done.stdout.split() == ["killed", "killed", "killed", "done"]
    log = (tmp_path / "log").read_text(encoding="utf-8")
    assert set(log) == set("0123")
    ended = {path.stem: record_of(path) for path in (tmp_path / "out").glob("*.ipynb")}
    assert len(ended) == 4
    assert all(record is not None and record["state"] == "done" for record in ended.values())
    # A kill costs what was running, one notebook at a time: nothing that had ended before it began again.
    assert len(log) <= 4 + 3
    assert "".join(sorted(log)) == log


def test_what_the_repository_keeps_is_text_and_outputs(folder: Path) -> None:
    notebook = find_notebooks(folder, ["00"])[0].blank()
    injected = nbformat.v4.new_code_cell("seed = 7", metadata={"tags": ["injected-parameters"]}, execution_count=2)
    notebook.cells.insert(2, injected)
    last = notebook.cells[-1]
    last.execution_count, last.metadata["papermill"] = 3, {"duration": 1.0}
    last.outputs = [
        nbformat.v4.new_output("stream", name="stderr", text="|###  |"),
        nbformat.v4.new_output("execute_result", data={"text/plain": "8"}, execution_count=3),
    ]
    notebook.cells[1].execution_count = 1
    notebook.metadata["papermill"] = {"duration": 1.0}
    kept = tidied(notebook)
    assert [cell.source for cell in kept.cells] == ["# One and one?", "seed = 1", "print(seed + 1)"]
    assert kept.metadata == {"jupytext": FILTERS, "kernelspec": KERNELSPEC, "language_info": {"name": "python"}}
    told = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["jupytext"]
    assert {name: told[name] for name in FILTERS} == FILTERS
    assert [cell.metadata for cell in kept.cells] == [{}, {"tags": ["parameters"]}, {}]
    assert [output.output_type for output in last.outputs] == ["execute_result"]
    assert (last.execution_count, last.outputs[0].execution_count) == (2, 2)
