"""Point clouds and surfaces as PLY: read by the space that the file states, written in RAS and saying so."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from study.errors import StudyError
from study.files.atomic import write_bytes
from study.files.spaces import Space, as_space, to_ras
from study.types import Floats, Ints, PointCloud, as_points, as_times

TIME = "time"  # the property of a PLY file's vertices that says when each was seen, s
PART = "part"  # the one that says which `Part` it is of
MAX_STEP_S = 0.05  # between two times that a file can tell apart: a frame or two
MAX_HEADER = 1 << 16
COMMENTS = (
    "SPACE=RAS",  # 3D Slicer takes a file without it as LPS: turned by 180 degrees
    "unit mm",
    "part -1 unknown, 0 sternum, 1-4 right cartilage 2-5, 5-8 left cartilage 2-5",
)


@dataclass(frozen=True)
class PlyFile:
    """What a PLY file holds.

    Attributes:
        points: (n, 3) mm, RAS.
        faces: (f, 3) indices into ``points``, or None of a cloud.
        times: (n,) s, when each point was seen, where the file says so; else None.
        space: that of the file, in ``comment SPACE=``; None where it says nothing and RAS was assumed.
    """

    points: Floats
    faces: Ints | None
    times: Floats | None
    space: Space | None


def read_ply(path: str | os.PathLike[str]) -> Floats:
    """Points (n, 3) in RAS of a PLY file, a cloud or a mesh's vertices.

    A file with ``comment SPACE=LPS`` is turned; one that states no space is taken as RAS.

    Raises:
        StudyError: no such file, not a PLY file with points, or a space that is neither RAS nor LPS.
    """
    return _read_vertices(path)[0].points


def read_timed_ply(path: str | os.PathLike[str]) -> tuple[Floats, Floats | None]:
    """Points (n, 3) of a PLY file, as `read_ply`, and times (n,) s where its vertices have a property ``time``.

    Raises:
        StudyError: as `read_ply_file`.
    """
    whole = read_ply_file(path)
    return whole.points, whole.times


def read_ply_file(path: str | os.PathLike[str]) -> PlyFile:
    """All of a PLY file that is used here.

    Raises:
        StudyError: as `read_ply`; times that are not finite, or that single precision has rounded to nothing.
    """
    found, columns = _read_vertices(path)
    if TIME not in columns:
        return found
    name, column = Path(path).name, np.asarray(columns[TIME]).reshape(-1)
    times = as_times(column, len(found.points), name)
    if column.dtype == np.float32 and np.spacing(np.abs(column).max()) > MAX_STEP_S:
        raise StudyError(
            f"{name}: expected times to {MAX_STEP_S:g} s or finer, got single precision at {times.max():.0f} s, which "
            "is coarser; write them as double, or count from the start of the sweep"
        )
    raw = np.column_stack([np.asarray(columns[axis]).reshape(-1) for axis in "xyz"])
    if not np.array_equal(to_ras(raw, found.space or "RAS"), found.points):  # a textured mesh is cut up along its seams
        raise StudyError(f"{name}: expected times for the points of a cloud, got a mesh; export its vertices alone")
    return PlyFile(found.points, found.faces, times, found.space)


def _read_vertices(path: str | os.PathLike[str]) -> tuple[PlyFile, Mapping[str, Any]]:
    """A PLY file without its times, and its vertices' x, y, z and, where there is one, time, as the file has them."""
    path = Path(path)
    if not path.is_file():
        raise StudyError(f"expected a PLY file at {path}, got no such file; check the path")
    try:
        loaded = trimesh.load(path, file_type="ply", process=False)
    except Exception as error:  # trimesh raises whatever its parser met
        reason = " ".join(str(error).split()) or type(error).__name__
        raise StudyError(
            f"{path.name}: expected a PLY file with points, got unreadable bytes: {reason}; export it again"
        ) from error
    points = as_points(getattr(loaded, "vertices", np.empty((0, 3))), path.name)
    faces = np.asarray(getattr(loaded, "faces", ()), dtype=np.int64)
    space = _space_of(path)
    vertex = loaded.metadata["_ply_raw"]["vertex"]
    columns = {name: vertex["data"][name] for name in (*"xyz", TIME) if name in vertex["properties"]}
    turned = as_points(to_ras(points, space or "RAS"), path.name)
    return PlyFile(turned, faces if len(faces) else None, None, space), columns


def _space_of(path: Path) -> Space | None:
    """What the comments of a PLY file's header say of its space, as 3D Slicer writes it: ``comment SPACE=RAS``."""
    with path.open("rb") as file:
        header = file.read(MAX_HEADER).partition(b"end_header")[0].decode("latin-1")
    stated = set(re.findall(r"^comment\b.*\bSPACE\s*=\s*(\w+)", header, flags=re.MULTILINE))
    spaces = {as_space(text, path.name) for text in stated}
    if len(spaces) > 1:
        raise StudyError(f"{path.name}: expected one comment SPACE=, got {' and '.join(sorted(spaces))}; delete one")
    return spaces.pop() if spaces else None


def as_ply_path(path: str | os.PathLike[str]) -> Path:
    """The path of a cloud to write; ask before a long computation.

    Raises:
        StudyError: another suffix than .ply.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise StudyError(f"expected a file name that ends in .ply, got {path.name!r}")
    return path


def write_ply(
    cloud: PointCloud,
    path: str | os.PathLike[str],
    *,
    faces: Ints | None = None,
    columns: Mapping[str, Floats] | None = None,
) -> Path:
    """Write a cloud as binary PLY, mm, RAS, in double precision and in its order, with its times, s, and parts.

    Args:
        cloud: the points.
        path: the file.
        faces: (f, 3) triangles of the points, where they are a surface.
        columns: further properties of the vertices, (n,) each, by name.

    Raises:
        StudyError: another suffix.
    """
    path = as_ply_path(path)
    # By hand, since trimesh rounds to single precision: half a micrometre a metre away from the origin.
    values: dict[str, NDArray[Any]] = dict(zip("xyz", cloud.points.T, strict=True))
    if cloud.times is not None:
        values[TIME] = cloud.times
    values |= columns or {}
    kinds = dict.fromkeys(values, "<f8")
    if cloud.parts is not None:
        values[PART], kinds[PART] = cloud.parts, "<i4"
    rows = np.empty(len(cloud), dtype=list(kinds.items()))
    for name, column in values.items():
        rows[name] = column
    comments = COMMENTS if cloud.parts is not None else COMMENTS[:-1]
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {one}" for one in comments)]
    lines += [f"element vertex {len(cloud)}"]
    lines += [f"property {'int' if kind == '<i4' else 'double'} {name}" for name, kind in kinds.items()]
    body = rows.tobytes()
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        triangles = np.empty(len(faces), dtype=[("n", "u1"), ("corners", "<i4", 3)])
        triangles["n"], triangles["corners"] = 3, faces
        body += triangles.tobytes()
    write_bytes(path, "\n".join([*lines, "end_header", ""]).encode("ascii") + body)
    return path
