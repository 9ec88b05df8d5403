"""A loopback stand-in for the servers of the real archives, with every fault they are known for."""

from __future__ import annotations

import copy
import io
import re
import tarfile
import threading
import time
import zipfile
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml

from study.data.manifest import default_manifest_path, load_manifest
from study.data.schema import Manifest
from study.data.web import Web

RIBFRAC_PATH = "/records/3893496/files/ribfrac-val-images.zip"
TOTALSEGMENTATOR_PATH = "/records/10047263/files/Totalsegmentator_dataset_small_v201.zip"
ZENODO = "https://zenodo.org"
SCANS = (421, 441, 461, 481, 500)  # of cohort `ribseg`
RANGE_BYTES = 1 << 16
FAST = Web(attempts=4, backoff_s=0.001, range_bytes=RANGE_BYTES, timeout_s=5)

Write = Callable[..., Manifest]


@dataclass(frozen=True)
class Fault:
    """What goes wrong with one request: an HTTP status, a cut after some bytes, or neither."""

    status: int | None = None
    retry_after: str | None = None
    cut_after: int | None = None


@dataclass
class Request:
    """One GET as the server saw it; ``sent`` counts body bytes."""

    path: str
    first: int | None
    last: int | None
    user_agent: str
    authorization: str
    sent: int = 0


@dataclass
class ArchiveServer:
    """Serves ``files`` (path to bytes) on loopback; faults are used up one a request, in order."""

    files: dict[str, bytes] = field(default_factory=dict)
    ranges: bool = True
    seconds_per_block: float = 0.0
    block_bytes: int = 1 << 14
    faults: deque[Fault] = field(default_factory=deque)
    requests: list[Request] = field(default_factory=list)

    def __enter__(self) -> Self:
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            disable_nagle_algorithm = True  # else every small answer waits 40 ms for an acknowledgement

            def do_GET(self) -> None:
                outer._answer(self)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}"

    def sent(self, path: str) -> int:
        """Body bytes sent so far for one path."""
        return sum(request.sent for request in self.requests if request.path == path)

    def _answer(self, handler: BaseHTTPRequestHandler) -> None:
        asked = re.fullmatch(r"bytes=(\d*)-(\d*)", handler.headers.get("Range", ""))
        fault = self.faults.popleft() if self.faults else Fault()
        body = self.files.get(handler.path)
        request = Request(
            handler.path, None, None, handler.headers.get("User-Agent", ""), handler.headers.get("Authorization", "")
        )
        self.requests.append(request)
        if body is None or fault.status is not None:
            handler.send_response(fault.status or 404)
            if fault.retry_after is not None:
                handler.send_header("Retry-After", fault.retry_after)
            handler.send_header("Content-Length", "0")
            handler.end_headers()
            return
        n = len(body)
        first, last = 0, n - 1
        if asked and self.ranges:
            if asked[1]:
                first, last = int(asked[1]), min(int(asked[2] or n - 1), n - 1)
            else:
                first = max(n - int(asked[2]), 0)
            request.first, request.last = first, last
            if first >= n:
                handler.send_response(416)
                handler.send_header("Content-Range", f"bytes */{n}")
                handler.send_header("Content-Length", "0")
                handler.end_headers()
                return
            handler.send_response(206)
            handler.send_header("Content-Range", f"bytes {first}-{last}/{n}")
        else:
            handler.send_response(200)
        handler.send_header("Content-Type", "text/html" if handler.path.endswith("/") else "application/octet-stream")
        handler.send_header("Content-Length", str(last + 1 - first))
        handler.end_headers()
        until = last + 1 if fault.cut_after is None else min(first + fault.cut_after, last + 1)
        try:
            for start in range(first, until, self.block_bytes):
                block = body[start : min(start + self.block_bytes, until)]
                handler.wfile.write(block)
                request.sent += len(block)
                time.sleep(self.seconds_per_block)
        except OSError:  # the client has gone
            handler.close_connection = True
        if until <= last:
            handler.close_connection = True


def make_zip(members: Mapping[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip archive in memory; names are written as they are, ``../x`` included."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content, compress_type=method)
    return packed.getvalue()


def ribfrac_zip(images: Mapping[int, bytes], folder: str = "ribfrac-val-images/") -> bytes:
    """Laid out like RibFrac's validation archive; ``images`` by scan number."""
    return make_zip({f"{folder}RibFrac{number}-image.nii.gz": content for number, content in images.items()})


def ribseg_zip(labels: Mapping[int, bytes]) -> bytes:
    """Laid out like the RibSeg v2 archive."""
    return make_zip({f"ribseg_v2/seg/RibFrac{number}-rib-seg.nii.gz": content for number, content in labels.items()})


def totalsegmentator_zip(subjects: Mapping[str, tuple[bytes, Mapping[str, bytes]]], folder: str = "") -> bytes:
    """Laid out like the small TotalSegmentator set; each subject is its CT and its masks by structure."""
    members = {f"{folder}meta.csv": b"image_id;age;gender\n"}
    for subject, (ct, masks) in subjects.items():
        members[f"{folder}{subject}/ct.nii.gz"] = ct
        for structure, mask in masks.items():
            members[f"{folder}{subject}/segmentations/{structure}.nii.gz"] = mask
    return make_zip(members)


def rebased_manifest(target: Path, base_url: str, *, keep: Iterable[str], ribseg_sha256: str | None = None) -> Path:
    """A copy of the repository's manifest whose archives lie on ``base_url``, with the cohorts ``keep`` only.

    Sizes and hashes of the real archives are dropped, since the stand-ins have others.
    """
    raw = copy.deepcopy(yaml.safe_load(default_manifest_path().read_text(encoding="utf-8")))  # no shared anchors
    raw["cohorts"] = {name: raw["cohorts"][name] for name in keep}
    for file in raw["files"].values():
        source = file["source"] = dict(file["source"])
        if source["kind"] == "zip":
            source["url"] = source["url"].replace(ZENODO, base_url)
            for name in ("archive_bytes", "archive_sha256", "archive_md5"):
                source.pop(name, None)
        elif source["kind"] == "local":
            source.pop("sha256", None)
            if ribseg_sha256:
                source["sha256"] = ribseg_sha256
    target.write_text(yaml.safe_dump(raw, sort_keys=False), encoding="utf-8")
    return target


def noise(seed: int, n_bytes: int = 300_000) -> bytes:
    """Incompressible, as a .nii.gz is."""
    return np.random.default_rng(seed).bytes(n_bytes)


def manifest_of(tmp_path: Path, file: dict) -> Manifest:
    ct = {"role": "ct", "title": "a scan", "licence": "CC0", "citation": "nobody"} | file
    raw = {"files": {"ct": ct}, "cohorts": {"one": {"subjects": {"a": {"ct": "ct", "landmarks": "a.yaml"}}}}}
    path = tmp_path / "my_manifest.yaml"
    path.write_text(yaml.safe_dump(raw), encoding="utf-8")
    return load_manifest(path)


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
