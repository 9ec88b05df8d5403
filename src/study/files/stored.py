"""Pixels of an image file, read to the end: a checksum counts only once every byte that it covers has been seen."""

from __future__ import annotations

import bz2
import lzma
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from study.errors import StudyError

Encoding = Literal["raw", "gzip", "zlib", "bzip2", "xz"]

BLOCK_BYTES = 1 << 18  # packed or unpacked: what a processor's cache holds is unpacked twice as fast as megabytes
UNBOUNDED_BYTES = 1 << 14  # packed, of the formats whose unpacked block is not bounded here
MAX_RATIO = {
    "gzip": 1032,
    "zlib": 1032,
    "bzip2": 1 << 16,
    "xz": 1 << 16,
}  # no stream unpacks to more: a header that asks is wrong


@dataclass(frozen=True)
class Stored:
    """Where the pixels of an image are and how they are stored, as its checked header says.

    Attributes:
        shape: (i, j, k), the first index running fastest in the file.
        dtype: of one pixel, with its byte order.
        path: the file that holds the pixels.
        offset: their first byte in that file; in the unpacked stream where the whole file is packed (``.nii.gz``).
        encoding: how they are packed.
        whole_packed: whether the packed stream starts at the file's first byte, not at ``offset``.
        slope: value of a pixel is ``slope * stored + intercept``.
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    path: Path
    offset: int
    encoding: Encoding = "raw"
    whole_packed: bool = False
    slope: float = 1.0
    intercept: float = 0.0

    @property
    def n_bytes(self) -> int:
        """Of the pixels, unpacked."""
        return math.prod(self.shape) * self.dtype.itemsize


def read_pixels(stored: Stored, name: str) -> NDArray[Any]:
    """All pixels (i, j, k), rescaled to float32 where the header says so.

    Raises:
        StudyError: fewer or more bytes than the header asks for, or a checksum that does not match.
    """
    n_file = stored.path.stat().st_size
    n_skipped = stored.offset if stored.whole_packed or stored.encoding == "raw" else 0
    n_wanted = n_skipped + stored.n_bytes
    if stored.encoding == "raw":
        if n_file != n_wanted:
            raise _mis_sized(name, n_wanted, n_file, whole=n_file > n_wanted)
    elif n_wanted > MAX_RATIO[stored.encoding] * n_file:
        raise StudyError(
            f"{name}: expected {n_wanted} bytes by the header's size, got {n_file} packed ones, which cannot hold"
            " them; the header is damaged: fetch it again"
        )
    pixels = np.empty(math.prod(stored.shape), dtype=stored.dtype)
    view, at = pixels.view(np.uint8), -n_skipped
    with stored.path.open("rb") as file:
        file.seek(0 if stored.whole_packed else stored.offset - n_skipped)
        for block in unpacked(file, stored.encoding, name):
            part = block[max(-at, 0) :] if at < 0 else block
            at += len(block)
            if at > stored.n_bytes:
                raise _mis_sized(name, n_wanted, None, whole=True)
            view[at - len(part) : at] = np.frombuffer(part, np.uint8)
    if at != stored.n_bytes:
        raise _mis_sized(name, n_wanted, at + n_skipped, whole=False)
    if not pixels.dtype.isnative:
        pixels = pixels.byteswap(inplace=True).view(pixels.dtype.newbyteorder("="))
    return _rescaled(pixels.reshape(stored.shape, order="F"), stored.slope, stored.intercept)


def unpacked(file: IO[bytes], encoding: Encoding, name: str) -> Iterator[bytes]:
    """The bytes of a packed stream from where ``file`` stands, in blocks of bounded size.

    Whoever takes them to the end has had every checksum of the stream compared. Behind a member only another may
    follow, as parallel packers write them.

    Raises:
        StudyError: a damaged stream, one that ends early, or bytes behind its end.
    """
    if encoding == "raw":
        while block := file.read(BLOCK_BYTES):
            yield block
        return
    unpacker, bounded = _unpacker(encoding), encoding in ("gzip", "zlib")
    while packed := file.read(BLOCK_BYTES if bounded else UNBOUNDED_BYTES):
        while packed:
            behind = unpacker.eof
            if behind:
                unpacker = _unpacker(encoding)
            with _damage_told(name, "bytes behind the stream" if behind else "a truncated or damaged file"):
                block = unpacker.decompress(packed, BLOCK_BYTES if bounded else -1)
            packed = unpacker.unused_data or (unpacker.unconsumed_tail if bounded else b"")
            if block:
                yield block
    if not unpacker.eof:
        raise StudyError(
            f"{name}: expected the end of its {encoding} stream, got a truncated or damaged file; fetch it again"
        )


@contextmanager
def _damage_told(name: str, what: str) -> Iterator[None]:
    try:
        yield
    except (zlib.error, lzma.LZMAError, OSError) as error:  # bz2 raises OSError
        reason = " ".join(str(error).split())
        raise StudyError(
            f"{name}: expected packed data that its checksum confirms, got {what} ({reason}); fetch it again"
        ) from error


def _unpacker(encoding: Encoding) -> Any:  # zlib's type has no public name
    if encoding == "xz":
        return lzma.LZMADecompressor()
    if encoding == "bzip2":
        return bz2.BZ2Decompressor()
    # zlib compares CRC-32 and length (gzip) or Adler-32 (zlib) by itself when it meets the stream's end.
    return zlib.decompressobj(16 + zlib.MAX_WBITS if encoding == "gzip" else zlib.MAX_WBITS)


def _rescaled(pixels: NDArray[Any], slope: float, intercept: float) -> NDArray[Any]:
    if (slope, intercept) == (1.0, 0.0):
        return pixels
    values = np.empty(pixels.shape, dtype=np.float32, order="F")
    for k in range(pixels.shape[2]):  # slice by slice: doubles of a whole chest are gigabytes
        values[:, :, k] = pixels[:, :, k].astype(np.float64) * slope + intercept
    return values


def _mis_sized(name: str, wanted: int, got: int | None, *, whole: bool) -> StudyError:
    found = "more" if got is None else f"{got}"
    cause = (
        "bytes left over, so its header is wrong or two files are in one" if whole else "a truncated or damaged file"
    )
    return StudyError(f"{name}: expected {wanted} bytes, got {found}: {cause}; fetch or export it again")
