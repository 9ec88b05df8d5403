from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from study.errors import StudyError
from study.files.atomic import sha256_of, write_json
from study.results.claim import Claim, claimed


def publish(claim: Claim, text: str, names: tuple[str, ...] = ("metrics.csv",)) -> None:
    new = claim.new()
    for name in names:
        (new / name).write_text(text)
    hashes = {name: sha256_of(new / name) for name in names}
    write_json({"code_sha256": "ab", "files_sha256": hashes}, new / "provenance.json")
    claim.swap_in()


def content(folder: Path) -> dict[str, str]:
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    return {name: path.read_text() for name, path in found.items() if name != "provenance.json"}


def test_a_run_takes_the_place_of_the_one_before_and_leaves_nothing_beside(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "run"
    with claimed(out) as claim:
        publish(claim, "1", ("metrics.csv", "hd_table_a.md"))
    with claimed(out) as claim:
        publish(claim, "2")
    assert content(out) == {"metrics.csv": "2"}  # no table of the first run
    assert list(out.parent.iterdir()) == [out]


def test_what_is_not_the_runs_stays(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with claimed(out) as claim:
        publish(claim, "1")
    (out / "notes").mkdir()
    (out / "notes" / "a.txt").write_text("mine")
    (out / "hd_mine.csv").write_text("mine, too")
    (out / "broken").symlink_to("nowhere")
    out.chmod(0o700)
    with claimed(out) as claim:
        publish(claim, "2")
    assert content(out) == {"metrics.csv": "2", "hd_mine.csv": "mine, too", "notes/a.txt": "mine"}
    assert (out / "broken").is_symlink()
    assert out.stat().st_mode & 0o777 == 0o700
    with claimed(out) as claim, pytest.raises(StudyError, match=r"hd_mine\.csv: expected no file of that name"):
        publish(claim, "3", ("metrics.csv", "hd_mine.csv"))
    assert content(out)["metrics.csv"] == "2"


def test_a_folder_that_study_did_not_make_is_refused_as_it_is(tmp_path: Path) -> None:
    for name, text in (("hd_thesis.csv", "years of work"), ("metrics.csv", "mine"), ("provenance.json", "{}")):
        out = tmp_path / name.split(".")[0]
        out.mkdir()
        (out / name).write_text(text)
        told = rf"expected a new folder or one that `study run` made, got {name}"
        with pytest.raises(StudyError, match=told), claimed(out):
            pytest.fail("claimed")
        assert [path.name for path in out.iterdir()] == [name]
        assert (out / name).read_text() == text
    assert not list(tmp_path.glob(".*"))
    (tmp_path / "file").write_text("")
    with pytest.raises(StudyError, match="got the file"), claimed(tmp_path / "file"):
        pytest.fail("claimed")


def test_a_run_of_an_older_version_is_replaced_but_for_what_it_did_not_write(tmp_path: Path) -> None:
    for name in ("metrics.csv", "timings.csv", "hd_table_ct1.md", "hd_all_pairs.tex", "judges.png", "mine.png"):
        (tmp_path / "run").mkdir(exist_ok=True)
        (tmp_path / "run" / name).write_text("old")
    write_json({"code_sha256": "ab"}, tmp_path / "run" / "provenance.json")
    with claimed(tmp_path / "run") as claim:
        publish(claim, "new")
    assert content(tmp_path / "run") == {"metrics.csv": "new", "mine.png": "old"}


def test_the_current_folder_cannot_be_swapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for out in (Path(), tmp_path.parent, Path("/")):
        with pytest.raises(StudyError, match="name a folder below it"), claimed(out):
            pytest.fail("claimed")


def test_a_second_writer_is_refused_by_name_and_a_dead_one_is_not_in_the_way(tmp_path: Path) -> None:
    out, lock = tmp_path / "run", tmp_path / ".run.unfinished" / "lock"
    told = f"run: expected to be its only writer, got another: process {os.getpid()} on "
    with claimed(out), pytest.raises(StudyError, match=told), claimed(out):
        pytest.fail("claimed twice")
    lock.parent.mkdir()
    lock.write_text("process 1 on moon")
    hold = "import fcntl, sys; f = open(sys.argv[1]); fcntl.flock(f, fcntl.LOCK_EX); print('held', flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-I", "-S", "-c", hold, str(lock)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        encoding="utf-8",
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(StudyError, match="process 1 on moon; wait for it to end"), claimed(out):
            pytest.fail("claimed")
        other.kill()
    with claimed(out) as claim:
        publish(claim, "1")
    assert content(out) == {"metrics.csv": "1"}


def test_a_writer_can_be_waited_for(tmp_path: Path) -> None:
    order = []

    def wait() -> None:
        with claimed(tmp_path / "run", wait=True) as claim:
            order.append("second")
            publish(claim, "2")

    with claimed(tmp_path / "run") as claim:
        waiting = threading.Thread(target=wait)
        waiting.start()
        time.sleep(0.2)
        order.append("first")
        publish(claim, "1")
    waiting.join(10)
    assert order == ["first", "second"]
    assert content(tmp_path / "run") == {"metrics.csv": "2"}
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("step", ["before", "between", "after"])
def test_a_swap_that_was_cut_is_undone_or_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    """As after a kill: nothing that would run while an exception passes is run."""
    out, beside = tmp_path / "run", tmp_path / ".run.unfinished"
    with claimed(out) as claim:
        publish(claim, "1")
    (beside / "new").mkdir(parents=True)
    (beside / "new" / "metrics.csv").write_text("2")
    if step != "before":
        out.rename(beside / "old")
    if step == "after":
        (beside / "new").rename(out)
        write_json({"code_sha256": "ab", "files_sha256": {"metrics.csv": ""}}, out / "provenance.json")
    with claimed(out):
        pass
    assert content(out) == {"metrics.csv": "2" if step == "after" else "1"}
    assert not beside.exists()


def test_finished_cases_outlive_a_failure_and_nothing_else_does(tmp_path: Path) -> None:
    out = tmp_path / "run"

    def stop(kept: str) -> None:
        with claimed(out) as claim:
            claim.new()
            if kept:
                claim.journal.write_text(kept)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stop("")
    assert not list(tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt):
        stop("kept")
    assert {path.name for path in (tmp_path / ".run.unfinished").iterdir()} == {"finished.jsonl", "lock"}
