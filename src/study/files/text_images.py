"""Headers of NRRD and MetaImage files: whatever they leave out or state twice differently is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from study.errors import StudyError
from study.files.headers import beside, check_shape, check_spacing, numbers, read_text_header
from study.files.stored import Encoding, Stored
from study.types import Floats

NRRD_MAGIC = re.compile(rb"NRRD000[1-5]\r?\n")
SPACES = ("left-posterior-superior", "lps", "right-anterior-superior", "ras")
MILLIMETRES = ("mm", "millimeter", "millimetre", "millimeters", "millimetres")
ENCODINGS: dict[str, Encoding] = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2"}
NRRD_TYPES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i8": ("longlong", "long long", "long long int", "signed long long", "signed long long int", "int64", "int64_t"),
    "u8": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "f4": ("float",),
    "f8": ("double",),
}
META_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
    "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
META_ORIGINS = ("offset", "position", "origin")
META_AXES = ("transformmatrix", "rotation", "orientation")
META_LETTERS = ("RL", "AP", "IS")  # an axis named R runs from right to left, which is +x of LPS
CLEAR_COSINE = 0.75  # beyond it an axis has one name only


def read_nrrd_header(path: Path, name: str) -> Stored:
    """Check the header of a ``.nrrd`` or ``.nhdr`` file.

    Raises:
        StudyError: bad magic, or a size, type, encoding, spacing, unit, space or origin that is missing, not
            supported, or contradicts itself.
    """
    with path.open("rb") as file:
        magic = file.readline(16)
    if not NRRD_MAGIC.fullmatch(magic):
        raise StudyError(f"{name}: expected the magic NRRD0001 to NRRD0005, got {magic[:12]!r}; fetch it again")
    fields, end = read_text_header(path, name, end="")
    sizes = fields.get("sizes", "").split()
    if not sizes or not all(size.isdigit() for size in sizes) or fields.get("dimension") != str(len(sizes)):
        raise StudyError(
            f"{name}: expected 'dimension' and as many 'sizes', got {fields.get('dimension')!r} and"
            f" {fields.get('sizes')!r}; export it again"
        )
    _check_nrrd_space(fields, name)
    kinds = fields.get("kinds", "").split()
    if any(kind not in ("domain", "space", "???", "none") for kind in kinds):
        raise StudyError(f"{name}: expected one value a voxel, got kinds {fields['kinds']!r}; colour or vector image?")
    shape = check_shape([int(size) for size in sizes], name)
    _check_nrrd_directions(fields, name)
    kind = next((code for code, names in NRRD_TYPES.items() if fields.get("type", "").lower() in names), None)
    if kind is None:
        raise StudyError(f"{name}: expected a type such as short, got {fields.get('type')!r}; export it again")
    endian = fields.get("endian", "").lower()
    if endian not in ("little", "big") and kind[1] != "1":
        raise StudyError(f"{name}: expected 'endian' little or big, got {fields.get('endian')!r}; export it again")
    encoding = ENCODINGS.get(fields.get("encoding", "").lower())
    skips = [fields.get(key, "0") for key in ("line skip", "lineskip", "byte skip", "byteskip")]
    if encoding is None or set(skips) != {"0"}:
        raise StudyError(
            f"{name}: expected encoding raw, gzip or bzip2 and no skipped bytes, got {fields.get('encoding')!r} and"
            f" skips {skips}; export it again"
        )
    dtype = np.dtype(kind).newbyteorder(">" if endian == "big" else "<")
    apart = fields.get("data file") or fields.get("datafile")
    return Stored(shape, dtype, beside(path, apart, name) if apart else path, 0 if apart else end, encoding)


def _check_nrrd_space(fields: dict[str, str], name: str) -> None:
    if not ({"space directions", "spacings"} & fields.keys()):
        raise StudyError(f"{name}: expected 'space directions' in the NRRD header, got no spacing; export it again")
    if "space directions" not in fields or "space" not in fields:
        raise StudyError(
            f"{name}: expected 'space' and 'space directions' in the NRRD header, got an unknown orientation; "
            "export it again as left-posterior-superior or right-anterior-superior"
        )
    if fields["space"].lower() not in SPACES:
        raise StudyError(
            f"{name}: expected the space left-posterior-superior or right-anterior-superior, got {fields['space']!r};"
            " export it again as one of them"
        )
    units = [unit for unit in re.split(r'["\s]+', fields.get("space units", "").lower()) if unit not in ("", "???")]
    if any(unit not in MILLIMETRES for unit in units):
        raise StudyError(
            f"{name}: expected mm as the unit of space, got space units {fields['space units']}; export it again in mm"
        )
    twice = next((key for key in ("spacings", "units", "axis mins", "axis maxs") if key in fields), None)
    if twice:  # the format forbids it
        raise StudyError(
            f"{name}: expected one voxel spacing and unit, got {twice} {fields[twice]} beside 'space directions';"
            " delete the one that is wrong"
        )


def _check_nrrd_directions(fields: dict[str, str], name: str) -> None:
    vectors = re.findall(r"\(([^)]*)\)", fields["space directions"])
    if len(vectors) != 3:
        raise StudyError(f"{name}: expected 3 space directions, got {fields['space directions']!r}; export it again")
    steps = np.linalg.norm([numbers(vector, 3, name, "a space direction") for vector in vectors], axis=1)
    check_spacing(steps, name, "space directions of")
    if "space origin" not in fields:
        raise StudyError(f"{name}: expected a 'space origin' in the NRRD header, got none; export it again")
    numbers(fields["space origin"].strip("()"), 3, name, "the space origin")


def read_metaimage_header(path: Path, name: str) -> Stored:
    """Check the header of an ``.mha`` or ``.mhd`` file.

    Raises:
        StudyError: no image, or a size, type, encoding, spacing, unit, orientation or origin that is missing, not
            supported, or contradicts itself.
    """
    with path.open("rb") as file:
        first = file.readline(64)
    if not re.match(rb"\s*\w+\s*=", first):
        raise StudyError(f"{name}: expected a MetaImage header, got {first[:20]!r}; fetch it again")
    fields, end = read_text_header(path, name, end="elementdatafile")
    if fields.get("objecttype", "Image").lower() != "image":
        raise StudyError(f"{name}: expected ObjectType Image, got {fields['objecttype']!r}; export it as an image")
    sizes = fields.get("dimsize", "").split()
    if not sizes or not all(size.isdigit() for size in sizes) or fields.get("ndims") != str(len(sizes)):
        raise StudyError(
            f"{name}: expected NDims and as many sizes in DimSize, got {fields.get('ndims')!r} and"
            f" {fields.get('dimsize')!r}; export it again"
        )
    if fields.get("elementnumberofchannels", "1") != "1":
        raise StudyError(
            f"{name}: expected one value a voxel, got {fields['elementnumberofchannels']}; colour or vector image?"
        )
    shape = check_shape([int(size) for size in sizes], name)
    _check_meta_geometry(fields, name)
    kind = META_TYPES.get(fields.get("elementtype", "").upper())
    if kind is None:
        raise StudyError(
            f"{name}: expected ElementType {', '.join(META_TYPES)}, got {fields.get('elementtype')!r}; convert it"
        )
    _check_meta_storage(fields, name)
    big = "true" in (fields.get(key, "").lower() for key in ("binarydatabyteordermsb", "elementbyteordermsb"))
    packed = fields.get("compresseddata", "false").lower() == "true"
    apart = fields["elementdatafile"]
    data, offset = (path, end) if apart.upper() == "LOCAL" else (beside(path, apart, name), 0)
    stated, n_file = fields.get("compresseddatasize", "").split(), data.stat().st_size - offset
    if packed and stated and stated != [str(n_file)]:
        raise StudyError(
            f"{name}: expected {stated[0]} compressed bytes, got {n_file} in a truncated or damaged file; fetch it"
            " again"
        )
    return Stored(shape, np.dtype(kind).newbyteorder(">" if big else "<"), data, offset, "zlib" if packed else "raw")


def _check_meta_storage(fields: dict[str, str], name: str) -> None:
    """Storage that ITK would read in a way of its own."""
    plain = {"binarydata": "true", "headersize": "0", "elementtointensityfunctionslope": "1",
             "elementtointensityfunctionoffset": "0"}  # fmt: skip
    for key, value in plain.items():
        if key in fields and fields[key].lower().removesuffix(".0") != value:
            raise StudyError(
                f"{name}: expected {key} {value} in the MetaImage header, got {fields[key]!r}; export it again"
            )


def _check_meta_geometry(fields: dict[str, str], name: str) -> None:
    if not ({"elementspacing", "elementsize"} & fields.keys()):
        raise StudyError(f"{name}: expected ElementSpacing in the MetaImage header, got none; export it again")
    _one_fact(fields, ("elementspacing", "elementsize"), 3, name, "ElementSpacing", positive=True)
    if fields.get("distanceunits", "mm").lower() not in (*MILLIMETRES, "?"):
        raise StudyError(
            f"{name}: expected mm as the unit of space, got DistanceUnits {fields['distanceunits']!r}; export it again"
            " in mm"
        )
    if not (set(META_AXES) & fields.keys()):
        raise StudyError(
            f"{name}: expected TransformMatrix in the MetaImage header, got an unknown orientation; export it again"
        )
    axes = _one_fact(fields, META_AXES, 9, name, "TransformMatrix").reshape(3, 3)  # row: where an index axis points
    if not (set(META_ORIGINS) & fields.keys()):
        raise StudyError(f"{name}: expected Offset in the MetaImage header, got no origin; export it again")
    _one_fact(fields, META_ORIGINS, 3, name, "Offset, the origin,")
    letters = fields.get("anatomicalorientation", "???").upper()
    for letter, axis in zip(letters, axes, strict=False):
        along = int(np.abs(axis).argmax())
        clear = letter != "?" and abs(axis[along]) > CLEAR_COSINE
        if clear and letter != META_LETTERS[along][int(axis[along] < 0)]:
            raise StudyError(
                f"{name}: expected one orientation, got AnatomicalOrientation {letters} and TransformMatrix"
                f" {axes.tolist()}, which contradicts it; repair the one that is wrong"
            )


def _one_fact(
    fields: dict[str, str], keys: tuple[str, ...], count: int, name: str, what: str, *, positive: bool = False
) -> Floats:
    """The numbers that every key of one meaning states."""
    found = [numbers(fields[key], count, name, what) for key in keys if key in fields]
    for values in found:
        if positive:
            check_spacing(values, name, what)
        if not np.allclose(values, found[0], rtol=1e-3, atol=1e-6):
            raise StudyError(
                f"{name}: expected one {what} in the header, got {[values.tolist() for values in found]}; delete the"
                " one that is wrong"
            )
    return found[0]
