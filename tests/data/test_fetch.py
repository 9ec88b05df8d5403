from __future__ import annotations

import hashlib
import io
import os
import shutil
import tarfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from http_archive import (
    FAST,
    RIBFRAC_PATH,
    SCANS,
    TOTALSEGMENTATOR_PATH,
    ArchiveServer,
    Write,
    manifest_of,
    noise,
    rebased_manifest,
    ribfrac_zip,
    ribseg_zip,
    totalsegmentator_zip,
)

from study.data.fetch import fetch, fetch_all
from study.data.manifest import load_manifest
from study.data.store import path_of, status, verify, verify_all
from study.errors import StudyError


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


def test_too_small_a_disk_is_seen_before_the_download(
    write: Write, server: ArchiveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    usage = type("Usage", (), {"free": 300_000})
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
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


def test_progress_names_size_and_folder(write: Write, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    fetch_all(manifest, "one", web=FAST, progress=True)
    told = capsys.readouterr()
    assert f"fetching 1 files: 0.3 MB to download, 0.6 MB on disk in {folder}" in told.err
    assert "RibFrac421-image.nii.gz: 100%" in told.err
    assert told.out == ""


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


@pytest.mark.parametrize("mode", ["gz", "bz2", "xz"])
def test_a_packed_local_archive_without_a_hash_is_read_to_its_checksum(tmp_path: Path, mode: str, folder: Path) -> None:
    content = noise(3, 4000)
    archive = tmp_path / "scans.tar"
    with tarfile.open(archive, f"w:{mode}") as tar:
        for name in ("a.nii.gz", "b.nii.gz"):
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    whole = archive.read_bytes()
    file = manifest_of(tmp_path, {"source": {"kind": "local", "path": str(archive), "member": "a.nii.gz"}}).file("ct")
    middle = len(whole) // 2
    for number, damaged in enumerate(
        (whole[:-6], whole + b"tail", whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    ):
        archive.write_bytes(damaged)
        os.utime(archive, ns=(number, number))
        with pytest.raises(StudyError, match=r"scans\.tar: expected"):
            fetch(file)
        assert not list(folder.rglob("a.nii.gz"))
    archive.write_bytes(whole)
    assert fetch(file).read_bytes() == content


def test_a_damaged_local_zip_without_a_hash_is_refused(tmp_path: Path) -> None:
    packed = bytearray(ribseg_zip({421: noise(3, 4000)}))
    packed[2000] ^= 1
    (tmp_path / "labels.zip").write_bytes(bytes(packed))
    source = {"kind": "local", "path": "labels.zip", "member": "RibFrac421-rib-seg.nii.gz"}
    with pytest.raises(StudyError, match=r"labels\.zip: expected a sound zip"):
        fetch(manifest_of(tmp_path, {"source": source}).file("ct"))


def test_what_stands_in_a_file_s_way_is_named(write: Write, folder: Path) -> None:
    file = write(ribfrac_zip({421: b"x"}), "RibFrac421-image.nii.gz").file("ct")
    path_of(file).parent.parent.mkdir(parents=True)
    path_of(file).parent.write_bytes(b"in the way")
    with pytest.raises(StudyError, match=rf"in the way at {path_of(file).parent}; move that away"):
        fetch(file, web=FAST)
