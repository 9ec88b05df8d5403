"""Headers of images, checked before the pixels are read: what SimpleITK would fill in silently is refused.

SimpleITK does not say that a header left the geometry out: it fills in 1 mm and an identity direction, and zeros for
voxels that are missing. A registration in millimetres cannot be built on that.
"""

from __future__ import annotations

import gzip
import math
import os
import re
import struct
import zlib
from pathlib import Path
from typing import IO

import SimpleITK as sitk

from study.errors import StudyError

NIFTI1_BYTES = 348  # header size, and its first field
ORTHOGONAL_ATOL = 1e-3  # direction cosines are stored with 4-6 digits


def check_header(path: Path, name: str) -> None:
    """A NIfTI, NRRD or MetaImage file states its spacing and orientation, holds all its bytes, and is 3-D and grey.

    Args:
        path: the file.
        name: for messages.

    Raises:
        StudyError: it does not; the message says what is missing.
    """
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    suffix = path.name.lower()
    if suffix.endswith((".nrrd", ".nhdr")):
        _check_nrrd(path, name)
    elif suffix.endswith((".mha", ".mhd")):
        _check_metaimage(path, name)
    else:
        _check_nifti(path, name)
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise explain(error, name) from error
    _check_size(reader, path, name)


def explain(error: Exception, name: str) -> StudyError:
    """ITK's paragraph as one line, with the remedy; ``name`` is the image's."""
    text = " ".join(str(error).split())
    reason = text.split("ITK ERROR:")[-1].strip()[:200]
    if "orthonormal" in text.lower() or "orthogonal" in text.lower():
        return StudyError(
            f"{name}: expected orthogonal axes, got a sheared grid (gantry tilt?); resample it to an orthogonal grid"
        )
    if "spacing" in text.lower():
        return StudyError(f"{name}: expected a positive voxel spacing, got none or zero; repair the header ({reason})")
    return StudyError(f"{name}: expected a readable image, got a truncated or damaged file; fetch it again ({reason})")


def _check_nrrd(path: Path, name: str) -> None:
    fields = _text_header(path, end="")
    if not ({"space directions", "spacings"} & fields.keys()):
        raise StudyError(f"{name}: expected 'space directions' in the NRRD header, got no spacing; export it again")
    if "space directions" not in fields or "space" not in fields:
        raise StudyError(
            f"{name}: expected 'space' and 'space directions' in the NRRD header, got an unknown orientation; "
            "export it again as left-posterior-superior or right-anterior-superior"
        )


def _check_metaimage(path: Path, name: str) -> None:
    fields = _text_header(path, end="elementdatafile")
    if not ({"elementspacing", "elementsize"} & fields.keys()):
        raise StudyError(f"{name}: expected ElementSpacing in the MetaImage header, got none; export it again")
    if not ({"transformmatrix", "rotation", "orientation"} & fields.keys()):
        raise StudyError(f"{name}: expected TransformMatrix in the MetaImage header, got an unknown orientation")


def _check_nifti(path: Path, name: str) -> None:
    """ITK replaces a zero spacing by 1 mm and missing voxels by zeros, without a word."""
    unpack = gzip.open if path.name.lower().endswith(".gz") else open
    with unpack(path, "rb") as stream:
        try:
            header = stream.read(NIFTI1_BYTES)
        except (OSError, EOFError) as error:
            raise explain(error, name) from error
        order = "<" if header[:4] == NIFTI1_BYTES.to_bytes(4, "little") else ">"
        if len(header) < NIFTI1_BYTES or struct.unpack_from(f"{order}i", header)[0] != NIFTI1_BYTES:
            if header[:4] in ((540).to_bytes(4, "little"), (540).to_bytes(4, "big")):
                return  # NIfTI-2, with another layout
            raise StudyError(f"{name}: expected a NIfTI header, got a truncated or damaged file; fetch it again")
        dims = struct.unpack_from(f"{order}8h", header, 40)
        bits = struct.unpack_from(f"{order}h", header, 72)[0]
        pixdim = struct.unpack_from(f"{order}8f", header, 76)
        first = int(struct.unpack_from(f"{order}f", header, 108)[0])
        codes = struct.unpack_from(f"{order}2h", header, 252)
        if codes == (0, 0):
            raise StudyError(
                f"{name}: expected a qform or sform in the NIfTI header, got an unknown orientation "
                "(both codes are 0); export it again with its affine"
            )
        if min(abs(step) for step in pixdim[1:4]) < 1e-6:
            raise StudyError(f"{name}: expected a positive voxel spacing, got pixdim {pixdim[1:4]}; repair the header")
        expected = first + math.prod(max(n, 1) for n in dims[1 : dims[0] + 1]) * bits // 8
        if _stream_bytes(path, stream, expected) < expected:
            raise StudyError(f"{name}: expected {expected} bytes, got a truncated or damaged file; fetch it again")


def _stream_bytes(path: Path, stream: IO[bytes] | gzip.GzipFile, expected: int) -> int:
    """Length of an open file's content; a gzip file states it in its last 4 bytes, else it is unpacked to count."""
    if not path.name.lower().endswith(".gz"):
        return path.stat().st_size
    with path.open("rb") as packed:
        packed.seek(-4, os.SEEK_END)
        if int.from_bytes(packed.read(4), "little") == expected % 2**32:
            return expected
    try:
        while stream.read(1 << 24):
            pass
        return stream.tell()
    except (OSError, EOFError, zlib.error):
        return 0


def _text_header(path: Path, end: str) -> dict[str, str]:
    """Lower-case keys of an NRRD (``key: value``) or MetaImage (``Key = value``) header, up to line ``end``."""
    fields: dict[str, str] = {}
    with path.open("rb") as stream:
        for raw in stream:
            line = raw.decode("latin-1").strip()
            if end == "" and line == "":
                break
            key, _, value = (part.strip() for part in re.sub("[:=]+", "\0", line, count=1).partition("\0"))
            if not line.startswith("#"):
                fields[key.lower()] = value
            if key.lower() == end and end:
                break
    return fields


def _check_size(reader: sitk.ImageFileReader, path: Path, name: str) -> None:
    if reader.GetDimension() != 3 or min(reader.GetSize()) < 2:
        size = " x ".join(str(n) for n in reader.GetSize())
        raise StudyError(f"{name}: expected a 3-D image, got {size}; give the whole series, one time point")
    if reader.GetNumberOfComponents() != 1:
        raise StudyError(
            f"{name}: expected one value a voxel, got {reader.GetNumberOfComponents()}; colour or vector image?"
        )
