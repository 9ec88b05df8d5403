"""The one atomic writer and the one hash: a file is there whole or not at all, whatever kills the run."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np


@contextmanager
def replacing(path: Path, *, alone: bool = False) -> Iterator[Path]:
    """A temporary path beside ``path`` for the block to write; it takes the name only if the block ends well.

    Missing folders are made. The temporary name ends as ``path`` does, for writers that choose a format by it.

    Args:
        path: what the file will be called; an older one stays until the end.
        alone: no other process can be writing this file, so the temporary name is the same every time, and what a
            killed run left behind is overwritten.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".half.{path.name}" if alone else f".half-{os.getpid()}.{path.name}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def filling(folder: Path, names: Collection[str], last: str) -> Iterator[Path]:
    """A temporary folder for the block to fill; if it ends well, its files replace those called ``names`` there.

    A file of those names that the block did not write is removed; any other file in the folder stays. ``last`` goes
    first and comes last: where it is, all the others are, and are of the same writing.

    Args:
        folder: where the files will be; made if it is not there.
        names: of all files that the block may write.
        last: one of them.
    """
    folder = folder.resolve()
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".half-{os.getpid()}.{folder.name}")
    try:
        temporary.mkdir()
        yield temporary
        folder.mkdir(exist_ok=True)
        for name in (last, *(name for name in names if name != last)):
            (folder / name).unlink(missing_ok=True)
        for path in sorted(temporary.iterdir(), key=lambda path: (path.name == last, path.name)):
            path.replace(folder / path.name)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file through a temporary one; see `replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 with LF; see `replacing`."""
    write_bytes(path, text.encode())


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write `json_text` of ``content``; see `replacing`."""
    write_text(path, json_text(content))


def json_text(content: Mapping[str, Any]) -> str:
    """JSON with sorted keys, two spaces a level and a last LF; numpy values, paths and dataclasses are taken apart.

    Raises:
        ValueError: NaN or infinity, which JSON has not.
        TypeError: a value of another type.
    """
    return json.dumps(content, indent=2, sort_keys=True, allow_nan=False, default=_plain) + "\n"


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    return digest_of(path, "sha256")


def digest_of(path: Path, algorithm: str) -> str:
    """Hexadecimal digest of a file by any algorithm of `hashlib`."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, algorithm).hexdigest()


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Path):
        return value.as_posix()
    raise TypeError(f"cannot write {type(value).__name__} as JSON")
