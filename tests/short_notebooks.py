"""A process that executes a folder of notebooks in children that it kills; `tests/batch/test_notebooks.py` starts it.

``python short_notebooks.py FOLDER N`` forks a child that executes the notebooks into ``FOLDER/out`` and kills it, N
times, each time when one more notebook has ended; then it lets one child end. It prints ``killed`` or ``done``.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

from study.batch.notebooks import plan, run_notebooks
from study.batch.papermills import find_notebooks


def main(folder: Path, n_kills: int) -> None:
    for life in range(n_kills + 1):
        number = os.fork()
        if number == 0:
            ended = run_notebooks(plan(find_notebooks(folder), {}), folder / "out")
            os._exit(any(one.fault for one in ended))
        while life < n_kills and len(list(folder.glob("out/*.ipynb"))) <= life and not _has_ended(number):
            time.sleep(0.005)
        if life < n_kills:
            os.kill(number, signal.SIGKILL)
        _, status = os.waitpid(number, 0)
        print("killed" if os.WIFSIGNALED(status) else "done" if status == 0 else "failed", flush=True)


def _has_ended(number: int) -> bool:
    return os.waitid(os.P_PID, number, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
