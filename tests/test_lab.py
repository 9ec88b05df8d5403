"""`make lab`: what JupyterLab's server opens, runs and saves; only where JupyterLab is installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import nbformat
import pytest
import requests
from nbclient import NotebookClient

from study.batch.papermills import Notebook, tidied, write_notebook

pytest.importorskip("jupyterlab", reason="JupyterLab is not installed; `make lab` installs it")

ROOT = Path(__file__).parents[1]
SOURCE = '# %% [markdown]\n# # What is one and one?\n\n# %% tags=["parameters"]\na = 1\n\n# %%\nprint(a + 1)\n'
START_S = 180.0
Ask = Callable[..., Any]


def git(folder: Path, *words: str) -> str:
    who = ("-c", "user.name=nobody", "-c", "user.email=nobody@example.org")
    return subprocess.run(["git", *who, *words], cwd=folder, capture_output=True, encoding="utf-8", check=True).stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The committed pairs and one small one, in a repository of their own."""
    folder = tmp_path_factory.mktemp("checkout")
    for name in ("pyproject.toml", ".gitignore"):
        shutil.copy(ROOT / name, folder)
    pairs = folder / "notebooks"
    pairs.mkdir()
    for path in [*ROOT.glob("notebooks/[0-9]*.py"), *ROOT.glob("notebooks/[0-9]*.ipynb")]:
        shutil.copy(path, pairs)
    (pairs / "99_sum.py").write_text(SOURCE, encoding="utf-8")
    write_notebook(tidied(Notebook(pairs / "99_sum.py").blank()), pairs / "99_sum.ipynb")
    git(folder, "init", "-q")
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "as committed")
    return folder


@pytest.fixture(scope="module")
def ask(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ask]:
    """Ask the server that `make lab` starts: a method, a path, a body."""
    own = tmp_path_factory.mktemp("jupyter")
    environment = {**os.environ, **{f"JUPYTER_{name}_DIR": str(own / name) for name in ("RUNTIME", "CONFIG", "DATA")}}
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", "--ServerApp.port=0"]
    command += [f"--ServerApp.root_dir={checkout}", "--ServerApp.ip=127.0.0.1"]
    with (own / "log").open("w") as log, subprocess.Popen(command, env=environment, stdout=log, stderr=log) as server:
        try:
            runtime, end = own / "RUNTIME" / f"jpserver-{server.pid}.json", time.monotonic() + START_S
            while not runtime.exists() and server.poll() is None and time.monotonic() < end:
                time.sleep(0.1)
            assert runtime.exists(), (own / "log").read_text(encoding="utf-8")
            place = json.loads(runtime.read_text(encoding="utf-8"))
            session = requests.Session()
            session.trust_env = False  # no proxy on the way to this machine
            session.headers["Authorization"] = f"token {place['token']}"

            def answer(method: str, path: str, body: Any = None) -> Any:
                done = session.request(method, f"http://127.0.0.1:{place['port']}/{path}", json=body, timeout=60)
                done.raise_for_status()
                return done.json() if "json" in done.headers["Content-Type"] else done.text

            yield answer
        finally:
            server.terminate()


def saved(ask: Ask, path: str, content: Any) -> None:
    ask("PUT", f"api/contents/{path}", {"type": "notebook", "format": "json", "content": content})


def test_the_kernel_is_the_studys(ask: Ask) -> None:
    found = ask("GET", "api/kernelspecs")
    assert found["default"] == "python3"
    assert found["kernelspecs"]["python3"]["spec"]["argv"][0] in (sys.executable, "python")


def test_the_page_opens(ask: Ask) -> None:
    assert "JupyterLab" in ask("GET", "lab/tree/notebooks/00_data.ipynb")


@pytest.mark.parametrize("side", ["ipynb", "py"])
def test_opening_and_saving_a_committed_pair_changes_nothing(ask: Ask, checkout: Path, side: str) -> None:
    pairs = sorted(checkout.glob(f"notebooks/[0-8]*.{side}"))
    assert len(pairs) == len(list(ROOT.glob("notebooks/[0-9]*.py")))
    for path in pairs:
        place = f"notebooks/{path.name}"
        saved(ask, place, ask("GET", f"api/contents/{place}?content=1&type=notebook")["content"])
        assert git(checkout, "status", "--porcelain") == "", f"{path.name}: {git(checkout, 'diff')[:3000]}"


def test_open_run_all_save_changes_outputs_only(ask: Ask, checkout: Path) -> None:
    place = "notebooks/99_sum.ipynb"
    notebook = nbformat.from_dict(ask("GET", f"api/contents/{place}?content=1&type=notebook")["content"])
    NotebookClient(notebook, kernel_name="python3", resources={"metadata": {"path": str(checkout)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times, which nbclient notes and JupyterLab does not
    saved(ask, place, notebook)
    assert git(checkout, "diff", "--name-only").split() == [place]
    before, after = (
        nbformat.reads(text, as_version=4)
        for text in (git(checkout, "show", f"HEAD:{place}"), (checkout / place).read_text(encoding="utf-8"))
    )
    assert after.cells[-1].outputs[0].text == "2\n"
    for cell in after.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    assert after.cells == before.cells
    assert after.metadata.kernelspec == before.metadata.kernelspec


def test_an_edit_in_jupyterlab_is_in_the_script_at_once(ask: Ask, checkout: Path) -> None:
    place = "notebooks/99_sum.ipynb"
    content = ask("GET", f"api/contents/{place}?content=1&type=notebook")["content"]
    content["cells"][-1]["source"] = "print(a + 2)"
    saved(ask, place, content)
    assert (checkout / "notebooks" / "99_sum.py").read_text(encoding="utf-8") == SOURCE.replace("a + 1", "a + 2")
