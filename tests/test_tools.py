from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import nbformat
import pandas as pd
import pytest

ROOT = Path(__file__).parents[1]


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"tools_{name}", ROOT / "tools" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# --- check_system.py -------------------------------------------------------------------------------------------------


@pytest.fixture
def system(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = load("check_system")
    monkeypatch.setattr(module.sys, "platform", "linux")
    return module


def without(module: ModuleType, monkeypatch: pytest.MonkeyPatch, absent: set[str], tool: str | None) -> None:
    def cdll(name: str) -> None:
        if name in absent:
            raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(module.ctypes, "CDLL", cdll)
    monkeypatch.setattr(module.shutil, "which", lambda name: f"/usr/bin/{name}" if name == tool else None)


@pytest.mark.parametrize(
    ("tool", "command"),
    [("apt-get", "sudo apt-get install -y libgl1 libgomp1"), ("dnf", "sudo dnf install -y mesa-libGL libgomp"),
     ("pacman", "sudo pacman -S libglvnd gcc-libs"), (None, "sudo apt-get install -y libgl1 libgomp1")],
)  # fmt: skip
def test_missing_libraries_are_one_line_with_the_command(
    system: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tool: str, command: str
) -> None:
    without(system, monkeypatch, {"libGL.so.1", "libgomp.so.1"}, tool)
    assert system.main() == 2
    out, err = capsys.readouterr()
    assert err == f"setup: missing system libraries libGL.so.1, libgomp.so.1; run: {command}\n"
    assert out == ""


def test_a_complete_machine_and_other_systems_pass_in_silence(
    system: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    without(system, monkeypatch, set(), "apt-get")
    assert system.main() == 0
    without(system, monkeypatch, set(system.NEEDED), "apt-get")
    monkeypatch.setattr(system.sys, "platform", "darwin")
    assert system.main() == 0
    assert capsys.readouterr() == ("", "")


def test_the_check_runs_on_a_bare_python() -> None:
    done = subprocess.run(
        [sys.executable, "-S", "-I", str(ROOT / "tools" / "check_system.py")],
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode in (0, 2)
    assert "Traceback" not in done.stderr


# --- notebooks.py ----------------------------------------------------------------------------------------------------

SOURCE = '# %% [markdown]\n# # What is one and one?\n\n# %% tags=["parameters"]\na = 1\n\n# %%\nprint(a + 1)\n'


@pytest.fixture
def notebooks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The tool, looking at one source and its executed pair."""
    module = load("notebooks")
    monkeypatch.setattr(module, "NOTEBOOKS", tmp_path)
    (tmp_path / "00_sum.py").write_text(SOURCE)
    notebook = module.tidied(module.Notebook(tmp_path / "00_sum.py").blank())
    notebook.cells[-1].outputs = [nbformat.v4.new_output("stream", name="stdout", text="2\n")]
    nbformat.write(notebook, tmp_path / "00_sum.ipynb")
    return module


def test_a_pair_that_agrees_passes(notebooks: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert notebooks.main(["check"]) == 0
    assert capsys.readouterr().out == "1 notebook pairs agree\n"


@pytest.mark.parametrize("fault", ["code", "words", "outputs", "size", "injected", "stderr", "absent", "orphan"])
def test_each_fault_fails_and_names_its_notebook(
    notebooks: ModuleType, capsys: pytest.CaptureFixture[str], fault: str
) -> None:
    folder = notebooks.NOTEBOOKS
    path = folder / "00_sum.ipynb"
    notebook = nbformat.read(path, as_version=4)
    if fault == "code":
        (folder / "00_sum.py").write_text(SOURCE.replace("a + 1", "a + 2"))
    elif fault == "words":
        (folder / "00_sum.py").write_text(SOURCE.replace("one and one", "one and two"))
    elif fault == "absent":
        path.unlink()
    elif fault == "orphan":
        nbformat.write(notebook, folder / "01_left_over.ipynb")
    else:
        if fault == "outputs":
            notebook.cells[-1].outputs = []
        elif fault == "size":
            notebook.cells[-1].outputs[0].text = "2" * notebooks.MAX_BYTES
        elif fault == "stderr":
            notebook.cells[-1].outputs.append(nbformat.v4.new_output("stream", name="stderr", text="|###  |"))
        else:
            cell = nbformat.v4.new_code_cell("a = 3", metadata={"tags": ["injected-parameters"]})
            notebook.cells.insert(2, cell)
        nbformat.write(notebook, path)
    assert notebooks.main(["check"]) == 1
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 1
    named = {"absent": "00_sum.py", "orphan": "01_left_over.ipynb"}.get(fault, "00_sum.ipynb")
    assert said[0].startswith(f"{named}: ")
    if fault in ("injected", "stderr"):
        assert notebooks.main(["tidy"]) == notebooks.main(["check"]) == 0


def test_no_notebooks_at_all_is_a_failure_not_a_pass(notebooks: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    (notebooks.NOTEBOOKS / "00_sum.py").unlink()
    with pytest.raises(SystemExit, match="2"):
        notebooks.main(["check"])
    assert "expected notebooks, got none" in capsys.readouterr().err


def test_a_failure_in_place_does_not_cost_the_notebook_that_stands(
    notebooks: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = tmp_path / "00_sum.ipynb"
    before = pair.read_bytes()
    (tmp_path / "00_sum.py").write_text(SOURCE.replace("a + 1", "1 / 0"))
    assert notebooks.main(["write"]) == 1
    assert pair.read_bytes() == before
    failed = tmp_path / "00_sum.failed.ipynb"
    assert "ZeroDivisionError" in failed.read_text(encoding="utf-8")
    assert "00_sum: cell In [2] ('print(1 / 0)'): ZeroDivisionError" in capsys.readouterr().err
    (tmp_path / "00_sum.py").write_text(SOURCE.replace("a + 1", "a + 2"))
    assert notebooks.main(["write"]) == notebooks.main(["check"]) == 0
    assert not failed.exists()


def test_unknown_parameters_are_refused_before_anything_runs(
    notebooks: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert notebooks.main(["write", "--profile", "quick"]) == 1
    assert "00_sum: 00_sum.py: expected parameters among a, got profile" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["61", "sum", ""])
def test_a_selection_that_matches_no_notebook_is_an_error(
    notebooks: ModuleType, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    with pytest.raises(SystemExit, match="2"):
        notebooks.main(["write", "00", name])
    assert f"expected a notebook among 00_sum, or the start of one, got {name!r}" in capsys.readouterr().err


# --- tune.py ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tune() -> ModuleType:
    return load("tune")


@pytest.mark.parametrize("name", ["icp", "nonrigid_icp", "cpd", "skeleton_graph"])
def test_both_surfaces_are_tuned_on_one_grid_and_every_row_is_recorded(tune: ModuleType, name: str) -> None:
    visible, whole = list(tune.grid(name)), list(tune.grid(name + tune.WHOLE))
    assert whole[: len(visible)] == visible
    assert not set(whole[len(visible) :]) & set(visible)
    for table, rows in ((name, visible), (name + tune.WHOLE, whole)):
        recorded = pd.read_csv(ROOT / "results" / "tuning" / f"{table}.csv")
        assert sorted(recorded["setting"]) == list(range(len(rows)))


def test_the_field_method_is_tuned_on_people_of_three_kinds_and_every_row_is_recorded(tune: ModuleType) -> None:
    recorded = pd.read_csv(ROOT / "results" / "tuning" / "gaussian_process.csv")
    assert sorted(recorded["setting"]) == list(range(len(list(tune.grid("gaussian_process")))))
    assert min(len(tune.PHANTOMS), len(tune.FULL_SPREAD), len(tune.PLANTED)) >= 4
    assert (recorded["pairs"] == len(tune.PHANTOMS) + len(tune.FULL_SPREAD) + len(tune.PLANTED)).all()


@pytest.mark.parametrize("name", ["icp", "cpd_whole", "bcpd", "skeleton_graph_repaired"])
def test_the_best_rows_of_a_large_grid_ran_on_more_people_of_three_kinds(tune: ModuleType, name: str) -> None:
    recorded = pd.read_csv(ROOT / "results" / "tuning" / f"{name}.csv")
    assert min(map(len, tune.FEWER)) >= 2
    assert set(recorded["pairs"]) == {tune.FIRST, sum(map(len, tune.FEWER))}
    assert recorded["pairs"].to_list() == sorted(recorded["pairs"], reverse=True)
    assert (recorded["pairs"] > tune.FIRST).sum() == tune.FINALISTS


@pytest.mark.parametrize("name", ["bcpd", "skeleton_graph_repaired"])
def test_every_row_of_a_grid_of_one_surface_is_recorded(tune: ModuleType, name: str) -> None:
    recorded = pd.read_csv(ROOT / "results" / "tuning" / f"{name}.csv")
    assert sorted(recorded["setting"]) == list(range(len(list(tune.grid(name)))))


def test_a_grid_runs_on_the_surface_that_its_table_is_named_after(
    tune: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    surfaces = {}

    def seen(_: object, runner: object, __: object) -> None:
        surfaces[table] = "visible" if isinstance(runner, tune.VisibleSurface) else "whole"
        raise tune.StudyError("enough")

    monkeypatch.setattr(tune, "register_aligned", seen)
    monkeypatch.setattr(tune, "development_pair", lambda name, *_: SimpleNamespace(source=name, alignment=None))
    monkeypatch.setattr(tune, "planted_pair", lambda name, _: SimpleNamespace(source=name, alignment=None))
    monkeypatch.setattr(tune, "grid", lambda _: [tune.Icp()])
    monkeypatch.setattr(tune, "summarise", lambda rows: rows)  # as many finalists as rows
    for table in ("icp", "icp_whole", "cpd", "cpd_whole"):
        monkeypatch.setattr(sys, "argv", ["tune.py", table, "--out", str(tmp_path)])
        tune.main()
        assert len(pd.read_csv(tmp_path / f"{table}.csv")) == sum(map(len, tune.FEWER))
    assert surfaces == {"icp": "visible", "icp_whole": "whole", "cpd": "visible", "cpd_whole": "whole"}
