"""The data folder: where every file is, what it must hash to, and whether it does; nothing here is fetched."""

from __future__ import annotations

import fcntl
import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import date
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pandas as pd
import yaml
from platformdirs import user_cache_path
from tqdm import tqdm

from study.data.archive import check_packed_whole
from study.data.schema import DataFile, LocalSource, Manifest, PypiSource, ZipSource
from study.data.web import shown
from study.errors import StudyError
from study.files.atomic import digest_of, sha256_of, write_text
from study.files.yaml_text import located, read_yaml, repeated_keys

LOCK_NAME = "data_lock.yaml"
YAML_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the lock file is rewritten once per file of a cohort
COLUMNS = ("dataset", "subject", "role", "file", "status", "bytes", "source", "licence", "title", "path")


def data_dir() -> Path:
    """The data folder: ``STUDY_DATA_DIR``, else the platform's cache folder."""
    chosen = os.environ.get("STUDY_DATA_DIR", "").strip()
    return Path(chosen).expanduser().absolute() if chosen else user_cache_path("study", appauthor=False) / "data"


def path_of(file: DataFile) -> Path:
    """Where a file is, or will be once it is fetched."""
    source = file.source
    match source:
        case PypiSource():
            return data_dir() / "members" / f"{source.archive}-{source.sha256[:8]}" / source.member
        case ZipSource():
            name = f"{_archive_name(source)}-{hashlib.sha256(source.url.encode()).hexdigest()[:8]}"
            return data_dir() / "members" / name / source.member
        case LocalSource():
            own = local_path(file)
            if source.member is None:
                return own
            name = f"{own.name}-{hashlib.sha256(str(own).encode()).hexdigest()[:8]}"
            return data_dir() / "members" / name / source.member


def status(file: DataFile) -> str:
    """``ready``, ``absent``, ``partly fetched``, ``wrong size`` or ``to be put in place``; hashes are not read."""
    path = path_of(file)
    if path.exists():
        return "wrong size" if file.bytes and path.is_file() and path.stat().st_size != file.bytes else "ready"
    if isinstance(file.source, LocalSource):
        return "absent" if local_path(file).exists() else "to be put in place"
    parts = [*path.parent.glob(f"{path.name}.*.part")]
    if isinstance(file.source, PypiSource):
        parts.append(archive_part(archive_path(file.source)))
    return "partly fetched" if any(part.exists() for part in parts) else "absent"


def verify(file: DataFile) -> Path:
    """The path of a file that is there and matches; nothing is fetched.

    Raises:
        StudyError: absent, or not what the manifest or the lock file says; a bad file of the data folder is removed.
    """
    path = path_of(file)
    if not path.exists():
        raise StudyError(f"{file.key}: expected a file at {path}, got none; run `study data fetch`")
    fault = fault_of(file, path)
    if fault is None:
        return path
    if isinstance(file.source, LocalSource) and file.source.member is None:
        raise StudyError(f"{fault}; put the right file there or correct the manifest")
    path.unlink()
    raise StudyError(f"{fault}; the bad file was removed, fetch it again")


def data_list(manifest: Manifest, dataset: str | None = None) -> pd.DataFrame:
    """Every file of a cohort (or of all) with its source, licence and status, one row each, see `COLUMNS`."""
    return _table(manifest, dataset, status)


def verify_all(manifest: Manifest, dataset: str | None = None) -> pd.DataFrame:
    """Read every file of a cohort (or of all) against its hash; ``status`` is ``verified`` or what is wrong.

    A bad file of the data folder is removed.
    """

    def check(file: DataFile) -> str:
        try:
            verify(file)
        except StudyError as error:
            return str(error)
        return "verified"

    return _table(manifest, dataset, check)


def _table(manifest: Manifest, dataset: str | None, state: Callable[[DataFile], str]) -> pd.DataFrame:
    rows = []
    for name in [dataset] if dataset is not None else list(manifest.cohorts):
        for key, subject in manifest.cohort(name).subjects.items():
            for file in manifest.files_of_subject(subject):
                source = file.source
                match source:
                    case PypiSource():
                        origin = f"{source.project} {source.version}"
                    case ZipSource():
                        origin = shown(source.url)
                    case LocalSource():
                        origin = source.path
                known = (file.bytes, origin, file.licence or "", file.title or "", str(path_of(file)))
                rows.append((name, key, file.role, file.key, state(file), *known))
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype({"bytes": "Int64"})


def is_good(file: DataFile) -> bool:
    """Whether a file is there and, read whole, is what it should be."""
    path = path_of(file)
    return path.exists() and fault_of(file, path) is None


def fault_of(file: DataFile, path: Path) -> str | None:
    """What is wrong with an existing file, or None."""
    sha256, recorded = known_sha256(file)
    by_hand = isinstance(file.source, LocalSource) and file.source.member is None
    if path.is_dir():
        wrong = not by_hand or sha256 is not None
        return f"{file.key}: expected a file, got the folder {path}" if wrong else None
    if file.bytes is not None and path.stat().st_size != file.bytes:
        return f"{file.key}: expected {file.bytes} bytes, got {path.stat().st_size} in {path}"
    if sha256 is None:
        return None if by_hand else f"{file.key}: expected its sha256 in {LOCK_NAME}, got no entry for {path}"
    got = sha256_of(path)
    since = f" (recorded on {recorded} in {LOCK_NAME})" if recorded else ""
    return None if got == sha256 else f"{file.key}: expected sha256 {sha256}{since}, got {got} in {path}"


def missing_local(file: DataFile) -> str:
    """What to tell of a file that is not there: what to download and where to put it."""
    if not isinstance(file.source, LocalSource):
        return f"{file.key}: not fetched yet"
    path = local_path(file)
    advice = file.source.instructions or "put it there or correct `path` in the manifest"
    return f"{file.key}: expected {path}, got no such file; {advice.strip()}"


def check_archive(path: Path, n_bytes: int | None, sha256: str | None, md5: str | None) -> None:
    """An archive is the one the manifest means, as far as that states its size and hashes; else it is sound.

    Raises:
        StudyError: another size or hash, or, where no hash is stated, a checksum of its own that does not match.
    """
    stamp = path.stat()
    if sha256 is None and md5 is None:
        _check_packed(path, stamp.st_mtime_ns, stamp.st_size)
    if n_bytes is not None and stamp.st_size != n_bytes:
        raise StudyError(f"{path.name}: expected {n_bytes} bytes, got {stamp.st_size}")
    for algorithm, expected in (("sha256", sha256), ("md5", md5)):
        if expected and (got := _digest(path, algorithm, stamp.st_mtime_ns, stamp.st_size)) != expected:
            raise StudyError(f"{path.name}: expected {algorithm} {expected}, got {got}")


def known_sha256(file: DataFile) -> tuple[str | None, str]:
    """What the file must hash to (None if nobody has said), and, if the lock file says it, since when.

    Raises:
        StudyError: a lock file that cannot be read.
    """
    if isinstance(file.source, LocalSource) and file.source.member is None:
        return file.source.sha256 or file.sha256, ""
    if file.sha256:
        return file.sha256, ""
    entry = _lock().get(_lock_key(path_of(file)), {})
    return entry.get("sha256"), entry.get("recorded", "")


def record(path: Path, sha256: str) -> None:
    """Hold later fetches of a file without a published hash to what came first."""
    entry = {"sha256": sha256, "bytes": path.stat().st_size, "recorded": date.today().isoformat()}
    text = yaml.dump(_lock() | {_lock_key(path): entry}, Dumper=YAML_DUMPER, sort_keys=True)
    write_text(data_dir() / LOCK_NAME, f"# Hashes of files whose source publishes none, as first fetched.\n{text}")


@contextmanager
def one_at_a_time() -> Iterator[None]:
    """Let one process at a time change the data folder; the lock goes with its process, however that ends.

    Raises:
        StudyError: a folder that cannot be written.
    """
    folder = data_dir()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / ".fetching").open("w") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                tqdm.write(f"waiting for another fetch into {folder}", file=sys.stderr)
                fcntl.flock(handle, fcntl.LOCK_EX)
            yield
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        path = Path(error.filename or folder)
        way = next((part for part in (path, *path.parents) if part.is_file()), path)
        raise StudyError(
            f"{folder}: expected a data folder that can be written, got another file or folder in the way at {way};"
            " move that away"
        ) from error
    except OSError as error:
        raise StudyError(
            f"{folder}: expected a data folder that can be written, got {error}; set STUDY_DATA_DIR to another"
        ) from error


def archive_path(source: PypiSource | ZipSource) -> Path:
    """Where a whole archive is kept, or is put by a user whose server has no byte ranges."""
    return data_dir() / "archives" / _archive_name(source)


def archive_part(archive: Path) -> Path:
    """The growing file of an archive's download."""
    return archive.with_name(archive.name + ".part")


def local_path(file: DataFile) -> Path:
    """Where a user's own file is: beside the manifest if it is there, else in the data folder."""
    assert isinstance(file.source, LocalSource)
    path = Path(file.source.path).expanduser()
    beside = (file.folder / path).absolute()
    return beside if path.is_absolute() or beside.exists() or not file.source.instructions else data_dir() / path


def _archive_name(source: PypiSource | ZipSource) -> str:
    return source.archive if isinstance(source, PypiSource) else Path(urlsplit(source.url).path).name


def _lock_key(path: Path) -> str:
    return path.relative_to(data_dir()).as_posix()


def _lock() -> dict[str, dict[str, Any]]:
    path = data_dir() / LOCK_NAME
    if not path.exists():
        return {}
    stamp = path.stat()
    return _read_lock(path, stamp.st_mtime_ns, stamp.st_ino)


@lru_cache(maxsize=1)
def _read_lock(path: Path, _mtime_ns: int, _inode: int) -> dict[str, dict[str, Any]]:
    """The lock file, parsed once per version: it is asked for every file of a cohort."""
    entries, root = read_yaml(path)
    if faults := repeated_keys(root):
        raise located(faults, root, str(path))
    entries = {} if entries is None else entries
    try:
        if all(isinstance(entry["sha256"], str) for entry in entries.values()):
            return dict(entries)
        raise TypeError("an entry without a sha256")
    except (AttributeError, TypeError, KeyError) as error:
        raise StudyError(f"{path}: expected file names with their sha256, got {error}; repair or delete it") from error


@lru_cache(maxsize=64)
def _check_packed(path: Path, _mtime_ns: int, _n_bytes: int) -> None:
    """Once per version and process, as `_digest`."""
    check_packed_whole(path)


@lru_cache(maxsize=64)
def _digest(path: Path, algorithm: str, _mtime_ns: int, _n_bytes: int) -> str:
    """Digest of a large archive, once per version and process: many members come out of one."""
    return digest_of(path, algorithm)
