"""A run repeated from what its folder recorded."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from phantom_files import SMALL, cached_ct_volume

from study import phantom
from study.batch import run_study
from study.batch.rerun import differences, rerun
from study.cli import main
from study.datasets import find_dataset
from study.errors import StudyError
from study.files.atomic import write_json
from study.results.compare import compare
from study.results.metrics_csv import read_metrics, write_metrics

METHODS = ("icp", "coarse")
EARLIER = {"code_sha256": "0" * 64, "commit": "abcdef0123456", "uncommitted_changes": "", "versions": {"numpy": "1"}}
Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(phantom, "ct_volume", cached_ct_volume)


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run at a seed and with parameters of its own."""
    out = tmp_path_factory.mktemp("runs") / "kept"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(phantom, "ct_volume", cached_ct_volume)
        run_study(find_dataset("phantom", SMALL, 3), out, methods=METHODS)
    return out


@pytest.fixture
def edited(kept: Path, tmp_path: Path) -> Callable[..., Path]:
    """A copy with another record."""

    def edit(change: Callable[[dict], object]) -> Path:
        folder = shutil.copytree(kept, tmp_path / "edited")
        record = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
        change(record)
        write_json(record, folder / "provenance.json")
        return folder

    return edit


def test_a_folder_is_complete_and_repeated_to_the_byte(
    kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    there = {path.name for path in kept.iterdir()}
    assert there >= {"parameters.json", "environment.lock", "manifest.yaml", "ro-crate-metadata.json"}
    monkeypatch.chdir(tmp_path)
    assert main(["rerun", str(kept)]) == 0
    out, err = capsys.readouterr()
    assert "agrees; largest difference 0 of its tolerance" in out
    assert "note:" not in err
    again = tmp_path / "results" / "trials" / "kept-rerun"
    for name in ("metrics.csv", "hd_table.md", "parameters.json"):
        assert (again / name).read_bytes() == (kept / name).read_bytes()


def test_other_numbers_differ_and_other_code_is_said(
    edited: Callable[..., Path], tmp_path: Path, capsys: Capture
) -> None:
    folder = edited(lambda record: record.update(EARLIER))
    rows = read_metrics(folder / "metrics.csv")
    rows.loc[rows["metric"] == "hd", "value"] += 0.5
    write_metrics(rows.to_dict("records"), folder / "metrics.csv")
    assert main(["rerun", str(folder), "--out", str(tmp_path / "new")]) == 1
    out, err = capsys.readouterr()
    assert "value(s) beyond tolerance" in out
    assert "study: note: other code: commit abcdef0123, now " in err
    assert "numpy 1, now " in err
    assert "edited metrics.csv" in err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda record: record["parameters"]["methods"]["icp"].update(max_iterations=3), "expected icp with the param"),
        (lambda record: record["parameters"]["methods"].update(magic={}), "got 'magic', which it lacks; check out"),
        (lambda record: record["parameters"]["study"].update(speed=3), "got others: .* got speed; check out commit"),
        (lambda record: record["parameters"].pop("study"), "expected the record of a `study run`"),
        (lambda record: record.update(dataset="mine"), "say where its manifest is now by --dataset"),
    ],
)  # fmt: skip
def test_what_cannot_be_repeated_is_refused_with_the_reason(
    edited: Callable[..., Path], tmp_path: Path, change: Callable[[dict], object], told: str
) -> None:
    with pytest.raises(StudyError, match=told):
        rerun(edited(lambda record: (record.update(commit="abc"), change(record))), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_folder_is_not_repeated_into_itself(kept: Path) -> None:
    with pytest.raises(StudyError, match="expected a folder beside the run"):
        rerun(kept, kept)
    assert compare(kept, kept).agrees


def test_only_what_differs_is_said() -> None:
    before = {"code_sha256": "a", "lock_sha256": "b", "versions": {"numpy": "1", "scipy": "1"}, "inputs_sha256": {}}
    assert differences(before, before) == []
    now = {**before, "versions": {"numpy": "2", "scipy": "1"}, "inputs_sha256": {"lung1_ct": "c"}}
    assert differences(before, now) == ["other input files: lung1_ct", "other versions: numpy 1, now 2"]
