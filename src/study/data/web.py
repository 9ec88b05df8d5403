"""HTTP over an unreliable line: retries with back-off, byte ranges, part files that grow where they stopped."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import NoReturn, Self
from urllib.parse import urlsplit, urlunsplit

import requests
from requests.adapters import HTTPAdapter
from tqdm import tqdm
from urllib3 import BaseHTTPResponse
from urllib3.connectionpool import ConnectionPool
from urllib3.exceptions import HTTPError as TransportError
from urllib3.util.retry import Retry

from study import __version__
from study.errors import StudyError

USER_AGENT = f"study/{__version__} (chest CT registration study; fetches single files by byte range)"
RETRIED_STATUSES = (429, 500, 502, 503, 504)
BLOCK_BYTES = 1 << 16
RETRY_AFTER_MAX_S = 120
TOLD_WAIT_S = 5  # a wait that is shorter looks like work


class RangesRefused(StudyError):
    """The server answers a range request with the whole file."""


class _Patience(Retry):
    """Obeys Retry-After, says so, and gives up at once where it asks for longer than anyone waits unasked."""

    def increment(
        self,
        method: str | None = None,
        url: str | None = None,
        response: BaseHTTPResponse | None = None,
        error: Exception | None = None,
        _pool: ConnectionPool | None = None,
        _stacktrace: TracebackType | None = None,
    ) -> Self:
        """Count one more try, and look at how long the server asks to wait before it."""
        seconds = (self.get_retry_after(response) if response is not None else None) or 0.0
        host = _pool.host if _pool is not None else "the server"
        if response is not None and seconds > RETRY_AFTER_MAX_S:
            raise StudyError(
                f"{host}: expected an answer, got HTTP {response.status} and the wish to wait {seconds:.0f} s"
                " (Retry-After); run the same command again after that, it goes on from there"
            )
        counted = super().increment(method, url, response, error, _pool, _stacktrace)
        if seconds >= TOLD_WAIT_S:
            tqdm.write(f"{host} asks to wait {seconds:.0f} s (Retry-After)", file=sys.stderr)
        return counted


def _refuse_downgrade(response: requests.Response, **_: object) -> None:
    """Stop at a redirect from https to http, before it is followed."""
    target = urlsplit(response.headers.get("Location", "")) if response.is_redirect else None
    if target is not None and target.scheme == "http" and urlsplit(response.url).scheme == "https":
        raise StudyError(
            f"{shown(response.url)}: expected to stay on https, got a redirect to http on {target.hostname}, where the"
            " file can be changed on its way; correct the address"
        )


def shown(url: str) -> str:
    """The URL without user name and password, for messages."""
    parts = urlsplit(url)
    return urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))


@dataclass(frozen=True)
class Web:
    """One polite HTTP client.

    Attributes:
        attempts: tries of one request, and of one stretch of bytes that makes no headway.
        backoff_s: the n-th wait is about ``backoff_s * 2**n`` seconds; a server's Retry-After is obeyed instead.
        range_bytes: size of one range request; few large ranges, because tiny ones meet rate limits.
        timeout_s: seconds without a byte before a try counts as failed.
    """

    attempts: int = 6
    backoff_s: float = 1.0
    range_bytes: int = 4 << 20
    timeout_s: float = 60.0

    @cached_property
    def session(self) -> requests.Session:
        """A session that retries refused and dropped connections, 429 and 5xx before it answers."""
        session = requests.Session()
        retry = _Patience(
            total=self.attempts - 1,
            other=0,  # a certificate that is wrong stays wrong
            status_forcelist=RETRIED_STATUSES,
            backoff_factor=self.backoff_s,
            retry_after_max=7 * 24 * 3600,  # not cut to what is waited: `_Patience` must see what is asked for
        )
        for scheme in ("https://", "http://"):
            session.mount(scheme, HTTPAdapter(max_retries=retry))
        session.hooks["response"].append(_refuse_downgrade)
        session.headers["User-Agent"] = USER_AGENT
        session.headers["Accept-Encoding"] = "identity"  # the bytes that were hashed, not a recoding of them
        return session

    @contextmanager
    def get(self, url: str, headers: dict[str, str] | None = None) -> Iterator[requests.Response]:
        """A streamed answer with status 2xx.

        Raises:
            StudyError: no connection, or any other status after all tries.
        """
        with reported(url):
            response = self.session.get(url, headers=headers, stream=True, timeout=self.timeout_s)
        with response:
            if not response.ok:
                raise StudyError(
                    f"{shown(url)}: expected the file, got HTTP {response.status_code} {response.reason}; "
                    "check the address in the manifest, or try again later"
                )
            yield response

    def download(
        self,
        url: str,
        part: Path,
        n_bytes: int,
        *,
        offset: int = 0,
        whole: bool = False,
        bar: tqdm[NoReturn] | None = None,
    ) -> None:
        """Grow ``part`` until it holds ``n_bytes`` bytes of ``url`` from ``offset`` on.

        What ``part`` already holds is kept and only the rest is asked for, so a killed download goes on where it
        stopped. With ``whole`` (and offset 0) the rest comes in one request, and a server that ignores ranges
        makes it start again from the first byte; otherwise in ranges of ``range_bytes``.

        Raises:
            RangesRefused: ranges are needed and the server does not serve them.
            StudyError: the server fails, or the line drops ``attempts`` times in a row without headway.
        """
        part.parent.mkdir(parents=True, exist_ok=True)
        part.touch()
        if part.stat().st_size > n_bytes:
            part.write_bytes(b"")
        best, failures = part.stat().st_size, 0
        if bar is not None:
            bar.total = n_bytes
            bar.update(best)
        while (have := part.stat().st_size) < n_bytes:
            until = n_bytes if whole else min(have + self.range_bytes, n_bytes)
            try:
                self._append(url, part, have, until, offset, whole=whole, bar=bar)
            except TransportError as error:
                reason: Exception | str = error
            else:
                reason = "the answer ended early"
            now = part.stat().st_size
            if now >= until:
                continue
            failures = 0 if now > best else failures + 1  # a line that always restarts must come to an end
            best = max(best, now)
            if failures >= self.attempts:
                raise StudyError(
                    f"{shown(url)}: expected {n_bytes} bytes, got {now} before the line dropped {failures} times "
                    f"({reason}); run the same command again, it goes on from there"
                )
            time.sleep(self.backoff_s * 2**failures)

    def _append(
        self, url: str, part: Path, have: int, until: int, offset: int, *, whole: bool, bar: tqdm[NoReturn] | None
    ) -> None:
        first, last = offset + have, offset + until - 1
        ranged = have > 0 or not whole
        with self.get(url, {"Range": f"bytes={first}-{last}"} if ranged else None) as response:
            if ranged and response.status_code != 206:
                if not whole:
                    raise RangesRefused(
                        f"{shown(url)}: expected a server that serves byte ranges, got the whole archive "
                        f"({response.headers.get('Content-Length', 'unknown')} bytes)"
                    )
                have = 0
                if bar is not None:
                    bar.reset()
            elif ranged and not response.headers.get("Content-Range", "").startswith(f"bytes {first}-"):
                raise StudyError(
                    f"{shown(url)}: expected bytes from {first} on, got {response.headers.get('Content-Range')!r}; "
                    "a proxy may be rewriting ranges"
                )
            length = response.headers.get("Content-Length", "")
            if not have and whole and length.isdigit() and int(length) != until:
                raise StudyError(f"{shown(url)}: expected {until} bytes, got {length}; another file, not fetched")
            with part.open("ab" if have else "wb") as file:
                for block in response.raw.stream(BLOCK_BYTES, decode_content=False):
                    block = block[: until - have]
                    file.write(block)
                    have += len(block)
                    if bar is not None:
                        bar.update(len(block))
                    if have >= until:
                        break


@contextmanager
def reported(url: str) -> Iterator[None]:
    """Turn what `requests` raises before a byte has come into a `StudyError` that says what to do."""
    try:
        yield
    except requests.exceptions.SSLError as error:
        raise StudyError(
            f"{shown(url)}: expected a certificate this machine trusts, got {error}; "
            "behind a proxy with its own authority set REQUESTS_CA_BUNDLE to its certificate file"
        ) from error
    except requests.RequestException as error:
        raise StudyError(
            f"{shown(url)}: expected an answer, got {error}; check the network and the proxy settings"
        ) from error
