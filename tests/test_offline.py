"""Nothing beyond this machine: with data here the study runs, without it says what is missing."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import requests
from http_archive import RIBFRAC_PATH, ArchiveServer, rebased_manifest, ribfrac_zip, ribseg_zip

from study.batch.workers import Workers
from study.cli import main
from study.data.web import Web
from study.errors import StudyError
from study.offline import VARIABLE, watch_connections

NUMBERS = (421, 441, 461, 481, 500)


@pytest.fixture(autouse=True)
def offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Set for the test, so that it is taken back after it; the hook itself stays and then does nothing."""
    monkeypatch.setenv(VARIABLE, "1")
    monkeypatch.setenv("STUDY_DATA_DIR", str(tmp_path / "data"))
    for variable in ("HTTP_PROXY", "HTTPS_PROXY", "http_proxy", "https_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(variable, raising=False)
    watch_connections()


@pytest.fixture
def server() -> Iterator[ArchiveServer]:
    with ArchiveServer() as running:
        yield running


def test_every_way_out_is_refused_by_name() -> None:
    for way in (
        lambda: requests.get("https://example.org", timeout=1),
        lambda: Web().session.get("https://example.org", timeout=1),
        lambda: socket.create_connection(("example.org", 80), timeout=1),
        lambda: socket.gethostbyname("example.org"),
    ):
        with pytest.raises(StudyError, match=r"no connection beyond this machine .* got one to example\.org"):
            way()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp, pytest.raises(StudyError, match=r"192\.0\.2\.1"):
        udp.sendto(b"x", ("192.0.2.1", 9))
    with socket.socket() as tcp, pytest.raises(StudyError, match=r"192\.0\.2\.1"):
        tcp.connect(("192.0.2.1", 9))


def test_this_machine_is_not_beyond_itself() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        socket.create_connection(listening.getsockname(), timeout=1).close()
    assert socket.getaddrinfo("localhost", 80)


def test_the_hook_does_nothing_where_it_is_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "0")
    with socket.socket() as tcp:
        tcp.settimeout(0.01)
        with suppress(OSError):  # no network, or nobody there; a StudyError would get through
            tcp.connect(("192.0.2.1", 9))


def test_workers_and_other_processes_are_held_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "0")
    Workers(2, False).run("before", {n: (abs, n) for n in range(4)})  # which stay
    monkeypatch.setenv(VARIABLE, "1")
    found = Workers(2, False).run("ways out", {n: (socket.gethostbyname, "example.org") for n in range(2)})
    assert all("got one to example.org" in str(outcome.error) for outcome in found.values())
    done = subprocess.run(
        [sys.executable, "-c", "import study, socket; socket.gethostbyname('example.org')"],
        capture_output=True,
        encoding="utf-8",
        env={**os.environ, VARIABLE: "1"},
        check=False,
    )
    assert "no connection beyond this machine" in done.stderr


def test_data_that_is_here_is_used_and_data_that_is_not_is_named(
    server: ArchiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    server.files[RIBFRAC_PATH] = ribfrac_zip({number: rng.bytes(2000) for number in NUMBERS})
    path = rebased_manifest(tmp_path / "mine.yaml", server.url, keep=["ribseg"])
    (tmp_path / "ribseg_v2.zip").write_bytes(ribseg_zip({number: rng.bytes(500) for number in NUMBERS}))
    fetch = ["data", "fetch", "--dataset", str(path)]
    assert main(["--offline", *fetch]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    for number in NUMBERS:
        assert f"RibFrac{number}-image.nii.gz, got no such file" in err
    assert "run `study data fetch` once without" in err
    assert server.requests == []
    assert main(["--offline", "run", "--dataset", str(path)]) == 2  # before anything is computed
    assert "run `study data fetch` once without" in capsys.readouterr().err
    assert server.requests == []
    monkeypatch.setenv(VARIABLE, "0")
    assert main(fetch) == 0
    n_requests = len(server.requests)
    capsys.readouterr()
    assert main(["--offline", *fetch]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2 * len(NUMBERS)
    assert len(server.requests) == n_requests
