"""A few members of a huge remote zip, by HTTP range: the directory first, then each member's own bytes."""

from __future__ import annotations

import struct
import time
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from remotezip import RangeNotSupported, RemoteIOError, RemoteZip, RemoteZipError
from tqdm import tqdm
from urllib3.exceptions import HTTPError as TransportError

from study.data.archive import BLOCK_BYTES, check_regular, find_member, write_checked
from study.data.web import RangesRefused, Web, shown
from study.errors import StudyError

DIRECTORY_TAIL_BYTES = 256 << 10  # one request brings the whole directory of an archive of a few hundred members
LOCAL_HEADER = struct.Struct("<4s22xHH")  # signature, ..., lengths of name and extra field


@dataclass(frozen=True)
class RemoteArchive:
    """The directory of a remote zip.

    Attributes:
        url: where it is.
        n_bytes: its size.
        members: what it holds, by name.
    """

    url: str
    n_bytes: int
    members: dict[str, zipfile.ZipInfo]
    web: Web

    def member(self, wanted: str) -> zipfile.ZipInfo:
        """The one plain member of that name, or that base name in any folder.

        Raises:
            StudyError: none, several, an unsafe name, or something that is not a plain deflated or stored file.
        """
        where = shown(self.url)
        info = self.members[find_member(self.members, wanted, where)]
        check_regular(info, where)
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise StudyError(
                f"{where}: expected a stored or deflated member, got method {info.compress_type} in {wanted!r}"
            )
        return info

    def fetch(
        self, wanted: str, target: Path, *, sha256: str | None, n_bytes: int | None, bar: tqdm[NoReturn] | None
    ) -> str:
        """Write one member to ``target``, checked; returns its sha256.

        The compressed bytes are kept in a part file beside the target until the member is complete, under a name
        with the member's CRC-32, so that a killed fetch goes on where it stopped, and never on another version.

        Raises:
            StudyError: the line or the server fails (the part file stays), or the content is not what the archive's
                directory, ``n_bytes`` or ``sha256`` say (the part file goes).
        """
        info = self.member(wanted)
        where = f"{shown(self.url)}: {info.filename}"
        if n_bytes is not None and n_bytes != info.file_size:
            raise StudyError(f"{where}: expected {n_bytes} bytes, got {info.file_size}; the archive has changed")
        part = part_of(target, info)
        self.web.download(self.url, part, self._stored_bytes(info), offset=info.header_offset, bar=bar)
        content = _inflated(part, info, where)
        try:
            found = write_checked(content, target, n_bytes=info.file_size, crc32=info.CRC, sha256=sha256, where=where)
        except StudyError:
            part.unlink()
            raise
        part.unlink()
        return found

    def _stored_bytes(self, info: zipfile.ZipInfo) -> int:
        """An upper bound on header and data: the way to the next member, or to the archive's end.

        Only the header itself tells its length; reading on to the neighbour spares a request per member.
        """
        later = [other.header_offset for other in self.members.values() if other.header_offset > info.header_offset]
        longest = LOCAL_HEADER.size + 2 * 0xFFFF + info.compress_size + 24  # 24: an optional data descriptor
        return min(min(later, default=self.n_bytes) - info.header_offset, longest)


def part_of(target: Path, info: zipfile.ZipInfo) -> Path:
    """The part file of a member."""
    return target.with_name(f"{target.name}.{info.CRC:08x}.part")


def open_remote(url: str, web: Web, archive_bytes: int | None = None) -> RemoteArchive:
    """Read a remote zip's directory, in one or two range requests.

    Raises:
        RangesRefused: the server has no byte ranges.
        StudyError: no answer, not a zip, or another size than ``archive_bytes``.
    """
    for attempt in range(web.attempts):
        try:
            with RemoteZip(url, DIRECTORY_TAIL_BYTES, session=web.session, timeout=web.timeout_s) as remote:
                members = {info.filename: info for info in remote.infolist()}
                n_bytes = remote.size()
            break
        except RangeNotSupported as error:
            size = f"{archive_bytes} bytes" if archive_bytes else "of unknown size"
            raise RangesRefused(
                f"{shown(url)}: expected a server that serves byte ranges, got the whole archive ({size})"
            ) from error
        except TransportError as error:  # the line dropped inside the directory
            if attempt + 1 == web.attempts:
                raise StudyError(
                    f"{shown(url)}: expected the archive's directory, got {error}; try again later"
                ) from error
            time.sleep(web.backoff_s * 2**attempt)
        except RemoteIOError as error:
            raise StudyError(f"{shown(url)}: expected the archive's directory, got {error}; check `url`") from error
        except (zipfile.BadZipFile, RemoteZipError) as error:
            raise StudyError(
                f"{shown(url)}: expected a zip archive, got {error}; check `url` in the manifest"
            ) from error
    if archive_bytes is not None and n_bytes != archive_bytes:
        raise StudyError(
            f"{shown(url)}: expected an archive of {archive_bytes} bytes, got {n_bytes}; "
            "the record has changed, compare it with the manifest"
        )
    return RemoteArchive(url, n_bytes, members, web)


def _inflated(part: Path, info: zipfile.ZipInfo, where: str) -> Iterator[bytes]:
    """The member's content out of its local header and compressed bytes."""
    with part.open("rb") as file:
        header = file.read(LOCAL_HEADER.size)
        if len(header) < LOCAL_HEADER.size or header[:4] != b"PK\x03\x04":
            raise StudyError(f"{where}: expected a zip member's header, got other bytes; fetch again")
        _, n_name, n_extra = LOCAL_HEADER.unpack(header)
        file.seek(n_name + n_extra, 1)
        left = info.compress_size
        inflate = zlib.decompressobj(-zlib.MAX_WBITS) if info.compress_type == zipfile.ZIP_DEFLATED else None
        while left and (block := file.read(min(left, BLOCK_BYTES))):
            left -= len(block)
            if inflate is None:
                yield block
                continue
            try:
                while block:  # bounded output: a block of zeros inflates a thousandfold
                    yield inflate.decompress(block, BLOCK_BYTES)
                    block = inflate.unconsumed_tail
            except zlib.error as error:
                raise StudyError(f"{where}: expected deflated data, got {error}; fetch again") from error
        if inflate is not None:
            yield inflate.flush()
