"""`study compare` on folders of runs: what it writes, prints and exits with."""

import json
from pathlib import Path

import pytest
from junitparser import JUnitXml
from result_rows import some_rows

from study.cli import main
from study.results.metrics_csv import write_metrics


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for side in ("ref", "cand"):
        for name in ("open", "phantom"):
            write_metrics(some_rows(dataset=name), tmp_path / side / name / "metrics.csv")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


WRITE = ["--markdown", "out/c.md", "--json", "out/c.json", "--junit", "out/c.xml"]


def test_all_data_sets_agree_in_one_call(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "ref", "cand", *WRITE]) == 0
    out = capsys.readouterr().out
    assert out.count("largest difference 0 of its tolerance") == 1
    assert out.endswith("all 2 data sets: agrees\n")
    assert JUnitXml.fromfile("out/c.xml").failures == 0
    assert json.loads(Path("out/c.json").read_text(encoding="utf-8"))["exit_code"] == 0
    assert "agrees" in Path("out/c.md").read_text(encoding="utf-8")


def test_a_missing_row_is_1_and_the_other_data_set_is_told_too(
    folders: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_metrics(some_rows(dataset="open")[:-1], folders / "cand" / "open" / "metrics.csv")
    assert main(["compare", "ref", "cand", *WRITE]) == 1
    out = capsys.readouterr().out
    assert "1 row(s) only in the reference" in out
    assert "phantom: compared" in out
    assert JUnitXml.fromfile("out/c.xml").failures == 1


def test_a_data_set_without_a_run_is_2_and_nothing_hides_it(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folders / "cand" / "open" / "metrics.csv").unlink()
    assert main(["compare", "ref", "cand", *WRITE]) == 2
    out = capsys.readouterr().out
    assert "open: cannot be compared: expected the same metrics.csv files" in out
    assert "phantom: compared" in out
    assert JUnitXml.fromfile("out/c.xml").errors == 1


def test_an_empty_folder_is_2_with_one_line_and_still_written_for_ci(
    folders: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", "ref", "empty", *WRITE]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("study: expected metrics.csv in empty")
    assert err.count("\n") == 1
    assert "cannot be compared" in Path("out/c.md").read_text(encoding="utf-8")
    assert JUnitXml.fromfile("out/c.xml").errors == 2
