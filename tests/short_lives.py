"""A process that runs a small study in children that it kills; `tests/batch/test_killed.py` talks to it by lines.

``python short_lives.py`` prints ``ready``; then for each line ``FOLDER SECONDS`` it forks a child that runs the study
into the folder, kills it after so many seconds, and prints ``killed`` or ``done`` and how long it took. ``orphan``
leaves a process whose parent is killed, and prints its number.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from phantom_files import SMALL, cached_ct_volume

from study import phantom
from study.batch import cases, run_study
from study.batch.workers import _end_with
from study.datasets import PhantomDataset, find_dataset

METHODS = ("coarse", "icp", "icp_tuned")
PEOPLE = find_dataset("phantom", replace(SMALL, max_sources=2), 0)


def prepared(_: None) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Everything up to the coarse alignment, by name."""
    phantom.ct_volume = cached_ct_volume
    anatomies = {name: PEOPLE.anatomy(name).without_images() for name in PEOPLE.names()}
    patients = {name: PEOPLE.patient(name, anatomies[name]) for name in PEOPLE.targets()}
    people = {person.cloud.name: person for person in (*anatomies.values(), *patients.values())}
    return anatomies, patients, {name: cases._chest(person) for name, person in people.items()}


def child(life: Callable[[], Any]) -> int:
    """The number of a forked process that does one thing and ends."""
    number = os.fork()
    if number == 0:
        try:
            life()
        finally:
            os._exit(0)
    return number


@cache
def watched() -> None:
    _end_with(os.getppid())


def orphan() -> None:
    """A process that watches its parent, and that parent, killed."""
    reader, writer = os.pipe()

    def parent() -> None:
        def worker() -> None:
            watched()
            os.write(writer, b"%d" % os.getpid())
            time.sleep(60)

        child(worker)
        time.sleep(60)

    number = child(parent)
    worker = os.read(reader, 20).decode()
    os.kill(number, signal.SIGKILL)
    os.waitpid(number, 0)
    print(worker, flush=True)


def main() -> None:
    # In a process of its own: libraries with threads must not have been at work in one that forks.
    with multiprocessing.get_context("fork").Pool(1) as pool:
        anatomies, patients, chests = pool.apply(prepared, (None,))
    PhantomDataset.anatomy = lambda _, name, *rest: anatomies[name]
    PhantomDataset.patient = lambda _, name, *rest: patients[name]
    cases._chest = lambda person: chests[person.cloud.name]
    print("ready", flush=True)
    for line in sys.stdin:
        if line.strip() == "orphan":
            orphan()
            continue
        folder, seconds = line.split()
        start = time.monotonic()
        number = child(lambda folder=folder: run_study(PEOPLE, Path(folder), methods=METHODS))
        while time.monotonic() - start < float(seconds) and not os.waitid(
            os.P_PID, number, os.WEXITED | os.WNOHANG | os.WNOWAIT
        ):
            time.sleep(0.001)
        os.kill(number, signal.SIGKILL)
        _, status = os.waitpid(number, 0)
        print("killed" if os.WIFSIGNALED(status) else "done", time.monotonic() - start, flush=True)


if __name__ == "__main__":
    main()
