"""How far a batch of notebooks is: one bar over all their cells, and a line for each that ends."""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping
from types import TracebackType

from tqdm import tqdm

from study.batch.workers import bar_interval_s

LONGEST = 100  # characters of what a notebook says of itself


class Told:
    """A bar that several threads move."""

    def __init__(self, cells: Mapping[str, int], show: bool) -> None:
        """Begin at nothing.

        Args:
            cells: code cells of each notebook, by name.
            show: False to stay silent.
        """
        self._cells = dict(cells)
        self._show = show
        self._running: dict[str, tuple[int, str]] = {}
        self._n_ended = 0
        self._lock = threading.Lock()

    def __enter__(self) -> Told:
        """Show the bar."""
        self._bar = tqdm(
            total=sum(self._cells.values()),
            bar_format="{n_fmt} of {total_fmt} cells |{bar:12}| {elapsed} {desc}",
            mininterval=bar_interval_s(),
            disable=not self._show,
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the bar as it stands."""
        self._bar.close()

    def cell(self, name: str, number: int) -> None:
        """A notebook has begun its cell ``number``, from 1."""
        with self._lock:
            before = self._running.get(name, (1, ""))[0]
            self._running[name] = (number, "")
            self._draw(number - before)

    def line(self, name: str, text: str) -> None:
        """A notebook has written a line on standard error."""
        with self._lock:
            self._running[name] = (self._running.get(name, (1, ""))[0], text[:LONGEST])
            self._draw(0)

    def end(self, name: str, seconds: float, fault: str, kept: bool) -> None:
        """A notebook has ended."""
        with self._lock:
            reached = self._running.pop(name, (1, ""))[0]
            self._n_ended += 1
            self._draw(self._cells[name] - reached + 1)
            what = "kept as it was" if kept else f"{seconds:.0f} s{', failed' if fault else ''}"
            if self._show:
                tqdm.write(f"notebook {self._n_ended} of {len(self._cells)}: {name}, {what}", file=sys.stderr)

    def _draw(self, n_cells: int) -> None:
        """Move the bar, whose end says what each running notebook does; draw it when it is time to."""
        told = [
            f"{name} cell {number} of {self._cells[name]}{f' ({text})' if text else ''}"
            for name, (number, text) in self._running.items()
        ]
        self._bar.set_description_str("; ".join(told), refresh=False)
        self._bar.update(n_cells)
