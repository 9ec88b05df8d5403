"""One member out of an archive, without trusting the archive: names, links, lengths and hashes are checked."""

from __future__ import annotations

import hashlib
import lzma
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO

from study.errors import StudyError
from study.files.atomic import replacing
from study.files.stored import Encoding, unpacked

BLOCK_BYTES = 1 << 20
TAR_PACKERS: dict[bytes, Encoding] = {b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ\0": "xz"}


def is_safe_member(name: str) -> bool:
    """Whether an archive member's name stays inside the folder it is unpacked to."""
    path = PurePosixPath(name)
    return bool(path.parts) and not (path.is_absolute() or ".." in path.parts or "\\" in name or ":" in path.parts[0])


def find_member(names: Iterable[str], wanted: str, where: str) -> str:
    """The name in the archive that is ``wanted``, or the one that ends in ``/wanted``.

    So a member given by its base name is found in whatever folder the archive keeps it.

    Raises:
        StudyError: no such member, several, or one whose name leaves the folder (``../x``).
    """
    names = list(names)
    found = [name for name in names if name == wanted] or [name for name in names if name.endswith("/" + wanted)]
    if len(found) != 1:
        base = PurePosixPath(wanted).name
        near = found or [name for name in names if PurePosixPath(name).name == base]
        listing = ", ".join(near[:5]) or "none of that base name"
        raise StudyError(
            f"{where}: expected one member {wanted!r}, got {len(found)} among {len(names)} ({listing}); "
            "correct `member` in the manifest"
        )
    if not is_safe_member(found[0]):
        raise StudyError(
            f"{where}: expected a member inside the archive's own folder, got {found[0]!r}; the archive is not safe"
        )
    return found[0]


def check_regular(info: zipfile.ZipInfo, where: str) -> None:
    """Refuse a zip member that is a folder, a link or encrypted."""
    mode = info.external_attr >> 16
    if info.is_dir() or (stat.S_IFMT(mode) and not stat.S_ISREG(mode)) or info.flag_bits & 0x1:
        raise StudyError(
            f"{where}: expected a plain file, got a folder, link or encrypted member {info.filename!r}; name another"
        )


def check_packed_whole(archive: Path) -> None:
    """Read a packed tar archive to its end, where its checksum is; a zip has one for each member.

    Whoever reads a member stops before that end, so a flipped bit would go unseen.

    Raises:
        StudyError: a checksum that does not match, a stream that ends early, or bytes behind it.
    """
    with archive.open("rb") as file:
        magic = file.read(6)
        encoding = next((encoding for start, encoding in TAR_PACKERS.items() if magic.startswith(start)), None)
        if encoding is not None:
            file.seek(0)
            for _ in unpacked(file, encoding, archive.name):
                pass


@contextmanager
def open_member(archive: Path, wanted: str) -> Iterator[IO[bytes]]:
    """Open one plain file inside a zip, wheel or tar archive; nothing is unpacked or run.

    Raises:
        StudyError: not an archive, no such member, or a member that is a link or has an unsafe name.
    """
    where = archive.name
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as zipped:
                info = zipped.getinfo(find_member(zipped.namelist(), wanted, where))
                check_regular(info, where)
                with zipped.open(info) as stream:
                    yield stream
            return
        with tarfile.open(archive) as tar:
            member = tar.getmember(find_member(tar.getnames(), wanted, where))
            packed = tar.extractfile(member) if member.isreg() else None
            if packed is None:
                raise StudyError(
                    f"{where}: expected a plain file, got a folder, link or device {wanted!r}; name another"
                )
            with packed:
                yield packed
    except (zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError) as error:
        raise StudyError(
            f"{where}: expected a sound zip or tar archive, got {error}; delete it and fetch again"
        ) from error


def blocks(stream: IO[bytes]) -> Iterator[bytes]:
    """The stream's bytes, a mebibyte at a time."""
    while block := stream.read(BLOCK_BYTES):
        yield block


def write_checked(
    content: Iterable[bytes],
    target: Path,
    *,
    n_bytes: int | None = None,
    crc32: int | None = None,
    sha256: str | None = None,
    where: str = "",
) -> str:
    """Write ``content`` beside ``target``, check it, and only then give it its name; returns its sha256.

    The caller sees to it that no other process writes the same target.

    Raises:
        StudyError: another length, CRC-32 or sha256 than expected; nothing is left behind.
    """
    hashed, checksum, length = hashlib.sha256(), 0, 0
    where = where or target.name
    with replacing(target, alone=True) as temporary:
        with temporary.open("wb") as file:
            for block in content:
                length += len(block)
                if n_bytes is not None and length > n_bytes:
                    raise StudyError(f"{where}: expected {n_bytes} bytes, got more; the source has changed")
                file.write(block)
                hashed.update(block)
                checksum = zlib.crc32(block, checksum)
        advice = "the copy was removed; fetch again, and if it repeats the source has changed"
        if n_bytes is not None and length != n_bytes:
            raise StudyError(f"{where}: expected {n_bytes} bytes, got {length}; {advice}")
        if crc32 is not None and checksum != crc32:
            raise StudyError(f"{where}: expected CRC-32 {crc32:08x}, got {checksum:08x}; {advice}")
        if sha256 is not None and hashed.hexdigest() != sha256:
            raise StudyError(f"{where}: expected sha256 {sha256}, got {hashed.hexdigest()}; {advice}")
    return hashed.hexdigest()
