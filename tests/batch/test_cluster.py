"""Runs on a Dask cluster: a scheduler and two workers as processes on loopback, one of them killed."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from phantom_files import SMALL, cached_ct_volume

from study import phantom
from study.batch import run_study
from study.batch.cluster import arithmetic_of_now, require_same_arithmetic
from study.batch.workers import Outcome, Workers
from study.cli import main
from study.datasets import find_dataset
from study.errors import StudyError

distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")
METHODS = ("coarse", "icp", "icp_tuned")
PATIENCE_S = 120


class Cluster:
    """A scheduler and its workers."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "scheduler.json"
        self.processes = {"scheduler": self._start("scheduler", "--host", "127.0.0.1", "--port", "0")}
        self._wait(self.file.exists)

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "dask", *words, "--scheduler-file", str(self.file), "--no-dashboard"]
        return subprocess.Popen(
            command, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def worker(self, name: str, threads: int = 1) -> None:
        n_before = len(self.client.scheduler_info(n_workers=-1)["workers"])
        words = ("--nthreads", str(threads), "--no-nanny", "--name", name, "--host", "127.0.0.1")
        self.processes[name] = self._start("worker", *words)
        self._wait(lambda: len(self.client.scheduler_info(n_workers=-1)["workers"]) > n_before)

    def end(self, name: str) -> None:
        process = self.processes.pop(name)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()

    def connect(self) -> None:
        self.client = distributed.Client(scheduler_file=str(self.file), set_as_default=False, timeout=PATIENCE_S)
        self.address = self.client.scheduler.address

    def where(self, name: str) -> str:
        """The address of a worker."""
        workers = self.client.scheduler_info(n_workers=-1)["workers"]
        return next(address for address, worker in workers.items() if worker["name"] == name)

    def _wait(self, there: object) -> None:
        end = time.monotonic() + PATIENCE_S
        while not there():
            assert time.monotonic() < end
            time.sleep(0.05)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        made.connect()
        made.worker("one")
        yield made
        made.client.close()
    finally:
        for name in list(made.processes):
            made.end(name)


def test_calls_come_back_as_from_here(cluster: Cluster) -> None:
    calls = {"a": (math.sqrt, 4.0), "b": (math.sqrt, -1.0), "c": (math.sqrt, Outcome(9.0))}
    calls["d"] = (math.sqrt, Outcome(error=StudyError("no sternum")))
    calls["e"] = (os.getpid,)
    told = []
    found = Workers(1, False, cluster.address).run("roots", calls, lambda key, _: told.append(key))
    here = Workers(1, False).run("roots", calls)
    pid = cluster.processes["one"].pid  # of one worker, too, nothing is computed here
    assert [outcome.value for outcome in found.values()] == [2.0, None, 3.0, None, pid]
    assert {key: str(outcome.error) for key, outcome in found.items()} == {
        key: str(outcome.error) for key, outcome in here.items()
    }
    assert sorted(told) == list(calls)
    assert found["b"].trace


def test_a_worker_of_two_threads_is_refused(cluster: Cluster) -> None:
    cluster.worker("wide", threads=2)
    with pytest.raises(StudyError, match=r"expected workers with one thread each, got 1 with more"):
        Workers(1, False, cluster.address).run("roots", {"a": (math.sqrt, 4.0)})
    cluster.end("wide")


def test_a_run_with_a_killed_worker_is_the_local_run(
    cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(phantom, "ct_volume", cached_ct_volume)
    people = find_dataset("phantom", SMALL, 0)
    run_study(people, tmp_path / "here", methods=METHODS)
    killed = threading.Event()
    cluster.worker("two")
    where = cluster.where("two")

    def kill() -> None:
        while not cluster.client.processing().get(where):  # it has a case in its hands
            time.sleep(0.001)
        cluster.end("two")
        killed.set()

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    run = run_study(people, tmp_path / "there", methods=METHODS, scheduler=cluster.address)
    assert killed.is_set()
    thread.join()
    assert run.failures.empty
    for name in ("metrics.csv", "hd_table.md"):
        assert (run.folder / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_a_worker_with_other_code_computes_nothing() -> None:
    require_same_arithmetic(arithmetic_of_now())
    other = tuple((name, "0" if name == "code_sha256" else value) for name, value in arithmetic_of_now())
    with pytest.raises(StudyError, match="expected workers with the code_sha256 of this process, 0, got"):
        require_same_arithmetic(other)


def test_where_nobody_schedules_it_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("study.batch.cluster.CONNECT_S", 0.3)
    with pytest.raises(StudyError, match=r"expected a Dask scheduler at tcp://127\.0\.0\.1:9, got .*`dask scheduler`"):
        Workers(1, False, "tcp://127.0.0.1:9").run("roots", {"a": (math.sqrt, 4.0)})
    assert main(["run", "--scheduler", "tcp://127.0.0.1:9", "--jobs", "2"]) == 2
    assert "either --jobs or --scheduler" in capsys.readouterr().err
