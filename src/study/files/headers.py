"""What all headers of images must say, whatever their format; what SimpleITK would fill in silently is refused.

SimpleITK does not say that a header left the geometry out: it fills in 1 mm, an identity direction and an origin of
zero. A registration in millimetres cannot be built on that.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from study.errors import StudyError
from study.types import Floats

ORTHOGONAL_ATOL = 1e-3  # direction cosines are stored with 4-6 digits
MAX_LINE = 1 << 16
MAX_LINES = 10_000


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


def read_text_header(path: Path, name: str, end: str) -> tuple[dict[str, str], int]:
    """Lower-case keys of an NRRD (``key: value``) or MetaImage (``Key = value``) header, and where it ends.

    Args:
        path: the file.
        name: for messages.
        end: key of the last line; "" where an empty line, or the file's end, ends it.

    Raises:
        StudyError: no end, or a key that stands twice with different values.
    """
    fields: dict[str, str] = {}
    with path.open("rb") as stream:
        for _ in range(MAX_LINES):
            raw = stream.readline(MAX_LINE)
            line = raw.decode("latin-1").strip()
            if end == "" and line == "":
                return fields, stream.tell()
            key, _, value = (part.strip() for part in re.sub("[:=]+", "\0", line, count=1).partition("\0"))
            key = key.lower()
            if not line.startswith("#") and fields.setdefault(key, value) != value:
                raise StudyError(
                    f"{name}: expected {key!r} once in the header, got {fields[key]!r} and {value!r}; delete one"
                )
            if key == end:
                return fields, stream.tell()
            if not raw.endswith(b"\n"):
                break
    raise StudyError(f"{name}: expected a header that ends, got none or a truncated file; fetch it again")


def numbers(text: str, count: int, name: str, what: str) -> Floats:
    """``count`` finite numbers out of a header's field; ``what`` says which.

    Raises:
        StudyError: another count, no numbers, NaN or infinity.
    """
    try:
        found = np.array([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        found = np.empty(0)
    if len(found) != count or not np.isfinite(found).all():
        raise StudyError(f"{name}: expected {count} finite numbers as {what}, got {text[:80]!r}; export it again")
    return found


def check_spacing(spacing: Floats, name: str, what: str) -> None:
    """Every step between voxels (3) mm is a positive number.

    Raises:
        StudyError: zero, negative, NaN or infinite.
    """
    if not (np.isfinite(spacing).all() and (spacing > 1e-6).all()):
        raise StudyError(f"{name}: expected a positive voxel spacing, got {what} {spacing.tolist()}; repair the header")


def check_origin(origin: Floats, name: str, what: str) -> None:
    """The first voxel's place (3) mm is finite.

    Raises:
        StudyError: NaN or infinity.
    """
    if not np.isfinite(origin).all():
        raise StudyError(f"{name}: expected a finite origin, got {what} {origin.tolist()}; repair the header")


def check_shape(sizes: list[int], name: str) -> tuple[int, int, int]:
    """Sizes of a volume, further axes of one element dropped.

    Raises:
        StudyError: not 3-D.
    """
    shape = list(sizes)
    while len(shape) > 3 and shape[-1] == 1:
        shape.pop()
    if len(shape) != 3 or min(shape) < 2:
        size = " x ".join(str(n) for n in sizes)
        raise StudyError(f"{name}: expected a 3-D image, got {size}; give the whole series, one time point")
    return shape[0], shape[1], shape[2]


def beside(path: Path, data_file: str, name: str) -> Path:
    """The one file of pixels that a header names, relative to the header's folder.

    Raises:
        StudyError: a list or a pattern of files, or none there.
    """
    data = path.parent / data_file
    if data_file.startswith("LIST") or "%" in data_file or not data.is_file():
        raise StudyError(
            f"{name}: expected one file of pixels beside the header, got {data_file!r}; save header and pixels as one"
        )
    return data


def itk_geometry(path: Path, shape: tuple[int, int, int], name: str) -> tuple[Floats, Floats, Floats]:
    """Spacing (3) mm, axes (3, 3) and origin (3) mm in LPS+ as ITK reads them, whose size must be ``shape``.

    Raises:
        StudyError: ITK cannot read the header, or reads another size out of it.
    """
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise explain(error, name) from error
    if tuple(reader.GetSize())[:3] != shape or math.prod(reader.GetSize()[3:]) != 1:
        raise StudyError(f"{name}: expected {shape} voxels, got {reader.GetSize()} from ITK; export it again")
    axes = np.array(reader.GetDirection()).reshape(reader.GetDimension(), -1)[:3, :3]
    return np.array(reader.GetSpacing()[:3]), axes, np.array(reader.GetOrigin()[:3])
