"""tools/newest.py and tools/reference.py: what they decide, without a run."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest
from result_rows import some_rows

from study.errors import StudyError
from study.results.metrics_csv import write_metrics

ROOT = Path(__file__).parents[1]


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"tools_{name}", ROOT / "tools" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# --- newest.py -------------------------------------------------------------------------------------------------------

LOCKED = {"numpy": "2.0", "scipy": "1.14", "click": "8.1", "pip": "23", "thoracic-cartilage-study": "0.3"}
NEWEST = {**LOCKED, "numpy": "2.3", "scipy": "1.15", "click": "8.2", "thoracic-cartilage-study": "0.4", "extra": "1"}


def test_only_numerical_packages_with_another_version_are_tried_alone() -> None:
    newest = load("newest")
    found = newest.changed(LOCKED, NEWEST)
    assert found == {"click": ("8.1", "8.2"), "numpy": ("2.0", "2.3"), "scipy": ("1.14", "1.15")}
    asked = []

    def alone(name: str, version: str) -> tuple[int, str]:
        asked.append((name, version))
        return (1 if name == "scipy" else 0), f"{name} was tried"

    told = newest.culprits(found, alone)
    assert asked == [("numpy", "2.3"), ("scipy", "1.15")]
    text = newest.summary(found, (1, "all differ"), told)
    assert text.startswith("# Newest packages: scipy moves a number\n")
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    assert rows[0] == "| scipy | 1.14 | 1.15 | **differs** |"
    assert "| numpy | 2.0 | 2.3 | agrees |" in rows
    assert "| click | 8.1 | 8.2 | – |" in rows
    assert "scipy was tried" in text
    assert "numpy was tried" not in text


def test_what_moves_only_together_or_not_at_all_is_said() -> None:
    newest = load("newest")
    found = newest.changed(LOCKED, NEWEST)
    assert "no number moves" in newest.summary(found, (0, "agrees"), {})
    both = newest.summary(found, (1, "differs"), {"numpy": (0, "agrees"), "scipy": (2, "no wheel")})
    assert "numbers move, by no numerical package alone" in both
    assert "Could not be tried alone: scipy." in both
    assert "| scipy | 1.14 | 1.15 | failed |" in both


def test_each_package_is_tried_from_the_lock(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The whole road with commands that only say what they would do."""
    newest = load("newest")
    there, commands = dict(LOCKED), []

    def step(*words: object, allowed: tuple[int, ...] = (0,)) -> tuple[int, str]:
        command = [str(word) for word in words]
        commands.append(command)
        if "--require-hashes" in command:
            there.update(LOCKED)
        elif "eager" in command:
            there.update(NEWEST)
        elif "--upgrade" in command:
            name, _, version = command[-1].partition("==")
            there[name] = version
        elif "list" in command:
            return 0, "".join(f"{name}=={version}\n" for name, version in there.items())
        elif "compare" in command:
            return (1, "differs") if there["numpy"] == "2.3" else (0, "agrees")
        return 0, ""

    monkeypatch.setattr(newest, "step", step)
    code, text = newest.work(tmp_path)
    assert code == 1
    assert "# Newest packages: numpy moves a number" in text
    assert "| scipy | 1.14 | 1.15 | agrees |" in text
    assert sum("--require-hashes" in command for command in commands) == 3


def test_a_step_that_fails_is_an_exit_code_of_its_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    newest = load("newest")
    with pytest.raises(newest.Failed, match=r"exit code 3: no"):
        newest.step(sys.executable, "-c", "import sys; sys.exit('no') if 0 else (print('no'), sys.exit(3))")

    def fail(_: Path) -> None:
        raise newest.Failed("pip: no network")

    monkeypatch.setattr(newest, "work", fail)
    page = tmp_path / "newest.md"
    monkeypatch.setattr(sys, "argv", ["newest.py", "--markdown", str(page)])
    assert newest.main() == 2
    assert "pip: no network" in page.read_text(encoding="utf-8")
    assert "pip: no network" in capsys.readouterr().out


# --- reference.py ----------------------------------------------------------------------------------------------------

LOG = "# Changes\n\n## Unreleased\n\n- Something.\n\n## 0.3.0\n\nOlder.\n"


def folders(tmp_path: Path, mm: float) -> tuple[ModuleType, dict[str, Path], Path]:
    """The tool, runs whose graph moved by so many mm in `open`, and the reference."""
    for name in ("phantom", "open"):
        rows = some_rows(dataset=name)
        write_metrics(rows, tmp_path / "reference" / name / "metrics.csv")
        (tmp_path / "reference" / name / "gone.png").write_text("old", encoding="utf-8")
        by = mm if name == "open" else 0.0
        moved = [{**row, "value": row["value"] + by * (row["method"] == "skeleton_graph")} for row in rows]
        write_metrics(moved, tmp_path / "runs" / name / "metrics.csv")
    return load("reference"), {name: tmp_path / "runs" / name for name in ("phantom", "open")}, tmp_path / "reference"


def test_what_moved_is_drafted_with_old_and_new(tmp_path: Path) -> None:
    tool, runs, reference = folders(tmp_path, 0.5)
    found = tool.against(runs, reference)
    rows = tool.draft(found)
    means = json.loads(found.json())["datasets"]["open"]["means"]
    of = {row["metric"]: row for row in means if row["method"] == "skeleton_graph"}
    hd, way = of["hd"], of["waypoint_error"]
    assert (
        f"| `open` | {hd['reference']:.2f} | {hd['candidate']:.2f} | {way['reference']:.2f} | {way['candidate']:.2f} |"
        in rows
    )
    assert f"| `open` | `skeleton_graph` | `hd` | {hd['reference']:.4g} | {hd['candidate']:.4g} | why? |" in rows
    assert "`phantom`" not in rows
    text = tool.with_draft(LOG, rows)
    assert text.index(tool.BEGIN) < text.index("| `open` |") < text.index(tool.END) < text.index("- Something.")
    assert tool.with_draft(text, rows) == text  # in the place of the older draft
    with pytest.raises(StudyError, match="expected the heading '## Unreleased'"):
        tool.with_draft("# Changes\n", rows)


def test_nothing_moved_is_no_draft_and_a_new_data_set_is_named(tmp_path: Path) -> None:
    tool, runs, reference = folders(tmp_path, 0.0)
    assert tool.draft(tool.against(runs, reference)) == ""
    (reference / "open" / "metrics.csv").unlink()
    assert "- `open`: new reference" in tool.draft(tool.against(runs, reference))


def test_the_runs_take_the_place_of_the_reference(tmp_path: Path) -> None:
    tool, runs, reference = folders(tmp_path, 0.5)
    tool.renew(runs, reference)
    for name, run in runs.items():
        assert (reference / name / "metrics.csv").read_bytes() == (run / "metrics.csv").read_bytes()
        assert not (reference / name / "gone.png").exists()
    assert tool.draft(tool.against(runs, reference)) == ""


def test_runs_that_are_not_of_now_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tool, _, reference = folders(tmp_path, 0.5)
    monkeypatch.setattr(tool, "REFERENCE", reference)
    monkeypatch.setattr(sys, "argv", ["reference.py", "--runs", str(tmp_path / "runs")])
    before = {path: path.read_bytes() for path in reference.rglob("*.csv")}
    assert tool.main() == 2
    assert "run `make study`" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in reference.rglob("*.csv")} == before
