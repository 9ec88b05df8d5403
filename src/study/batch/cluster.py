"""Independent calls on a Dask cluster that is there already, by joblib; a worker that dies costs its call alone."""

from __future__ import annotations

import pickle
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from joblib import parallel_config

from study.errors import StudyError
from study.results.provenance import arithmetic

CONNECT_S = 15.0


@contextmanager
def connected(address: str) -> Iterator[None]:
    """Let joblib's calls in the block run on the cluster.

    Args:
        address: of the scheduler, as in ``tcp://127.0.0.1:8786``.

    Raises:
        StudyError: dask.distributed is not installed, nobody answers, or workers that would give other bytes.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise StudyError(
            "--scheduler: expected dask.distributed, got none; install the extra: "
            "pip install 'thoracic-cartilage-study[dask]'"
        ) from error
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise StudyError(
            f"--scheduler: expected a Dask scheduler at {address}, got {' '.join(str(error).split())}; start one with "
            "`dask scheduler` and name it as tcp://HOST:PORT"
        ) from error
    with client:
        _require_one_thread(client)
        with parallel_config(backend=_backend(client)):
            yield


def _backend(client: Any) -> Any:
    """Joblib's back end for this cluster; with one worker, too, where joblib would compute in this process instead."""
    from joblib._dask import DaskDistributedBackend  # registered by name only, and a name takes no subclass

    class Cluster(DaskDistributedBackend):  # type: ignore[misc]
        def effective_n_jobs(self, n_jobs: int) -> int:
            """Calls under way: one a worker, at least two."""
            return max(2, int(super().effective_n_jobs(n_jobs)))

    return Cluster(client=client, wait_for_workers_timeout=CONNECT_S)


def _require_one_thread(client: Any) -> None:
    """A method seeds its library's one generator: two at a time in a process would draw from each other's."""
    threads = {name: n for name, n in client.nthreads().items() if n != 1}
    if threads:
        name, n = next(iter(threads.items()))
        raise StudyError(
            f"--scheduler: expected workers with one thread each, got {len(threads)} with more, as {name} with {n}; "
            "start them with `dask worker --nthreads 1 --nworkers CORES`"
        )


def packed(call: tuple[Any, ...]) -> bytes:
    """A call as bytes, which travel with the task: data laid on one worker would be lost with it."""
    return bytes(pickle.dumps(call))


def unpacked(content: bytes) -> tuple[Any, ...]:
    """The call that `packed` made so."""
    return tuple(pickle.loads(content))


def arithmetic_of_now() -> tuple[tuple[str, str], ...]:
    """What decides the last bits of a number, in a form that travels."""
    return tuple(sorted((name, str(value)) for name, value in arithmetic().items()))


@cache
def require_same_arithmetic(expected: tuple[tuple[str, str], ...]) -> None:
    """Refuse to compute where code, versions or processor are not those of the process that asked.

    Raises:
        StudyError: what differs.
    """
    got = dict(arithmetic_of_now())
    for name, value in expected:
        if got.get(name) != value:
            raise StudyError(
                f"--scheduler: expected workers with the {name} of this process, {value}, got {got.get(name)} on "
                f"{platform.node()}; install the same there, or start the run on a machine like them"
            )
