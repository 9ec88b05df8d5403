from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest
from http_archive import (
    FAST,
    ArchiveServer,
    Fault,
    Write,
    make_zip,
    manifest_of,
    noise,
    sdist,
)
from pypi_simple import PYPI_SIMPLE_ENDPOINT

from study.data.fetch import fetch
from study.data.pypi import index_url
from study.data.schema import Manifest
from study.data.store import data_dir, path_of
from study.errors import StudyError


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
    assert not list(folder.rglob("*a.nrrd*"))
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
