"""Independent calls in any number of processes; a call that fails is an outcome, and no worker outlives its run."""

from __future__ import annotations

import os
import resource
import sys
import threading
import time
import traceback
from collections.abc import Callable, Hashable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from study.batch.cluster import arithmetic_of_now, connected, packed, require_same_arithmetic, unpacked
from study.errors import StudyError
from study.offline import follow, is_offline

K = TypeVar("K", bound=Hashable)
Call = tuple[Any, ...]  # a function and its arguments
WATCH_S = 0.5  # how long a worker may outlive the process that started it


@dataclass(frozen=True)
class Outcome:
    """What one call gave, a value or why it failed, and how long it took.

    Attributes:
        value: of a call that succeeded.
        error: why it failed.
        trace: where in the code, of a failure that is no `StudyError`.
        seconds: it took.
        peak_mb: the most memory that its process had held by then.
    """

    value: Any = None
    error: StudyError | None = None
    trace: str = ""
    seconds: float = 0.0
    peak_mb: float = 0.0

    def get(self) -> Any:
        """The value.

        Raises:
            StudyError: the call, or one that it builds on, failed.
        """
        if self.error is not None:
            raise self.error
        return self.value


@dataclass(frozen=True)
class Workers:
    """Processes that run independent calls, and a bar that shows how far they are.

    Attributes:
        n_jobs: processes of this machine; 1 for this one alone.
        show_progress: bars on standard error.
        scheduler: of a Dask cluster, whose workers are used instead; see `study.batch.cluster`.
    """

    n_jobs: int
    show_progress: bool
    scheduler: str | None = None

    def run(
        self, label: str, calls: Mapping[K, Call], done: Callable[[K, Outcome], None] = lambda *_: None
    ) -> dict[K, Outcome]:
        """Run every ``(function, *arguments)``; an argument that is an earlier outcome stands for its value.

        Args:
            label: of the bar.
            calls: by key.
            done: told of each outcome as soon as it is there, in any order.

        Raises:
            StudyError: a worker process ended before its call did; a cluster that cannot be used or was lost.
        """
        keys = list(calls)
        outcomes: dict[K, Outcome] = {}
        bar = tqdm(
            self._outcomes(calls),
            total=len(calls),
            desc=label,
            bar_format="{desc}: {n_fmt} of {total_fmt} |{bar:20}| {elapsed} so far, about {remaining} left",
            mininterval=bar_interval_s(),
            disable=not (self.show_progress and calls),
        )
        for number, outcome in bar:
            outcomes[keys[number]] = outcome
            done(keys[number], outcome)
        return {key: outcomes[key] for key in keys}

    def _outcomes(self, calls: Mapping[K, Call]) -> Iterator[tuple[int, Outcome]]:
        if self.scheduler is not None:
            yield from self._on_cluster(self.scheduler, calls) if calls else ()
            return
        if self.n_jobs == 1:
            yield from ((number, attempt(*call)) for number, call in enumerate(calls.values()))
            return
        held = os.getpid(), is_offline()
        todo = (delayed(_in_worker)(*held, number, *call) for number, call in enumerate(calls.values()))
        try:
            yield from Parallel(n_jobs=self.n_jobs, return_as="generator_unordered")(todo)
        except BrokenProcessPool as error:
            raise StudyError(
                "expected worker processes to live, got one that ended by itself (is memory short?); finished cases "
                "are kept: start again to go on, with fewer --jobs"
            ) from error

    def _on_cluster(self, scheduler: str, calls: Mapping[K, Call]) -> Iterator[tuple[int, Outcome]]:
        """The same on a cluster, a call a task: the cluster gives the task of a worker that died to another one."""
        expected = arithmetic_of_now()
        todo = (delayed(_on_worker)(expected, number, packed(call)) for number, call in enumerate(calls.values()))
        with connected(scheduler):
            try:
                yield from Parallel(n_jobs=-1, batch_size=1, return_as="generator_unordered")(todo)
            except StudyError:
                raise
            except Exception as error:  # of the cluster: a call's own failure is an outcome
                raise StudyError(
                    f"--scheduler: expected the cluster at {scheduler} to go on, got {type(error).__name__} "
                    f"{' '.join(str(error).split())[:200]}; finished cases are kept: start again to go on"
                ) from error


def bar_interval_s() -> float:
    """How often a bar may move: a log file needs a line now and then, a terminal or a notebook a moving bar."""
    if sys.stderr.isatty():
        return 0.2
    return 1 if "ipykernel" in sys.modules else 15


def attempt(function: Callable[..., Any], *arguments: Any) -> Outcome:
    """Make one call; a failure of any kind, its own or an argument's, is kept instead of raised."""
    start = time.perf_counter()
    value, failure, trace = None, None, ""
    with threadpool_limits(1):  # sums then have one order, whatever the number of workers
        try:
            value = function(*(a.get() if isinstance(a, Outcome) else a for a in arguments))
        except StudyError as error:
            failure = StudyError(str(error))
        except (Exception, SystemExit) as error:  # a bug in one case, here or in a library, is no reason to lose others
            told = f": {error}" if str(error) else ""
            failure = StudyError(type(error).__name__ + told)  # the error itself may not survive the way back
            trace = traceback.format_exc()
    return Outcome(value, failure, trace, time.perf_counter() - start, _peak_mb())


def _peak_mb() -> float:
    """The most memory this process has held so far; the system counts in kB, on macOS in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak / (2**20 if sys.platform == "darwin" else 2**10))


def _in_worker(parent: int, offline: bool, number: int, *call: Any) -> tuple[int, Outcome]:
    _end_with(parent)
    follow(offline)  # a process that was started before has the environment of then
    return number, attempt(*call)


def _on_worker(expected: tuple[tuple[str, str], ...], number: int, content: bytes) -> tuple[int, Outcome]:
    require_same_arithmetic(expected)
    return number, attempt(*unpacked(content))


@cache
def _end_with(parent: int) -> None:
    """Let this worker process end when the one that started it has, however that ended."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
