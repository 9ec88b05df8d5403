"""The sole right to write a run's folder: a lock, a hidden folder beside it, and the swap of the old for the new."""

from __future__ import annotations

import fcntl
import json
import os
import platform
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from study.errors import StudyError
from study.results.clouds import CLOUDS

PROVENANCE = "provenance.json"
# What versions up to 0.3.0 wrote into a run's folder: their provenance does not list it.
_OLDER = re.compile(
    r"(metrics|timings)\.csv|provenance\.json|hd_(table.*|all_pairs)\.(csv|md|tex)"
    r"|(hausdorff|judges|surface_distance|waypoints)\.png"
)


@dataclass(frozen=True)
class Claim:
    """A run's folder that nobody else may write for now.

    Attributes:
        folder: the run's, absolute; there or not.
        beside: a hidden folder next to it, on the same disk, for what is not finished.
    """

    folder: Path
    beside: Path

    @property
    def journal(self) -> Path:
        """Where finished cases are kept until the run is whole."""
        return self.beside / "finished.jsonl"

    def new(self) -> Path:
        """An empty folder to write the whole run into, before `swap_in`."""
        new = self.beside / "new"
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir()
        return new

    def swap_in(self) -> None:
        """Put what was written into `new` in the place of the folder; files that `study` did not write stay in it.

        Raises:
            StudyError: a file of somebody else's has the name of one of the run's.
        """
        new, old = self.beside / "new", self.beside / "old"
        if self.folder.exists():
            _carry_over(self.folder, new)
            shutil.copymode(self.folder, new)
        for path in (*new.iterdir(), new):  # all of it is on the disk before any of it counts
            _sync(path)
        if self.folder.exists():
            self.folder.rename(old)
        new.rename(self.folder)
        _sync(self.folder.parent)


@contextmanager
def claimed(folder: Path, *, wait: bool = False) -> Iterator[Claim]:
    """Hold the right to write a run's folder; what a killed writer left half done is put right first.

    The lock is the operating system's, so that of a process that has died is free. Finished cases outlive the block
    when it ends in an exception; otherwise nothing is left beside the folder.

    Args:
        folder: of a run; made by the swap.
        wait: for another writer to end, instead of being refused.

    Raises:
        StudyError: another writer, a folder that `study` did not make, or one that cannot be swapped.
    """
    folder = folder.resolve()
    _require_swappable(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    claim = Claim(folder, folder.with_name(f".{folder.name}.unfinished"))
    with _locked(claim, wait):
        try:
            _put_back(claim)
            require_made_by_study(folder)
            yield claim
        except BaseException:
            _put_back(claim)
            shutil.rmtree(claim.beside / "new", ignore_errors=True)
            if not claim.journal.exists():
                shutil.rmtree(claim.beside, ignore_errors=True)
            raise
        shutil.rmtree(claim.beside, ignore_errors=True)


def _require_swappable(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise StudyError(f"expected a folder for the run, got the file {folder}; name another folder")
    if folder.is_mount() or Path.cwd().is_relative_to(folder):
        raise StudyError(
            f"{folder}: expected a folder that a finished run can be put in place of, got one that is mounted or that "
            "holds the current folder; name a folder below it"
        )


@contextmanager
def _locked(claim: Claim, wait: bool) -> Iterator[None]:
    path = claim.beside / "lock"
    while True:
        claim.beside.mkdir(exist_ok=True)
        try:
            file = path.open("a+", encoding="utf-8")
        except FileNotFoundError:  # the last writer has just cleared up
            continue
        with file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except BlockingIOError as error:
                file.seek(0)
                raise StudyError(
                    f"{claim.folder}: expected to be its only writer, got another: {file.read() or 'just started'}; "
                    "wait for it to end or name another folder"
                ) from error
            if not _is(path, file.fileno()):  # cleared up between opening and locking
                continue
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()} since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC")
            file.flush()
            yield
            return


def _is(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _put_back(claim: Claim) -> None:
    """Undo half a swap: the old folder is moved away and the new one is not there yet."""
    old = claim.beside / "old"
    if old.exists() and not claim.folder.exists():
        old.rename(claim.folder)
    shutil.rmtree(old, ignore_errors=True)


def own_files(folder: Path) -> set[str] | None:
    """Names of the files in a folder that `study` wrote; None of a folder that it did not make."""
    try:
        record = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(record, dict) or "code_sha256" not in record:
        return None
    files = record.get("files_sha256")
    if isinstance(files, dict):
        return {PROVENANCE, CLOUDS, *files}
    return {path.name for path in folder.iterdir() if _OLDER.fullmatch(path.name)}


def require_made_by_study(folder: Path) -> None:
    """Refuse a folder that holds something and is no run.

    Raises:
        StudyError: that folder.
    """
    if not folder.exists() or own_files(folder) is not None:
        return
    found = sorted(path.name for path in folder.iterdir())
    if found:
        names = ", ".join(found[:3]) + (f" and {len(found) - 3} more" if len(found) > 3 else "")
        raise StudyError(
            f"{folder}: expected a new folder or one that `study run` made, got {names} without its {PROVENANCE}; "
            "name another folder"
        )


def _carry_over(folder: Path, new: Path) -> None:
    """Give everything in a folder that `study` did not write a second name in the new one."""
    own = own_files(folder) or set()
    for path in folder.iterdir():
        if path.name in own:
            continue
        target = new / path.name
        if target.exists():
            raise StudyError(f"{path}: expected no file of that name, which the run writes, got one; move it away")
        if path.is_dir() and not path.is_symlink():
            shutil.copytree(path, target, symlinks=True, copy_function=_link)
        else:
            _link(path, target)


def _link(source: str | Path, target: str | Path) -> None:
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:  # a file system without hard links
        shutil.copy2(source, target, follow_symlinks=False)


def _sync(path: Path) -> None:
    """Have a file's or a folder's content on the disk, whatever happens to the power."""
    if path.is_symlink() or not (path.is_dir() or path.is_file()):
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
