"""Headers of NIfTI files (version 1, all that ITK reads): whatever they state twice must agree."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.files.headers import ORTHOGONAL_ATOL, check_origin, check_shape, check_spacing
from study.files.stored import Stored, unpacked
from study.types import Floats

PIXELS = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
COLOUR_AND_COMPLEX = (32, 128, 1792, 2304)
MILLIMETRES, UNKNOWN_UNIT = 2, 0
UNITS = {1: "metres", 3: "micrometres"}
AFFINE_ATOL = 0.5  # of a voxel: near half a turn a quaternion of single precision is off by a tenth of that

LAYOUT = [
    ("dim", "8i2", 40), ("datatype", "i2", 70), ("bitpix", "i2", 72), ("pixdim", "8f4", 76), ("vox_offset", "f4", 108),
    ("scl_slope", "f4", 112), ("scl_inter", "f4", 116), ("xyzt_units", "u1", 123), ("qform_code", "i2", 252),
    ("sform_code", "i2", 254), ("quatern", "3f4", 256), ("qoffset", "3f4", 268), ("srow", "(3,4)f4", 280),
    ("magic", "S4", 344),
]  # fmt: skip
HEADER_BYTES, HEADER_2_BYTES = 348, 540
MAGIC = b"n+1"


def read_nifti_header(path: Path, name: str) -> Stored:
    """Check the header of a ``.nii`` or ``.nii.gz`` file.

    Raises:
        StudyError: a damaged stream, bad magic, or a header whose size, type, spacing, unit, origin or orientation is
            missing, impossible or contradicts itself.
    """
    packed = path.name.lower().endswith(".gz")
    with path.open("rb") as file:
        stream = unpacked(file, "gzip" if packed else "raw", name)
        start = b""
        for block in stream:
            start += block
            if len(start) >= HEADER_BYTES:
                break
        try:
            return _checked(_fields(start, name), path, packed, name)
        except StudyError:
            for _ in stream:  # of a damaged file its checksum speaks, not what its header seems to say
                pass
            raise


def _fields(start: bytes, name: str) -> dict[str, Any]:
    orders: tuple[Literal["<", ">"], ...] = ("<", ">")
    for order in orders:
        stated = int.from_bytes(start[:4], "little" if order == "<" else "big")
        if stated == HEADER_2_BYTES:
            raise StudyError(f"{name}: expected NIfTI of version 1, got version 2; save it as .nrrd or as version 1")
        if len(start) >= HEADER_BYTES and stated == HEADER_BYTES:
            names, formats, offsets = zip(*LAYOUT, strict=True)
            kind = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": HEADER_BYTES})
            record = np.frombuffer(start, kind.newbyteorder(order), count=1)[0]
            if record["magic"] != MAGIC:
                raise StudyError(
                    f"{name}: expected the magic {MAGIC!r} of a NIfTI file with its pixels, got {record['magic']!r};"
                    " an Analyze file or a header without pixels? save it as .nii.gz"
                )
            return {key: record[key] for key in names} | {"order": order}
    raise StudyError(f"{name}: expected a NIfTI header, got a truncated or damaged file; fetch it again")


def _checked(header: dict[str, Any], path: Path, packed: bool, name: str) -> Stored:
    n_dims = int(header["dim"][0])
    if not 1 <= n_dims <= 7 or (header["dim"][1 : n_dims + 1] < 1).any():
        raise StudyError(f"{name}: expected sizes of 1-7 axes, got dim {header['dim'].tolist()}; export it again")
    code, bits = int(header["datatype"]), int(header["bitpix"])
    if code in COLOUR_AND_COMPLEX:
        raise StudyError(f"{name}: expected one value a voxel, got datatype {code}; colour or complex image?")
    if code not in PIXELS or np.dtype(PIXELS[code]).itemsize * 8 != bits:
        raise StudyError(
            f"{name}: expected a number type and its size, got datatype {code} of {bits} bits; export it again"
        )
    shape = check_shape([int(n) for n in header["dim"][1 : n_dims + 1]], name)
    _check_geometry(header, shape, name)
    offset = float(header["vox_offset"])
    if not (offset.is_integer() and HEADER_BYTES + 4 <= offset < 1 << 40):
        raise StudyError(f"{name}: expected the pixels behind the header, got vox_offset {offset:g}; export it again")
    slope, intercept = float(header["scl_slope"]), float(header["scl_inter"])
    if not np.isfinite([slope, intercept]).all():
        raise StudyError(
            f"{name}: expected a finite rescaling, got scl_slope {slope}, scl_inter {intercept}; repair it"
        )
    if slope == 0:  # the standard's way to say: none
        slope, intercept = 1.0, 0.0
    dtype = np.dtype(PIXELS[code]).newbyteorder(header["order"])
    return Stored(shape, dtype, path, int(offset), "gzip" if packed else "raw", packed, slope, intercept)


def _check_geometry(header: dict[str, Any], shape: tuple[int, int, int], name: str) -> None:
    unit = int(header["xyzt_units"]) & 7
    if unit not in (MILLIMETRES, UNKNOWN_UNIT):  # many writers leave it out; the standard's unit is mm
        raise StudyError(
            f"{name}: expected mm as the unit of space, got {UNITS.get(unit, f'code {unit}')} in xyzt_units; export it"
            " again in mm"
        )
    spacing = np.asarray(header["pixdim"][1:4], dtype=np.float64)
    check_spacing(spacing, name, "pixdim")
    with_qform, with_sform = int(header["qform_code"]) > 0, int(header["sform_code"]) > 0
    if not (with_qform or with_sform):
        raise StudyError(
            f"{name}: expected a qform or sform in the NIfTI header, got an unknown orientation (both codes are 0);"
            " export it again with its affine"
        )
    if with_sform:
        _check_sform(header, spacing, name)
    if with_qform:
        qform = _qform(header, spacing, name)
        if with_sform:
            _check_agreement(qform, np.asarray(header["srow"], dtype=np.float64), shape, spacing, name)


def _check_sform(header: dict[str, Any], spacing: Floats, name: str) -> None:
    sform = np.asarray(header["srow"], dtype=np.float64)
    check_origin(sform[:, 3], name, "sform")
    if not np.isfinite(sform).all():
        raise StudyError(f"{name}: expected a finite sform, got {sform.tolist()}; repair the header")
    steps = np.linalg.norm(sform[:, :3], axis=0)
    axes = sform[:, :3] / np.maximum(steps, 1e-12)
    if steps.min() > 0 and not np.allclose(axes.T @ axes, np.eye(3), atol=ORTHOGONAL_ATOL):
        raise StudyError(
            f"{name}: expected orthogonal axes, got a sheared sform (gantry tilt?); resample it to an orthogonal grid"
        )
    if not np.allclose(steps, spacing, rtol=1e-3):
        raise StudyError(
            f"{name}: expected one voxel spacing, got {spacing.round(4).tolist()} mm in pixdim and"
            f" {steps.round(4).tolist()} mm in the sform; repair the one that is wrong"
        )


def _qform(header: dict[str, Any], spacing: Floats, name: str) -> Floats:
    """The affine (3, 4) that the quaternion states."""
    origin = np.asarray(header["qoffset"], dtype=np.float64)
    check_origin(origin, name, "qoffset")
    b, c, d = (float(part) for part in header["quatern"])
    rest = 1.0 - (b * b + c * c + d * d)
    if not rest > -1e-4 or not np.isfinite(header["pixdim"][0]):
        raise StudyError(
            f"{name}: expected a unit quaternion in the qform, got {[b, c, d]} and qfac {header['pixdim'][0]};"
            " repair the header"
        )
    rotation = Rotation.from_quat([b, c, d, max(rest, 0.0) ** 0.5]).as_matrix()
    handed = np.array([1.0, 1.0, -1.0 if header["pixdim"][0] < 0 else 1.0])
    return np.column_stack([rotation * spacing * handed, origin])


def _check_agreement(qform: Floats, sform: Floats, shape: tuple[int, int, int], spacing: Floats, name: str) -> None:
    """Both affines put the corners at the same places; which of two is right nobody can know."""
    corners = np.array([(*corner, 1) for corner in itertools.product(*[(0, n - 1) for n in shape])], dtype=np.float64)
    off_mm = float(np.linalg.norm(corners @ (qform - sform).T, axis=1).max())
    if off_mm > AFFINE_ATOL * spacing.min():
        raise StudyError(
            f"{name}: expected one place in space, got a qform and an sform whose corners are {off_mm:.2f} mm apart;"
            " set the code of the wrong one to 0"
        )
