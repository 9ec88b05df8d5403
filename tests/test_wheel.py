"""The wheel works far from a checkout: what it carries, and the commands from another folder."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pandas as pd
import pytest

from study import __version__, phantom
from study.files.clouds import read_ply, write_ply

ROOT = Path(__file__).parents[1]
DISTRIBUTION = "thoracic_cartilage_study"
US_NOISE_MM = 0.5
PIP = (sys.executable, "-m", "pip", "--isolated", "--disable-pip-version-check", "--quiet")

pytestmark = [
    pytest.mark.skipif(find_spec(name) is None, reason=f"{name} is not installed; run `make setup`")
    for name in ("hatchling", "pip")
]

Run = Callable[..., str]


def _outside(command: list[str], folder: Path, **variables: str) -> str:
    """Standard output of a command that works in ``folder`` and inherits no way to the checkout's modules."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment |= {"PYTHONUTF8": "1"} | variables
    # The library writes UTF-8; what a locale set by some other test's library would decode is no matter.
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, encoding="utf-8", timeout=300)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    _outside([*PIP, "wheel", "--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", ".", str(ROOT)], folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def venv(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel; the other packages are those of the running interpreter."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    _outside([sys.executable, "-m", "venv", "--without-pip", str(folder)], folder.parent)
    python = folder / "bin" / "python"
    _outside([*PIP, "--python", str(python), "install", "--no-deps", "--no-index", str(wheel)], folder.parent)
    # Only now, or pip would find the checkout's own installation. Paths of a .pth file come after the environment's
    # own packages, and .pth files in those paths, as that of an editable installation, are not followed.
    (own,) = folder.glob("lib/python*/site-packages")
    others = [path for path in sys.path if Path(path).name in {"site-packages", "dist-packages"}]
    assert others
    (own / "others.pth").write_text("\n".join(others), encoding="utf-8")
    return folder


@pytest.fixture
def run(venv: Path, tmp_path: Path) -> Run:
    """Run a command of the environment in an empty folder; gives its standard output."""

    def run_command(command: str, *arguments: str | Path) -> str:
        chosen = [str(venv / "bin" / command), *map(str, arguments)]
        return _outside(chosen, tmp_path, STUDY_DATA_DIR=str(tmp_path / "data"))

    return run_command


def test_wheel_carries_every_module_the_shipped_files_and_no_tests(wheel: Path) -> None:
    manifest = ROOT / "data_manifest.yaml"
    shipped = [manifest, *(ROOT / "annotations").glob("*.yaml"), *(ROOT / "results" / "paper").glob("*.csv")]
    modules = [path.relative_to(ROOT / "src").as_posix() for path in (ROOT / "src").rglob("*.py")]
    assert len(shipped) >= 6
    assert "study/cli/__init__.py" in modules
    assert wheel.name.startswith(f"{DISTRIBUTION}-{__version__}-py3-")
    with ZipFile(wheel) as archive:
        names = set(archive.namelist())
        for path in shipped:
            assert archive.read(f"study/shipped/{path.relative_to(ROOT).as_posix()}") == path.read_bytes()
    assets = {path.relative_to(ROOT / "src").as_posix() for path in (ROOT / "src/study/report/assets").iterdir()}
    assets = {name for name in assets if not name.endswith("__pycache__")}
    assert "study/report/assets/niivue.umd.js" in assets
    assert {*modules, *assets, "study/py.typed"} <= names
    assert {name.split("/")[0] for name in names} == {"study", f"{DISTRIBUTION}-{__version__}.dist-info"}
    assert not [name for name in names if re.search(r"(^|/)(tests?|test_[^/]*|conftest)(/|\.)", name)]


def test_package_is_imported_from_the_wheel(run: Run, venv: Path) -> None:
    place = "import study, study.files.places as p; print(study.__file__, p.is_checkout(), p.shipped('annotations'))"
    file, is_checkout, annotations = run("python", "-c", place).split()
    assert Path(file).is_relative_to(venv)
    assert is_checkout == "False"
    assert Path(annotations).is_relative_to(venv)
    assert sorted(os.listdir(annotations)) == sorted(os.listdir(ROOT / "annotations"))


def test_version_is_the_wheels(run: Run) -> None:
    assert run("study", "--version").strip() == f"study, version {__version__}"
    installed = f"from importlib.metadata import version; print(version({DISTRIBUTION!r}))"
    assert run("python", "-c", installed).strip() == __version__


def test_module_runs_as_the_command(run: Run) -> None:
    text = run("python", "-m", "study", "--help")
    assert text == run("study", "--help")
    assert "register" in text


def test_files_are_listed_from_the_shipped_manifest(run: Run) -> None:
    text = run("study", "data", "list", "--dataset", "open")
    assert {"lung1_ct", "lung2_ct", "lidc_ct"} <= set(text.split())


def test_two_clouds_are_registered(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    ct = phantom.reference_cloud(phantom.draw_subject("ct1", 0), 2000, rng)
    us = phantom.anterior_cloud(phantom.draw_subject("patient", 0), 2000, US_NOISE_MM, 0, rng)
    write_ply(ct, tmp_path / "ct.ply")
    write_ply(us, tmp_path / "us.ply")
    run("study", "register", "ct.ply", "us.ply", "--method", "icp", "--out", "registered")
    assert (tmp_path / "registered" / "registration.json").is_file()
    assert len(read_ply(tmp_path / "registered" / "warped.ply")) == len(ct)


def test_phantom_study_runs_and_is_put_beside_the_paper(run: Run, tmp_path: Path) -> None:
    text = run("study", "run", "--dataset", "phantom", "--profile", "quick", "--methods", "coarse", "--out", "out")
    metrics = pd.read_csv(tmp_path / "out" / "metrics.csv")
    assert "coarse" in set(metrics["method"])
    assert (tmp_path / "out" / "provenance.json").is_file()
    assert "paper (other data)" in text  # read from the shipped results/paper
