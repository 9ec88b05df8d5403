"""Sequence files as PLUS and 3D Slicer write them: grey frames and every field of the header, MetaImage or NRRD.

SimpleITK reads both, but it stops before the checksum of a compressed stream, takes the list axis of PLUS's NRRD for
channels, and fills in what a header lacks; so headers are read here, and the tests compare with SimpleITK.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.errors import StudyError
from study.files.headers import beside
from study.files.nrrd_arrays import NRRD_SUFFIXES, NrrdArray, read_nrrd_array
from study.types import Floats

MAX_LINE = 1 << 16
MAX_DEFLATE_RATIO = 1032  # zlib cannot do better: a header that asks for more is wrong
ELEMENT_TYPES = {"MET_UCHAR": "u1", "MET_CHAR": "i1", "MET_USHORT": "u2", "MET_SHORT": "i2", "MET_FLOAT": "f4"}
ORIENTATION = "UltrasoundImageOrientation"
# What PLUS calls in an NRRD file by another name than in a metafile.
NRRD_NAMES = {"ultrasound image orientation": ORIENTATION, "ultrasound image type": "UltrasoundImageType"}
LISTS = ("list", "time")
COLOURS = ("vector", "rgb-color", "rgba-color", "3-color", "4-color", "3-vector", "4-vector")
LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601; grey pixels stay as they are

Header = dict[str, str]


@dataclass(frozen=True)
class Sequence:
    """A sequence file, its frames in grey as they are stored.

    Attributes:
        name: the file's.
        header: fields of the whole file, by their names in a metafile.
        frames: fields of each frame, by their names without the frame's number.
        pixels: (f, h, w), not turned.
        notes: what was done to the pixels, one sentence each.
    """

    name: str
    header: Header
    frames: list[Header]
    pixels: NDArray[Any]
    notes: tuple[str, ...]

    @property
    def content(self) -> str | None:
        """``"masks"`` or ``"images"`` in files of `write_plus`, None in those of other programs."""
        return self.header.get("Study_Content")

    def turned(self, without: str = "MF") -> NDArray[Any]:
        """Pixels (f, h, w) in the orientation MF; a file that states none has the orientation ``without``."""
        return turned(self.pixels, self.header.get(ORIENTATION, without), self.name)


def read_sequence(path: Path) -> Sequence:
    """Read a sequence file, ``.mha``, ``.mhd``, ``.nrrd`` or ``.nhdr``, compressed or not, grey or RGB.

    Raises:
        StudyError: no such file, another format, truncated, damaged or mis-sized data, or frames that are no images.
    """
    if not path.is_file():
        raise StudyError(f"{path.name}: expected a sequence file, got nothing at {path}; check the path")
    if path.suffix.lower() in NRRD_SUFFIXES:
        found = read_nrrd_array(path)
        header = {NRRD_NAMES.get(key.lower(), key): value for key, value in found.fields.items()}
        stack = _frames_first(found, path.name)
    else:
        header, stack = _read_metafile(path)
    grey, notes = _grey(stack, path.name)
    frames = _frame_fields(path.name, header, len(grey))
    for fields in frames:
        if "Status" in fields:  # as PLUS calls it in an NRRD file
            fields.setdefault("ImageStatus", fields.pop("Status"))
    header = {key: value for key, value in header.items() if not key.startswith("Seq_Frame")}
    return Sequence(path.name, header, frames, grey, notes)


def numbers_of(name: str, fields: Header, key: str, n: int, where: str = "") -> Floats:
    """``n`` numbers of a field.

    Raises:
        StudyError: no such field, another count, or no numbers.
    """
    try:
        numbers = np.array(fields[key].split(), dtype=np.float64)
    except KeyError:
        raise StudyError(f"{name}: {where}expected a field {key}, got none; the file is no tracked sequence") from None
    except ValueError:
        raise StudyError(f"{name}: {where}expected {n} numbers as {key}, got {fields[key][:40]!r}") from None
    if len(numbers) != n:
        raise StudyError(f"{name}: {where}expected {n} numbers as {key}, got {len(numbers)}; the header is damaged")
    return numbers


def turned(stack: NDArray[Any], orientation: str, name: str) -> NDArray[Any]:
    """From a PLUS orientation (first letter: the column axis; second: the row axis) to MF.

    Raises:
        StudyError: an orientation that is none.
    """
    orientation = orientation[:2].upper()
    if len(orientation) == 2 and orientation[0] in "FN" and orientation[1] in "MU":
        stack, orientation = stack.transpose(0, 2, 1), orientation[::-1]
    if len(orientation) != 2 or orientation[0] not in "MU" or orientation[1] not in "FN":
        raise StudyError(f"{name}: expected {ORIENTATION} like MF or UN, got {orientation!r}; correct it")
    return stack[:, :: -1 if orientation[1] == "N" else 1, :: -1 if orientation[0] == "U" else 1]


def _frame_fields(name: str, header: Header, n_frames: int) -> list[Header]:
    """The fields of each frame, by their names without the frame."""
    frames: list[Header] = [{} for _ in range(n_frames)]
    for key, value in header.items():
        if key.startswith("Seq_Frame"):
            number, _, field = key.removeprefix("Seq_Frame").partition("_")
            if not (number.isascii() and number.isdigit()) or int(number) >= n_frames:
                raise StudyError(
                    f"{name}: expected fields of {n_frames} frames (its size), got {key!r}; the file is mis-sized"
                )
            frames[int(number)][field] = value
    return frames


def _grey(stack: NDArray[Any], name: str) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Frames (f, h, w) out of (f, h, w) or (f, h, w, c), and what was done to them."""
    if stack.ndim == 3:
        return stack, ()
    channels = stack.shape[3]
    if channels == 1:
        return stack[..., 0], ()
    if channels not in (3, 4) or stack.dtype != np.uint8:
        raise StudyError(
            f"{name}: expected grey frames or 8-bit RGB, got {channels} channels of {stack.dtype}; convert to one"
            " channel"
        )
    grey = np.empty(stack.shape[:3], dtype=np.uint8)
    n_coloured = 0
    for image, out in zip(stack[..., :3], grey, strict=True):  # doubles of a whole sweep would be gigabytes
        out[...] = np.rint(image @ LUMA)
        n_coloured += int((np.ptp(image, axis=2) > 0).sum())
    share = 100 * n_coloured / grey.size
    what = "RGB" if channels == 3 else "RGBA (opacity left out)"
    return grey, (f"{what} frames were turned to grey (luma of BT.601); {share:.1f} % of their pixels had a colour",)


def _frames_first(found: NrrdArray, name: str) -> NDArray[Any]:
    """An NRRD array as (f, h, w) or (f, h, w, c), by the kinds of its axes."""
    kinds, sizes = found.kinds, found.values.shape
    lists = [axis for axis, kind in enumerate(kinds) if kind in LISTS]
    colours = [axis for axis, kind in enumerate(kinds) if kind in COLOURS]
    plane = [axis for axis in range(len(kinds)) if axis not in (*lists, *colours)]
    if not lists and len(plane) > 2:  # programs that know nothing of sequences take frames for slices
        lists = [plane.pop()]
    if len(plane) == 3 and sizes[plane[2]] == 1:  # a plane in space
        plane.pop()
    if len(plane) != 2 or len(lists) > 1 or len(colours) > 1:
        size = " x ".join(map(str, sizes))
        raise StudyError(
            f"{name}: expected columns, rows and frames, got {size} of the kinds {' '.join(kinds)}; a sequence of flat"
            " images is needed"
        )
    left_out = [axis for axis in range(len(kinds)) if axis not in (*lists, *colours, *plane)]
    ordered = found.values.transpose(*lists, plane[1], plane[0], *colours, *left_out)
    if left_out:
        ordered = ordered[..., 0]
    return np.ascontiguousarray(ordered if lists else ordered[None])


def _read_metafile(path: Path) -> tuple[Header, NDArray[Any]]:
    """Header and pixels (f, h, w) or (f, h, w, c) as they are stored."""
    header: Header = {}
    with path.open("rb") as file:
        while "ElementDataFile" not in header:
            line = file.readline(MAX_LINE)
            key, equals, value = line.decode("latin-1").partition("=")
            if not line.endswith(b"\n") or not equals or (not header and key.strip() != "ObjectType"):
                found = "the end of the file" if not line else f"{line[:40]!r}"
                what = "header lines up to ElementDataFile" if header else "ObjectType first"
                raise StudyError(
                    f"{path.name}: expected {what}, got {found}; the file is truncated or not a PLUS sequence metafile"
                )
            if header.setdefault(key.strip(), value.strip()) != value.strip():
                raise StudyError(
                    f"{path.name}: expected one value of {key.strip()}, got {header[key.strip()][:40]!r} and"
                    f" {value.strip()[:40]!r}; delete the wrong one"
                )
        data = file.read()
    if header["ElementDataFile"] != "LOCAL":
        data = beside(path, header["ElementDataFile"], path.name).read_bytes()
    shape, dtype = _metafile_shape(path, header)
    n_bytes = int(np.prod(shape)) * dtype.itemsize
    if header.get("CompressedData", "False") == "True":
        data = _inflate(path, header, data, n_bytes)
    if len(data) != n_bytes:
        raise StudyError(
            f"{path.name}: expected {n_bytes} bytes for {shape[0]} frames of {shape[2]} x {shape[1]}, got {len(data)};"
            " the file is truncated or its DimSize wrong"
        )
    stack = np.frombuffer(data, dtype=dtype).reshape(shape).astype(dtype.newbyteorder("="), copy=False)
    return header, stack


def _metafile_shape(path: Path, header: Header) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """(f, h, w), or (f, h, w, c) of several channels, and the type of a value."""
    channels = header.get("ElementNumberOfChannels", "1")
    if header["ObjectType"] != "Image" or not channels.isdigit() or not 1 <= int(channels) <= 4:
        raise StudyError(f"{path.name}: expected grey or RGB images, got another object; convert to one channel")
    kind = header.get("ElementType", "none")
    if kind not in ELEMENT_TYPES:
        raise StudyError(
            f"{path.name}: expected ElementType {', '.join(ELEMENT_TYPES)}, got {kind}; convert the pixels"
        )
    size = header.get("DimSize", "none").split()
    stated = header.get("NDims", str(len(size)))
    flat = len(size) == 3 or (len(size) == 4 and size[2] == "1")  # columns, rows, one slice, frames
    if not flat or stated != str(len(size)) or not all(part.isdigit() and int(part) > 0 for part in size):
        raise StudyError(
            f"{path.name}: expected DimSize of columns, rows and frames, got {header.get('DimSize')!r} with NDims"
            f" {stated}"
        )
    w, h, f = int(size[0]), int(size[1]), int(size[-1])
    dtype = np.dtype(ELEMENT_TYPES[kind])
    dtype = dtype.newbyteorder(">" if header.get("BinaryDataByteOrderMSB", "False") == "True" else "<")
    return ((f, h, w) if channels == "1" else (f, h, w, int(channels))), dtype


def _inflate(path: Path, header: Header, data: bytes, n_bytes: int) -> bytes:
    """Inflate ``data``, never to more than the header's size."""
    stated = header.get("CompressedDataSize", str(len(data)))
    if not stated.isdigit() or int(stated) != len(data):
        raise StudyError(
            f"{path.name}: expected {stated} compressed bytes, got {len(data)}; the file is truncated or mixed up"
        )
    if n_bytes > MAX_DEFLATE_RATIO * len(data):
        raise StudyError(
            f"{path.name}: expected {n_bytes} bytes by DimSize, but {len(data)} compressed ones cannot hold them;"
            " DimSize is wrong"
        )
    stream = zlib.decompressobj()
    try:
        pixels = stream.decompress(data, n_bytes)
        surplus = len(stream.decompress(stream.unconsumed_tail, 1))
    except zlib.error as error:
        raise StudyError(
            f"{path.name}: expected deflated pixels, got damaged data ({error}); copy the file again"
        ) from error
    if surplus:
        raise StudyError(f"{path.name}: expected {n_bytes} bytes by DimSize, got more; DimSize is wrong")
    if not stream.eof or stream.unused_data:  # the checksum stands at the stream's very end
        raise StudyError(
            f"{path.name}: expected pixels that end with their checksum, got a truncated stream or bytes behind it;"
            " copy the file again"
        )
    return pixels
