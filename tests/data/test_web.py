from __future__ import annotations

import time

import pytest
import requests
from http_archive import (
    FAST,
    ArchiveServer,
    Fault,
    Write,
    noise,
    ribfrac_zip,
)

from study.data.fetch import fetch
from study.errors import StudyError


def test_a_dropped_line_is_taken_up_where_it_broke(write: Write, server: ArchiveServer) -> None:
    content = noise(5, 500_000)
    manifest = write(ribfrac_zip({421: content}), "RibFrac421-image.nii.gz")
    server.faults.extend([Fault(), Fault(cut_after=20_000), Fault(cut_after=0), Fault(cut_after=1), Fault()])
    path = fetch(manifest.file("ct"), web=FAST)
    assert path.read_bytes() == content
    data = server.requests[1:]
    assert data[1].first == data[0].first + 20_000
    assert sum(request.sent for request in data) < len(content) + 1_000


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


def test_a_missing_archive_says_so_at_once(write: Write, server: ArchiveServer) -> None:
    manifest = write(ribfrac_zip({421: b"x"}), "RibFrac421-image.nii.gz")
    server.files.clear()
    with pytest.raises(StudyError, match="404"):
        fetch(manifest.file("ct"), web=FAST)
    assert len(server.requests) == 1


def test_a_wish_to_wait_for_an_hour_is_told_and_not_obeyed(write: Write, server: ArchiveServer) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    server.faults.extend([Fault(), Fault(status=429, retry_after="3600")])
    start = time.monotonic()
    with pytest.raises(StudyError, match=r"127\.0\.0\.1: .* HTTP 429 and the wish to wait 3600 s \(Retry-After\)"):
        fetch(manifest.file("ct"), web=FAST)
    assert time.monotonic() - start < 2
    assert len(server.requests) == 2


def test_a_shorter_wait_is_told_and_obeyed(
    write: Write, server: ArchiveServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    waited: list[float] = []
    monkeypatch.setattr(time, "sleep", waited.append)
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    server.faults.extend([Fault(), Fault(status=503, retry_after="60")])
    fetch(manifest.file("ct"), web=FAST)
    assert 60.0 in waited
    assert "127.0.0.1 asks to wait 60 s (Retry-After)" in capsys.readouterr().err


@pytest.mark.parametrize(("target", "refused"), [("http://example.org/a", True), ("https://example.org/a", False)])
def test_a_redirect_from_https_to_http_is_refused_before_it_is_followed(target: str, refused: bool) -> None:
    answer = requests.Response()
    answer.status_code, answer.url, answer.headers["Location"] = 302, "https://example.org/b", target
    (hook,) = FAST.session.hooks["response"]
    if refused:
        with pytest.raises(StudyError, match="expected to stay on https, got a redirect to http"):
            hook(answer)
    else:
        hook(answer)
