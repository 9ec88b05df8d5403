from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from http_archive import (
    RIBFRAC_PATH,
    ArchiveServer,
    Write,
    manifest_of,
)

from study.data.schema import Manifest


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


@pytest.fixture
def write(tmp_path: Path, server: ArchiveServer) -> Write:
    """Serve a zip and describe one of its members, with whatever else the test says of it."""

    def make(packed: bytes, member: str, *, file: dict | None = None, **source: object) -> Manifest:
        server.files[RIBFRAC_PATH] = packed
        described = {"kind": "zip", "url": server.url + RIBFRAC_PATH, "member": member} | source
        return manifest_of(tmp_path, {"source": described} | (file or {}))

    return make
