from __future__ import annotations

import hashlib
import io
import os
import signal
import stat
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import yaml
from http_archive import (
    RIBFRAC_PATH,
    TOTALSEGMENTATOR_PATH,
    ArchiveServer,
    Fault,
    make_zip,
    rebased_manifest,
    ribfrac_zip,
    ribseg_zip,
    totalsegmentator_zip,
)
from pypi_simple import PYPI_SIMPLE_ENDPOINT

from study.data import fetch as fetching
from study.data.fetch import data_dir, data_list, fetch, fetch_all, path_of, status, verify, verify_all
from study.data.manifest import Manifest, load_manifest
from study.data.pypi import index_url
from study.data.web import USER_AGENT, Web
from study.errors import StudyError

RANGE_BYTES = 1 << 16
FAST = Web(attempts=4, backoff_s=0.001, range_bytes=RANGE_BYTES, timeout_s=5)
SCANS = (421, 441, 461, 481, 500)


def noise(seed: int, n_bytes: int = 300_000) -> bytes:
    """Incompressible, as a .nii.gz is."""
    return np.random.default_rng(seed).bytes(n_bytes)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("STUDY_DATA_DIR", str(tmp_path / "data"))
    for variable in ("HTTP_PROXY", "HTTPS_PROXY", "http_proxy", "https_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(variable, raising=False)
    return tmp_path / "data"


@pytest.fixture
def server() -> Iterator[ArchiveServer]:
    with ArchiveServer() as running:
        yield running


Write = Callable[..., Manifest]


@pytest.fixture
def write(tmp_path: Path, server: ArchiveServer) -> Write:
    """Serve a zip and describe one of its members, with whatever else the test says of it."""

    def make(packed: bytes, member: str, *, file: dict | None = None, **source: object) -> Manifest:
        server.files[RIBFRAC_PATH] = packed
        described = {"kind": "zip", "url": server.url + RIBFRAC_PATH, "member": member} | source
        return manifest_of(tmp_path, {"source": described} | (file or {}))

    return make


def manifest_of(tmp_path: Path, file: dict) -> Manifest:
    ct = {"role": "ct", "title": "a scan", "licence": "CC0", "citation": "nobody"} | file
    raw = {"files": {"ct": ct}, "cohorts": {"one": {"subjects": {"a": {"ct": "ct", "landmarks": "a.yaml"}}}}}
    path = tmp_path / "my_manifest.yaml"
    path.write_text(yaml.safe_dump(raw), encoding="utf-8")
    return load_manifest(path)


# --- members of remote zips -----------------------------------------------------------------------------------------


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


def test_the_whole_ribseg_cohort(tmp_path: Path, server: ArchiveServer, folder: Path) -> None:
    images = {number: noise(number) for number in SCANS}
    labels = {number: noise(-number % 997, 5_000) for number in SCANS}
    server.files[RIBFRAC_PATH] = ribfrac_zip(images, folder="another-folder/")
    packed = ribseg_zip(labels)
    path = rebased_manifest(
        tmp_path / "m.yaml", server.url, keep=["ribseg"], ribseg_sha256=hashlib.sha256(packed).hexdigest()
    )
    manifest = load_manifest(path)
    with pytest.raises(StudyError, match=r"expected .*ribseg_v2\.zip, got no such file; .*drive\.google\.com"):
        fetch_all(manifest, "ribseg", progress=False, web=FAST)
    assert server.requests == []  # what must be done by hand is said before gigabytes are fetched
    folder.mkdir(exist_ok=True)
    (folder / "ribseg_v2.zip").write_bytes(packed)
    paths = fetch_all(manifest, "ribseg", progress=False, web=FAST)
    assert len(paths) == 10
    assert {number: paths[f"ribfrac{number}_ct"].read_bytes() for number in SCANS} == images
    assert {number: paths[f"ribseg{number}_ribs"].read_bytes() for number in SCANS} == labels
    assert set(verify_all(manifest, "ribseg")["status"]) == {"verified"}


def test_the_whole_totalsegmentator_cohort(tmp_path: Path, server: ArchiveServer) -> None:
    manifest = load_manifest(rebased_manifest(tmp_path / "m.yaml", server.url, keep=["totalsegmentator"]))
    names = list(manifest.label_map("totalsegmentator_v2").values())
    subjects = {
        subject: (noise(i, 50_000), {name: f"{subject} {name}".encode() for name in names})
        for i, subject in enumerate(manifest.cohort("totalsegmentator").subjects)
    }
    server.files[TOTALSEGMENTATOR_PATH] = totalsegmentator_zip(subjects)
    paths = fetch_all(manifest, "totalsegmentator", progress=False, web=FAST)
    assert len(paths) == 3 * (1 + 26)
    for key, subject in manifest.cohort("totalsegmentator").subjects.items():
        assert subject.ct
        assert subject.labels
        assert paths[subject.ct].read_bytes() == subjects[key][0]
        masks = manifest.masks(subject.labels)
        assert {manifest.label_map("totalsegmentator_v2")[label] for label in masks} == set(names)
        for label, file in masks.items():
            assert fetch(file).read_bytes() == f"{key} {manifest.label_map('totalsegmentator_v2')[label]}".encode()
    assert len(server.requests) <= len(paths) + 2  # one request a member: tiny ranges meet the rate limit


def test_a_dropped_line_is_taken_up_where_it_broke(write: Write, server: ArchiveServer) -> None:
    content = noise(5, 500_000)
    manifest = write(ribfrac_zip({421: content}), "RibFrac421-image.nii.gz")
    server.faults.extend([Fault(), Fault(cut_after=20_000), Fault(cut_after=0), Fault(cut_after=1), Fault()])
    path = fetch(manifest.file("ct"), web=FAST)
    assert path.read_bytes() == content
    data = server.requests[1:]
    assert data[1].first == data[0].first + 20_000
    assert sum(request.sent for request in data) < len(content) + 1_000


def test_a_drop_inside_the_directory_is_retried(write: Write, server: ArchiveServer) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    server.faults.extend([Fault(cut_after=100), Fault(cut_after=0)])
    assert fetch(manifest.file("ct"), web=FAST).read_bytes() == noise(1)


def test_busy_answers_are_waited_for(write: Write, server: ArchiveServer) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    server.faults.extend([Fault(status=503), Fault(), Fault(status=429, retry_after="1"), Fault(status=500)])
    start = time.monotonic()
    assert fetch(manifest.file("ct"), web=FAST).read_bytes() == noise(1)
    assert 1 <= time.monotonic() - start < 4  # the server's second, not our thousandth
    assert not server.faults


@pytest.mark.parametrize("fault", [Fault(status=503), Fault(status=429, retry_after="0"), Fault(cut_after=0)])
def test_tries_are_bounded_and_the_error_says_what_to_do(write: Write, server: ArchiveServer, fault: Fault) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    server.faults.extend([Fault(), *[fault] * 100])
    with pytest.raises(StudyError, match=r"expected .*, got .*(try again|run the same command|check the network)"):
        fetch(manifest.file("ct"), web=FAST)
    assert len(server.requests) <= 1 + FAST.attempts**2


def test_a_slow_server_is_waited_for(write: Write, server: ArchiveServer) -> None:
    manifest = write(ribfrac_zip({421: noise(1, 100_000)}), "RibFrac421-image.nii.gz")
    server.seconds_per_block = 0.02
    assert fetch(manifest.file("ct"), web=FAST).read_bytes() == noise(1, 100_000)


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


def test_members_that_leave_the_folder_are_refused(write: Write, folder: Path) -> None:
    for name in ("../x.nii.gz", "/etc/x.nii.gz", "a/../../x.nii.gz", "..\\x/x.nii.gz"):
        manifest = write(make_zip({name: b"evil", "good": b"good"}), "x.nii.gz")
        with pytest.raises(StudyError, match="the archive is not safe"):
            fetch(manifest.file("ct"), web=FAST)
    assert not list(folder.parent.rglob("x.nii.gz"))


def test_links_are_refused(write: Write) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        link = zipfile.ZipInfo("x.nii.gz")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(StudyError, match="link"):
        fetch(write(packed.getvalue(), "x.nii.gz").file("ct"), web=FAST)


@pytest.mark.parametrize(
    ("members", "wanted"),
    [(["b.nii.gz"], "a.nii.gz"), (["s2/ct.nii.gz"], "s1/ct.nii.gz"), (["s1/ct.nii.gz", "s2/ct.nii.gz"], "ct.nii.gz")],
)
def test_a_missing_or_ambiguous_member_is_never_guessed(write: Write, members: list[str], wanted: str) -> None:
    manifest = write(make_zip(dict.fromkeys(members, b"x")), wanted)
    with pytest.raises(StudyError, match=r"expected one member .*, got [02] among"):
        fetch(manifest.file("ct"), web=FAST)


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


def test_a_missing_archive_says_so_at_once(write: Write, server: ArchiveServer) -> None:
    manifest = write(ribfrac_zip({421: b"x"}), "RibFrac421-image.nii.gz")
    server.files.clear()
    with pytest.raises(StudyError, match="404"):
        fetch(manifest.file("ct"), web=FAST)
    assert len(server.requests) == 1


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
    n_before = len(server.requests)
    path = fetch(manifest.file("ct"), web=FAST)
    assert hashlib.sha256(path.read_bytes()).digest() == hashlib.sha256(content).digest()
    again = [request for request in server.requests[n_before:] if request.path == RIBFRAC_PATH][1:]
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


# --- the lock file --------------------------------------------------------------------------------------------------


def test_the_first_fetch_sets_the_hash_and_later_ones_are_held_to_it(
    write: Write, server: ArchiveServer, folder: Path
) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    file = manifest.file("ct")
    path = fetch(file, web=FAST)
    (entry,) = yaml.safe_load((folder / "data_lock.yaml").read_text(encoding="utf-8")).values()
    assert entry["sha256"] == hashlib.sha256(noise(1)).hexdigest()
    path.unlink()
    server.files[RIBFRAC_PATH] = ribfrac_zip({421: noise(2)})
    with pytest.raises(StudyError, match=rf"expected sha256 {entry['sha256']}, got .*recorded on .*data_lock\.yaml"):
        fetch(file, web=FAST)
    assert not path.exists()
    (folder / "data_lock.yaml").unlink()
    assert fetch(file, web=FAST).read_bytes() == noise(2)


def test_a_broken_lock_file_is_named(write: Write, folder: Path) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    folder.mkdir(exist_ok=True)
    for text in ("[1", "- a", "a: 1", "a: {sha256: 1}"):
        (folder / "data_lock.yaml").write_text(text)
        with pytest.raises(StudyError, match=r"data_lock\.yaml: expected"):
            fetch(manifest.file("ct"), web=FAST)


# --- the data folder ------------------------------------------------------------------------------------------------


def test_a_damaged_file_is_reported_removed_and_fetched_again(write: Write) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    file = manifest.file("ct")
    with pytest.raises(StudyError, match="expected a file at"):
        verify(file)
    path = fetch(file, web=FAST)
    path.write_bytes(noise(2))
    (told,) = verify_all(manifest, "one")["status"]
    assert "expected sha256" in told
    assert hashlib.sha256(noise(2)).hexdigest() in told
    assert not path.exists()
    assert fetch(file, web=FAST).read_bytes() == noise(1)
    path.write_bytes(noise(2))
    assert fetch(file, web=FAST).read_bytes() == noise(1)
    assert list(verify_all(manifest, "one")["status"]) == ["verified"]


def test_too_small_a_disk_is_seen_before_the_download(
    write: Write, server: ArchiveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    usage = type("Usage", (), {"free": 300_000})
    monkeypatch.setattr(fetching.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(StudyError, match=r"expected 210\.\d MB free for 1 files, got 0\.3 MB; .*STUDY_DATA_DIR"):
        fetch_all(manifest, "one", web=FAST, progress=False)
    assert len(server.requests) == 1  # the directory


def test_two_fetches_at_once_download_once(write: Write, server: ArchiveServer) -> None:
    file = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz").file("ct")
    server.seconds_per_block = 0.005
    with ThreadPoolExecutor(2) as pool:
        paths = list(pool.map(lambda _: fetch(file, web=FAST), range(2)))
    assert paths[0].read_bytes() == noise(1)
    assert len([request for request in server.requests if request.first == 0]) <= 2  # the directory, the member


def test_a_folder_that_cannot_be_written_is_named(write: Write, folder: Path) -> None:
    folder.write_bytes(b"in the way")
    with pytest.raises(StudyError, match="expected a data folder that can be written"):
        fetch(write(ribfrac_zip({421: b"x"}), "RibFrac421-image.nii.gz").file("ct"), web=FAST)


def test_data_folder_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert data_dir() == tmp_path / "data"
    monkeypatch.setenv("STUDY_DATA_DIR", "")
    assert "study" in data_dir().parts
    assert data_dir().is_absolute()


def test_progress_names_size_and_folder(write: Write, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    fetch_all(manifest, "one", web=FAST, progress=True)
    told = capsys.readouterr()
    assert f"fetching 1 files: 0.3 MB to download, 0.6 MB on disk in {folder}" in told.err
    assert "RibFrac421-image.nii.gz: 100%" in told.err
    assert told.out == ""


# --- local files ----------------------------------------------------------------------------------------------------


def test_local_files_lie_beside_the_manifest_and_are_never_deleted(tmp_path: Path) -> None:
    scan = tmp_path / "scans" / "a.nii.gz"
    source = {"kind": "local", "path": "scans/a.nii.gz", "sha256": hashlib.sha256(b"scan").hexdigest()}
    file = manifest_of(tmp_path, {"source": source}).file("ct")
    assert status(file) == "to be put in place"
    with pytest.raises(StudyError, match=r"ct: expected .*scans/a\.nii\.gz, got no such file; put it there"):
        fetch(file)
    scan.parent.mkdir()
    scan.write_bytes(b"another scan")
    with pytest.raises(StudyError, match=r"expected sha256 [0-9a-f]{64}, got [0-9a-f]{64}"):
        fetch(file)
    with pytest.raises(StudyError, match="expected sha256"):
        verify(file)
    assert scan.exists()
    scan.write_bytes(b"scan")
    assert fetch(file) == scan
    assert verify(file) == scan


def test_a_local_file_without_a_hash_and_a_dicom_folder_are_taken_as_they_are(tmp_path: Path) -> None:
    series = tmp_path / "series"
    series.mkdir()
    assert fetch(manifest_of(tmp_path, {"source": {"kind": "local", "path": "series"}}).file("ct")) == series
    assert fetch(manifest_of(tmp_path, {"source": {"kind": "local", "path": str(series)}}).file("ct")) == series
    hashed = {"source": {"kind": "local", "path": "series", "sha256": "0" * 64}}
    with pytest.raises(StudyError, match="expected a file, got the folder"):
        fetch(manifest_of(tmp_path, hashed).file("ct"))


def test_a_local_archive_must_be_the_right_one(tmp_path: Path, folder: Path) -> None:
    packed = ribseg_zip({421: b"labels"})
    source = {
        "kind": "local",
        "path": "ribseg_v2.zip",
        "member": "RibFrac421-rib-seg.nii.gz",
        "sha256": hashlib.sha256(packed).hexdigest(),
        "instructions": "ask the authors",
    }
    file = manifest_of(tmp_path, {"source": source}).file("ct")
    with pytest.raises(StudyError, match="ask the authors"):
        fetch(file)
    folder.mkdir()
    (folder / "ribseg_v2.zip").write_bytes(packed + b"!")
    with pytest.raises(StudyError, match=r"ribseg_v2\.zip: expected sha256"):
        fetch(file)
    (tmp_path / "ribseg_v2.zip").write_bytes(packed)
    assert fetch(file).read_bytes() == b"labels"


# --- package indexes ------------------------------------------------------------------------------------------------


def sdist(members: dict[str, bytes], links: dict[str, str] | None = None) -> bytes:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
        for name, target in (links or {}).items():
            info = tarfile.TarInfo(name)
            info.type, info.linkname = tarfile.SYMTYPE, target
            archive.addfile(info)
    return packed.getvalue()


@pytest.fixture
def publish(tmp_path: Path, server: ArchiveServer, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Put an archive on a loopback package index and describe one of its members."""

    def make(
        packed: bytes, member: str, *, archive: str = "scans-1.0.tar.gz", sha256: str = "", **file: object
    ) -> Manifest:
        server.files["/simple/scans/"] = f'<a href="{server.url}/files/{archive}">{archive}</a>'.encode()
        server.files[f"/files/{archive}"] = packed
        monkeypatch.setenv("PIP_INDEX_URL", f"{server.url}/simple/")
        source = {
            "kind": "pypi",
            "project": "scans",
            "version": "1.0",
            "archive": archive,
            "bytes": len(packed),
            "sha256": sha256 or hashlib.sha256(packed).hexdigest(),
            "member": member,
        }
        content = noise(1)
        known = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        return manifest_of(tmp_path, {"source": source} | known | file)

    return make


@pytest.mark.parametrize("archive", ["scans-1.0.tar.gz", "scans-1.0-py3-none-any.whl"])
def test_a_member_of_a_package_comes_from_the_configured_index(
    publish: Write, server: ArchiveServer, archive: str
) -> None:
    members = {"scans-1.0/setup.py": b"raise SystemExit('was run')", "scans-1.0/data/a.nrrd": noise(1)}
    packed = sdist(members) if archive.endswith("gz") else make_zip(members)
    manifest = publish(packed, "data/a.nrrd", archive=archive)
    path = fetch(manifest.file("ct"), web=FAST)
    assert path.read_bytes() == noise(1)
    path.unlink()
    n_before = len(server.requests)
    assert fetch(manifest.file("ct"), web=FAST) == path  # out of the kept archive
    assert len(server.requests) == n_before


@pytest.mark.parametrize("ranges", [True, False])
def test_a_broken_package_download_is_resumed_or_restarted_cleanly(
    publish: Write, server: ArchiveServer, ranges: bool
) -> None:
    manifest = publish(sdist({"a.nrrd": noise(1)}), "a.nrrd")
    server.ranges = ranges
    server.faults.extend([Fault(), Fault(cut_after=100_000), Fault(cut_after=50_000)])
    assert fetch(manifest.file("ct"), web=FAST).read_bytes() == noise(1)
    firsts = [request.first for request in server.requests if request.path.startswith("/files/")]
    assert firsts == ([None, 100_000, 150_000] if ranges else [None, None, None])


def test_a_package_with_a_wrong_hash_is_refused_and_gone(publish: Write, folder: Path) -> None:
    packed = sdist({"a.nrrd": noise(1)})
    manifest = publish(packed, "a.nrrd", sha256="0" * 64)
    actual = hashlib.sha256(packed).hexdigest()
    with pytest.raises(StudyError, match=rf"expected sha256 0{{64}}, got {actual}; the bad file was removed"):
        fetch(manifest.file("ct"), web=FAST)
    assert not list((folder / "archives").iterdir())


def test_a_hash_that_the_index_contradicts_is_refused_before_the_download(
    publish: Write, server: ArchiveServer
) -> None:
    manifest = publish(sdist({"a.nrrd": noise(1)}), "a.nrrd")
    name = "scans-1.0.tar.gz"
    server.files["/simple/scans/"] = f'<a href="/files/{name}#sha256={"1" * 64}">{name}</a>'.encode()
    with pytest.raises(StudyError, match=r"got 1{64}; this is another file, not fetched"):
        fetch(manifest.file("ct"), web=FAST)
    assert server.sent(f"/files/{name}") == 0


def test_a_package_of_another_size_is_refused(publish: Write, server: ArchiveServer) -> None:
    manifest = publish(sdist({"a.nrrd": noise(1)}), "a.nrrd")
    server.files["/files/scans-1.0.tar.gz"] += b"more"
    with pytest.raises(StudyError, match=r"expected [0-9]+ bytes, got [0-9]+"):
        fetch(manifest.file("ct"), web=FAST)


def test_a_member_that_is_not_the_one_meant_is_refused(publish: Write, folder: Path) -> None:
    manifest = publish(sdist({"a.nrrd": noise(2)}), "a.nrrd")
    with pytest.raises(StudyError, match=r"expected sha256 [0-9a-f]{64}, got [0-9a-f]{64}"):
        fetch(manifest.file("ct"), web=FAST)
    assert not list(folder.rglob("a.nrrd*"))
    with pytest.raises(StudyError, match=r"expected 300001 bytes, got 300000"):
        fetch(publish(sdist({"a.nrrd": noise(1)}), "a.nrrd", bytes=300_001).file("ct"), web=FAST)
    for packed in (sdist({}, {"a.nrrd": "/etc/passwd"}), sdist({"../a.nrrd": noise(1)}), noise(3)):
        with pytest.raises(StudyError, match=r"link|not safe|sound"):
            fetch(publish(packed, "a.nrrd").file("ct"), web=FAST)


def test_an_index_without_the_file_is_named_without_its_password(
    publish: Write, server: ArchiveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = publish(sdist({"a.nrrd": noise(1)}), "a.nrrd")
    monkeypatch.setenv("PIP_INDEX_URL", server.url.replace("://", "://me:secret@") + "/simple/")
    assert fetch(manifest.file("ct"), web=FAST).exists()
    assert len(server.requests) == 2
    assert all(request.authorization.startswith("Basic ") for request in server.requests)  # the file needs it as well
    for page in (b"<a href='other-1.0.tar.gz'>other-1.0.tar.gz</a>", None):
        if page is None:
            del server.files["/simple/scans/"]
        else:
            server.files["/simple/scans/"] = page
        path_of(manifest.file("ct")).unlink(missing_ok=True)
        for kept in (data_dir() / "archives").iterdir():
            kept.unlink()
        with pytest.raises(StudyError, match="set PIP_INDEX_URL") as told:
            fetch(manifest.file("ct"), web=FAST)
        assert "secret" not in str(told.value)


def test_the_index_is_the_one_pip_is_set_up_with(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for variable in ("PIP_INDEX_URL", "UV_INDEX_URL", "UV_DEFAULT_INDEX"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    assert index_url() == PYPI_SIMPLE_ENDPOINT
    config = tmp_path / "pip.conf"
    config.write_text("[global]\nindex-url = https://example.org/%20/simple\n")
    monkeypatch.setenv("PIP_CONFIG_FILE", str(config))
    assert index_url() == "https://example.org/%20/simple"
    monkeypatch.setenv("UV_INDEX_URL", "https://uv.example.org/simple")
    assert index_url() == "https://uv.example.org/simple"
    monkeypatch.setenv("PIP_INDEX_URL", "https://pip.example.org/simple")
    assert index_url() == "https://pip.example.org/simple"
    config.write_text("no section\n")
    monkeypatch.delenv("PIP_INDEX_URL")
    monkeypatch.delenv("UV_INDEX_URL")
    with pytest.raises(StudyError, match="readable pip configuration"):
        index_url()


# --- tables ---------------------------------------------------------------------------------------------------------


def test_the_list_has_a_row_for_every_file_of_every_subject() -> None:
    table = data_list(load_manifest())
    assert len(table) == 6 + 10 + 3 * 27
    assert set(table.loc[table["dataset"] == "ribseg", "status"]) == {"absent", "to be put in place"}
    assert (table[["licence", "title", "source"]] != "").all(axis=None)
    assert len(data_list(load_manifest(), "open")) == 6
    assert len(data_list(load_manifest(), "phantom")) == 0
    with pytest.raises(StudyError, match="expected a cohort out of open, phantom"):
        data_list(load_manifest(), "opne")


def test_the_open_cohort_is_what_the_manifest_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real files, when this machine has fetched them already; hashes are of the real packages."""
    monkeypatch.delenv("STUDY_DATA_DIR")
    manifest = load_manifest()
    table = data_list(manifest, "open")
    if not (table["status"] == "ready").all():
        pytest.skip("cohort `open` is not in the cache folder; run `study data fetch --dataset open`")
    for file in manifest.files_of("open").values():
        assert verify(file).stat().st_size == file.bytes
