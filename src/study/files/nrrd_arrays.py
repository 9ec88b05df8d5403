"""NRRD files of any number of axes, with the key-value pairs that PLUS and 3D Slicer keep in their headers."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from study.errors import StudyError
from study.files.headers import beside
from study.files.stored import Stored, read_pixels
from study.files.text_images import ENCODINGS, NRRD_MAGIC, NRRD_TYPES
from study.types import Floats

NRRD_SUFFIXES = (".nrrd", ".nhdr")
MAX_LINE = 1 << 16
MAX_AXES = 5
TURNS = {"left-posterior-superior": (1.0, 1.0), "lps": (1.0, 1.0), "right-anterior-superior": (-1.0, -1.0),
         "ras": (-1.0, -1.0), "left-anterior-superior": (1.0, -1.0), "las": (1.0, -1.0)}  # fmt: skip


@dataclass(frozen=True)
class NrrdArray:
    """An NRRD file as it is stored.

    Attributes:
        name: the file's.
        standard: the format's own fields, by lower-case name.
        fields: key-value pairs, and those fields that the format does not know, names as written.
        kinds: of each axis, lower case; ``"domain"`` where the file says nothing.
        values: an axis for each size, the first runs fastest in the file.
    """

    name: str
    standard: dict[str, str]
    fields: dict[str, str]
    kinds: tuple[str, ...]
    values: NDArray[Any]

    def grid(self) -> tuple[Floats, Floats] | None:
        """Steps (3, 3) along the three axes in space, one a row, and origin (3,), LPS; None where it says nothing."""
        vectors = re.findall(r"\(([^)]*)\)", self.standard.get("space directions", ""))
        turn = TURNS.get(self.standard.get("space", "").lower())
        try:
            steps = np.array([[float(part) for part in vector.split(",")] for vector in vectors])
            origin = np.array([float(part) for part in self.standard.get("space origin", "").strip("() ").split(",")])
        except ValueError:
            return None
        if turn is None or steps.shape != (3, 3) or origin.shape != (3,):
            return None
        return steps * [*turn, 1.0], origin * [*turn, 1.0]


STANDARD = (
    "dimension", "type", "block size", "blocksize", "encoding", "endian", "content", "old min", "oldmin", "old max",
    "oldmax", "min", "max", "data file", "datafile", "line skip", "lineskip", "byte skip", "byteskip", "number",
    "sample units", "sampleunits", "sizes", "spacings", "thicknesses", "axis mins", "axismins", "axis maxs",
    "axismaxs", "centers", "centerings", "labels", "units", "kinds", "space", "space dimension", "space units",
    "space origin", "space directions", "measurement frame",
)  # fmt: skip


def read_nrrd_array(path: Path) -> NrrdArray:
    """Read a ``.nrrd`` or ``.nhdr`` file of two to five axes, raw, gzip or bzip2.

    Raises:
        StudyError: bad magic, a header that does not end or says a thing twice, a size, type or encoding that is
            missing or not supported, truncated or damaged data.
    """
    name = path.name
    with path.open("rb") as file:
        magic = file.readline(16)
        if not NRRD_MAGIC.fullmatch(magic):
            raise StudyError(f"{name}: expected the magic NRRD0001 to NRRD0005, got {magic[:12]!r}; fetch it again")
        standard, fields = _header(file, name)
        end = file.tell()
    sizes = standard.get("sizes", "").split()
    n_axes = standard.get("dimension", "")
    if not 2 <= len(sizes) <= MAX_AXES or n_axes != str(len(sizes)) or not all(_is_size(part) for part in sizes):
        raise StudyError(
            f"{name}: expected 'dimension' and as many 'sizes', got {n_axes!r} and {standard.get('sizes')!r}; export it"
            " again"
        )
    kinds = standard.get("kinds", " ".join(["domain"] * len(sizes))).lower().split()
    if len(kinds) != len(sizes):
        raise StudyError(f"{name}: expected a kind for each of {len(sizes)} axes, got {standard['kinds']!r}; mend it")
    stored = _stored(path, standard, [int(part) for part in sizes], end)
    values = read_pixels(stored, name).reshape([int(part) for part in sizes], order="F")
    return NrrdArray(name, standard, fields, tuple(kinds), values)


def _is_size(part: str) -> bool:
    return part.isascii() and part.isdigit() and int(part) > 0


def _header(file: IO[bytes], name: str) -> tuple[dict[str, str], dict[str, str]]:
    """Standard fields and all others, up to the empty line that ends the header (or the end of a detached one)."""
    standard: dict[str, str] = {}
    fields: dict[str, str] = {}
    while raw := file.readline(MAX_LINE):
        line = raw.decode("utf-8", errors="replace").strip()
        if not line:
            return standard, fields
        if line.startswith("#"):
            continue
        key, colon, value = line.partition(":")
        if not colon or not raw.endswith(b"\n"):
            raise StudyError(f"{name}: expected 'field: value' in the header, got {line[:40]!r}; it is damaged")
        pair = value.startswith("=")  # key:=value belongs to whoever wrote it, whatever the key
        key, value = key.strip(), value.removeprefix("=").strip()
        place, known = (standard, key.lower()) if key.lower() in STANDARD and not pair else (fields, key)
        if place.setdefault(known, value) != value:
            raise StudyError(
                f"{name}: expected {key!r} once in the header, got {place[known][:40]!r} and {value[:40]!r}; delete one"
            )
    if "data file" not in standard and "datafile" not in standard:
        raise StudyError(f"{name}: expected an empty line after the header, got the end of a truncated file")
    return standard, fields


def _stored(path: Path, standard: dict[str, str], sizes: list[int], end: int) -> Stored:
    """Where the values are, and how they are stored."""
    name = path.name
    kind = next((code for code, names in NRRD_TYPES.items() if standard.get("type", "").lower() in names), None)
    if kind is None:
        raise StudyError(f"{name}: expected a type such as uint8, got {standard.get('type')!r}; export it again")
    endian = standard.get("endian", "").lower()
    if endian not in ("little", "big") and kind[1] != "1":
        raise StudyError(f"{name}: expected 'endian' little or big, got {standard.get('endian')!r}; export it again")
    encoding = ENCODINGS.get(standard.get("encoding", "").lower())
    skips = [standard.get(key, "0") for key in ("line skip", "lineskip", "byte skip", "byteskip")]
    if encoding is None or set(skips) != {"0"}:
        raise StudyError(
            f"{name}: expected encoding raw, gzip or bzip2 and no skipped bytes, got {standard.get('encoding')!r} and"
            f" skips {skips}; export it again"
        )
    apart = standard.get("data file") or standard.get("datafile")
    data, offset = (beside(path, apart, name), 0) if apart else (path, end)
    dtype = np.dtype(kind).newbyteorder(">" if endian == "big" else "<")
    return Stored((math.prod(sizes), 1, 1), dtype, data, offset, encoding)
