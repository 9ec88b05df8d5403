"""Runs that are killed: what they leave, and what they come to."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from study.results.run import Run

HELPER = Path(__file__).parents[1] / "short_lives.py"
N_KILLS = 10
WHOLE_S = 100.0


@pytest.fixture(scope="module")
def ask() -> Iterator[Callable[[str], list[str]]]:
    """What the helper answers to a line."""
    with subprocess.Popen(
        [sys.executable, str(HELPER)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        encoding="utf-8",
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    ) as helper:
        assert helper.stdin is not None
        assert helper.stdout is not None
        stdin, stdout = helper.stdin, helper.stdout
        assert stdout.readline() == "ready\n"

        def answer(line: str) -> list[str]:
            print(line, file=stdin, flush=True)
            return stdout.readline().split()

        yield answer
        stdin.close()


def content(folder: Path) -> dict[str, bytes]:
    """What must not depend on how often a run was stopped: all but times."""
    timed = ("timings.csv", "provenance.json", "ro-crate-metadata.json")
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name not in timed}


def kept_in(out: Path) -> int:
    """Finished steps of a run that is not whole."""
    journal = out.with_name(f".{out.name}.unfinished") / "finished.jsonl"
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def test_a_run_killed_ten_times_ends_as_one_that_was_left_alone(
    ask: Callable[[str], list[str]], tmp_path: Path
) -> None:
    ended, seconds = ask(f"{tmp_path / 'alone'} {WHOLE_S}")
    assert ended == "done"
    rng, life = np.random.default_rng(7), float(seconds)
    out, kept, n_killed, n_lives = tmp_path / "killed", [0], 0, 0
    while n_killed < N_KILLS:
        ended, _ = ask(f"{out} {rng.uniform(0.1, 0.5) * life}")
        n_killed, n_lives = n_killed + (ended == "killed"), n_lives + 1
        if ended == "done":  # killed too late: once more from the start, over what is there
            assert content(out) == content(tmp_path / "alone")
        else:
            assert kept_in(out) >= kept[-1] or out.exists()
        kept.append(kept_in(out))
        life *= 1.3 if kept[-1] == kept[-2] else 1.0  # the machine has slowed down since its speed was taken
        assert n_lives < 4 * N_KILLS
    assert max(kept) > 0
    assert ask(f"{out} {WHOLE_S}")[0] == "done"
    assert {path.name for path in tmp_path.iterdir()} == {"alone", "killed"}
    assert content(out) == content(tmp_path / "alone")
    columns = ["source", "target", "method", "stage"]
    assert Run(out).timings[columns].equals(Run(tmp_path / "alone").timings[columns])
    assert Run(out).altered is None


def test_a_worker_ends_with_the_process_that_started_it(ask: Callable[[str], list[str]]) -> None:
    (worker,) = ask("orphan")
    end = time.monotonic() + 10
    with suppress(ProcessLookupError):
        while time.monotonic() < end:
            os.kill(int(worker), 0)
            time.sleep(0.05)
        pytest.fail("a worker outlived its run")
