"""Where the image lies on the probe: PLUS's matrix from pixels, and the configuration that PLUS keeps it in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.types import Floats, RigidTransform

METRES_BELOW_MM = 0.005  # no probe for a chest has pixels so small
MAX_CONFIG_BYTES = 10_000_000  # a configuration is kilobytes
SQUARE = 1e-2  # cosine between the image's axes


@dataclass(frozen=True)
class PixelCalibration:
    """A calibration as far as a file knows it.

    Attributes:
        pixel_spacing_mm: (sx, sy) mm.
        T_probe_image: image frame (mm) to probe.
        latency_s: s; PLUS's own files have none, since their stamps are corrected.
        notes: where it is from, a sentence each.
    """

    pixel_spacing_mm: tuple[float, float] | None = None
    T_probe_image: RigidTransform | None = None
    latency_s: float | None = None
    notes: tuple[str, ...] = ()


def matrix_of(numbers: ArrayLike, name: str, key: str, where: str = "") -> Floats:
    """A (4, 4) matrix of 16 numbers, whose last row is 0 0 0 1.

    Raises:
        StudyError: another last row, NaN or infinity.
    """
    matrix = np.asarray(numbers, dtype=np.float64).reshape(4, 4)
    if not np.isfinite(matrix).all():
        raise StudyError(f"{name}: {where}expected finite numbers as {key}, got NaN or infinity; write it again")
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        raise StudyError(
            f"{name}: {where}expected 0 0 0 1 as the last row of {key}, as proper rotations with a translation"
            f" have, got {matrix[3].tolist()}; a transposed matrix? write it row by row"
        )
    return matrix


def pixel_calibration(matrix: Floats, name: str, key: str) -> PixelCalibration:
    """Pixel spacing and rigid part of PLUS's (4, 4) matrix from pixels to the probe, mm.

    The identity, which PLUS holds before a calibration, is none.

    Raises:
        StudyError: sheared or empty axes, or metres.
    """
    if np.array_equal(matrix, np.eye(4)):
        return PixelCalibration(notes=(f"{key} of {name} is the identity, as before a calibration: not used",))
    x, y = matrix[:3, 0], matrix[:3, 1]
    sx, sy = float(np.linalg.norm(x)), float(np.linalg.norm(y))
    if not (sx > 0 and sy > 0 and abs(x @ y) < SQUARE * sx * sy):
        raise StudyError(f"{name}: expected {key} with square axes, got a sheared or empty one; calibrate again")
    if max(sx, sy) < METRES_BELOW_MM:
        raise StudyError(
            f"{name}: expected {key} from pixels to mm, got pixels of {sx:g} x {sy:g} mm; in metres? multiply its"
            " first three rows by 1000"
        )
    rotation, _ = Rotation.align_vectors([x / sx, y / sy], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return PixelCalibration((sx, sy), RigidTransform(rotation.as_matrix(), matrix[:3, 3]))


def config_beside(recording: Path) -> Path | None:
    """The ``<name>_config.xml`` that PLUS leaves beside a recording; None where there is none.

    The name is the recording's without its last ending (``a.igs_config.xml``) or without all (``a_config.xml``).

    Raises:
        StudyError: both are there.
    """
    stems = dict.fromkeys([recording.name.rpartition(".")[0], recording.name.partition(".")[0]])
    there = [path for stem in stems if (path := recording.with_name(f"{stem}_config.xml")).is_file()]
    if len(there) > 1:
        raise StudyError(
            f"{recording.name}: expected one configuration beside it, got {' and '.join(path.name for path in there)};"
            " name the right one with config="
        )
    return there[0] if there else None


def read_config(path: Path, probe: str = "Probe") -> PixelCalibration | None:
    """The calibration of a PLUS configuration: its ``Transform`` from ``Image`` to the probe; None without one.

    Args:
        path: a ``PlusConfiguration``, .xml.
        probe: the probe's frame in it.

    Raises:
        StudyError: no such file, no XML, a document type (which no configuration has, and entities hide in), two
            such transforms that differ, or one that is no calibration.
    """
    root = _parse(path)
    name, key = path.name, f"the Transform from Image to {probe}"
    if root.tag != "PlusConfiguration":
        raise StudyError(f"{name}: expected a PlusConfiguration, got <{root.tag}>; give the file of PLUS")
    matrices = []
    for element in root.iterfind(".//CoordinateDefinitions/Transform"):
        if (element.get("From"), element.get("To")) == ("Image", probe):
            numbers = _sixteen(element.get("Matrix", ""), name, key)
            matrices.append(matrix_of(numbers, name, key))
    if not matrices:
        return None
    if not all(np.array_equal(matrix, matrices[0]) for matrix in matrices):
        raise StudyError(f"{name}: expected one matrix as {key}, got {len(matrices)} that differ; delete the old ones")
    return pixel_calibration(matrices[0], name, key)


def _sixteen(text: str, name: str, key: str) -> Floats:
    try:
        numbers = np.array(text.split(), dtype=np.float64)
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != 16:
        raise StudyError(f"{name}: expected 16 numbers as {key}, got {text[:40]!r}; write it row by row")
    return numbers


def _parse(path: Path) -> ElementTree.Element:
    if not path.is_file():
        raise StudyError(f"{path.name}: expected a PLUS configuration, got nothing at {path}; check the path")
    if path.stat().st_size > MAX_CONFIG_BYTES:
        raise StudyError(f"{path.name}: expected a PLUS configuration, got {path.stat().st_size} bytes; another file?")
    content = path.read_bytes()

    def refuse(*_: object) -> NoReturn:
        raise StudyError(f"{path.name}: expected a configuration without a document type, got one; delete <!DOCTYPE>")

    # Whatever entities could do (files read, memory filled) starts with a document type.
    watch = expat.ParserCreate()
    watch.StartDoctypeDeclHandler = refuse
    try:
        watch.Parse(content, True)
        return ElementTree.fromstring(content)
    except (expat.ExpatError, ElementTree.ParseError, ValueError, LookupError) as error:
        raise StudyError(f"{path.name}: expected XML, got something else ({error}); save it again from PLUS") from error
