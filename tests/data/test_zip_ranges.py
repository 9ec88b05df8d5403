from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from http_archive import (
    FAST,
    RANGE_BYTES,
    RIBFRAC_PATH,
    SCANS,
    ArchiveServer,
    Fault,
    Write,
    make_zip,
    noise,
    ribfrac_zip,
)

from study.data.fetch import fetch
from study.data.store import path_of, status
from study.data.web import USER_AGENT, Web
from study.errors import StudyError


def test_a_member_comes_by_ranges_and_the_rest_of_the_archive_stays_where_it_is(
    write: Write, server: ArchiveServer
) -> None:
    images = {number: noise(number) for number in SCANS}
    manifest = write(ribfrac_zip(images), "RibFrac461-image.nii.gz")
    path = fetch(manifest.file("ct"), web=FAST)
    assert path.read_bytes() == images[461]
    ranged = [request for request in server.requests if request.first is not None]
    assert len(ranged) == len(server.requests)
    data = ranged[1:]  # the first brings the directory
    assert sum(request.sent for request in data) < 1.01 * len(images[461])
    assert all(request.sent <= RANGE_BYTES for request in data)
    assert {request.user_agent for request in server.requests} == {USER_AGENT}
    n_before = len(server.requests)
    assert fetch(manifest.file("ct"), web=FAST) == path
    assert len(server.requests) == n_before


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize(
    "content", [b"", b"x", bytes(3_000_000), noise(1, 200_001)], ids=["empty", "1", "zeros", "noise"]
)
def test_stored_and_deflated_members_of_any_size(write: Write, method: int, content: bytes) -> None:
    manifest = write(make_zip({"first": b"1", "d/scan.nii.gz": content, "last": b"2"}, method), "scan.nii.gz")
    assert fetch(manifest.file("ct"), web=FAST).read_bytes() == content


def test_a_drop_inside_the_directory_is_retried(write: Write, server: ArchiveServer) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    server.faults.extend([Fault(cut_after=100), Fault(cut_after=0)])
    assert fetch(manifest.file("ct"), web=FAST).read_bytes() == noise(1)


def test_a_server_without_ranges_is_named_and_a_whole_archive_put_in_place_is_used(
    write: Write, server: ArchiveServer, folder: Path
) -> None:
    packed = ribfrac_zip({421: noise(1)})
    manifest = write(packed, "RibFrac421-image.nii.gz", archive_md5=hashlib.md5(packed).hexdigest())
    server.ranges = False
    with pytest.raises(StudyError, match=r"byte ranges, got the whole archive .*put it at .*ribfrac-val-images\.zip"):
        fetch(manifest.file("ct"), web=FAST)
    assert not list(folder.rglob("*.nii.gz"))
    (folder / "archives").mkdir()
    (folder / "archives" / "ribfrac-val-images.zip").write_bytes(packed[:-1] + b"!")
    with pytest.raises(StudyError, match=r"expected md5 [0-9a-f]{32}, got [0-9a-f]{32}"):
        fetch(manifest.file("ct"), web=FAST)
    assert (folder / "archives" / "ribfrac-val-images.zip").exists()  # gigabytes that a user fetched are not deleted
    (folder / "archives" / "ribfrac-val-images.zip").write_bytes(packed)
    assert fetch(manifest.file("ct"), web=FAST).read_bytes() == noise(1)


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_flipped_byte_is_refused_and_nothing_is_left(
    write: Write, server: ArchiveServer, folder: Path, method: int
) -> None:
    packed = bytearray(make_zip({"RibFrac421-image.nii.gz": noise(1)}, method))
    good = bytes(packed)
    packed[150_000] ^= 1
    manifest = write(bytes(packed), "RibFrac421-image.nii.gz")
    with pytest.raises(StudyError, match=r"expected (CRC-32 [0-9a-f]{8}, got [0-9a-f]{8}|deflated data|300000 bytes)"):
        fetch(manifest.file("ct"), web=FAST)
    assert not [path for path in folder.rglob("*") if path.is_file() and path.name != ".fetching"]
    server.files[RIBFRAC_PATH] = good
    assert fetch(manifest.file("ct"), web=FAST).read_bytes() == noise(1)


def test_an_archive_of_another_size_or_kind_is_refused(write: Write) -> None:
    packed = ribfrac_zip({421: noise(1)})
    with pytest.raises(StudyError, match=rf"expected an archive of 7 bytes, got {len(packed)}"):
        fetch(write(packed, "RibFrac421-image.nii.gz", archive_bytes=7).file("ct"), web=FAST)
    with pytest.raises(StudyError, match="expected a zip archive"):
        fetch(write(noise(2), "RibFrac421-image.nii.gz").file("ct"), web=FAST)
    with pytest.raises(StudyError, match="expected CRC-32 00000000, got"):
        fetch(write(packed, "RibFrac421-image.nii.gz", crc32="0" * 8).file("ct"), web=FAST)
    with pytest.raises(StudyError, match=r"expected sha256 0{64}, got [0-9a-f]{64}"):
        fetch(write(packed, "RibFrac421-image.nii.gz", file={"sha256": "0" * 64}).file("ct"), web=FAST)


KILLED = """
import sys
from study.data.fetch import fetch
from study.data.manifest import load_manifest
from study.data.web import Web
fetch(load_manifest(sys.argv[1]).file("ct"), web=Web(range_bytes=1 << 16))
"""


def test_a_killed_fetch_goes_on_where_it_stopped(write: Write, server: ArchiveServer, folder: Path) -> None:
    content = noise(9, 600_000)
    manifest = write(ribfrac_zip({421: content, 422: noise(10)}), "RibFrac421-image.nii.gz")
    server.seconds_per_block = 0.05
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(manifest.path)], env=os.environ.copy())
    try:
        deadline = time.monotonic() + 30
        while not any(path.stat().st_size > 150_000 for path in folder.rglob("*.part")):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    part = next(folder.rglob("*.part"))
    kept = part.stat().st_size
    assert not path_of(manifest.file("ct")).exists()
    assert status(manifest.file("ct")) == "partly fetched"
    server.seconds_per_block = 0
    web = replace(FAST)  # a session of its own
    web.session.headers["User-Agent"] = "second fetch"  # the killed one's last request may be answered later still
    path = fetch(manifest.file("ct"), web=web)
    assert hashlib.sha256(path.read_bytes()).digest() == hashlib.sha256(content).digest()
    _directory, *again = [request for request in server.requests if request.user_agent == "second fetch"]
    assert again[0].first == kept  # the member stands first in the archive
    assert sum(request.sent for request in again) < len(content) + 1_000 - kept
    assert not list(folder.rglob("*.part"))


def test_an_interrupted_fetch_keeps_what_it_has(write: Write, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    with monkeypatch.context() as patch:
        patch.setattr(Web, "_append", _interrupt_after(Web._append, 2))
        with pytest.raises(KeyboardInterrupt):
            fetch(manifest.file("ct"), web=FAST)
    assert next(folder.rglob("*.part")).stat().st_size == 2 * RANGE_BYTES
    assert fetch(manifest.file("ct"), web=FAST).read_bytes() == noise(1)


def test_a_part_of_another_version_is_not_continued(
    write: Write, server: ArchiveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    with monkeypatch.context() as patch:
        patch.setattr(Web, "_append", _interrupt_after(Web._append, 2))
        with pytest.raises(KeyboardInterrupt):
            fetch(manifest.file("ct"), web=FAST)
    server.files[RIBFRAC_PATH] = ribfrac_zip({421: noise(2)})
    assert fetch(manifest.file("ct"), web=FAST).read_bytes() == noise(2)


def _interrupt_after(append: Callable[..., None], n_calls: int) -> Callable[..., None]:
    calls = []

    def interrupted(*args: object, **kwargs: object) -> None:
        calls.append(1)
        if len(calls) > n_calls:
            raise KeyboardInterrupt
        append(*args, **kwargs)

    return interrupted
