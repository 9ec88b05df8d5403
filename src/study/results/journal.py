"""Finished work of a run, kept line by line: what was done stays done, whatever ends the process."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from study.files.atomic import json_text


class Journal:
    """What has been finished, each piece under the hash of everything that decides it.

    A piece made by other code, from other files or with other parameters has another hash, so it is never found. A line
    is on the disk before the next piece is begun, and carries a hash of its own: of a line that was cut by a kill, and
    of what follows a damaged one, nothing is believed.
    """

    def __init__(self, path: Path | None, basis: Mapping[str, Any]) -> None:
        """Read what is there.

        Args:
            path: JSON lines; None to keep nothing beyond this process.
            basis: what decides every piece: code, versions, seed, parameters.
        """
        self._path = path
        self._basis = json_text(basis)
        self._pieces: dict[str, Mapping[str, Any]] = {}
        if path is None or not path.exists():
            return
        content, whole = path.read_bytes(), 0
        for line, key, piece in _pieces(content):
            self._pieces[key] = piece
            whole += len(line)
        if whole < len(content):
            os.truncate(path, whole)

    def get(self, facts: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """What was kept of the piece that these facts decide; None when it is still to do."""
        return self._pieces.get(self._key(facts))

    def keep(self, facts: Mapping[str, Any], piece: Mapping[str, Any]) -> None:
        """Keep a finished piece: JSON, finite numbers in full precision. What is kept already stays as it is."""
        key = self._key(facts)
        if key in self._pieces:
            return
        self._pieces[key] = piece
        if self._path is None:
            return
        text = json.dumps({"key": key, "facts": facts, "piece": piece}, allow_nan=False)
        with self._path.open("ab") as file:
            file.write(f"{_sha256(text.encode())} {text}\n".encode())
            file.flush()
            os.fsync(file.fileno())

    def _key(self, facts: Mapping[str, Any]) -> str:
        return _sha256((self._basis + json_text(facts)).encode())


def _pieces(content: bytes) -> Iterator[tuple[bytes, str, Mapping[str, Any]]]:
    """Whole lines with their key and piece, up to the first that is not whole."""
    for line in content.splitlines(keepends=True):
        digest, _, text = line.partition(b" ")
        if not line.endswith(b"\n") or _sha256(text[:-1]) != digest.decode("ascii", "replace"):
            return
        record = json.loads(text)
        yield line, record["key"], record["piece"]


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
