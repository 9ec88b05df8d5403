"""What the 3-D view draws, as script files that a page can load from a disk: a CT each, and a pair each.

A page that was opened from the file system may run a neighbouring script but not read a neighbouring file, so each file
is one call with base64 text in it. Everything is in the CT's own frame, RAS+ mm: what a method gave in the tracker's
frame is moved back by the pair's coarse alignment, the same rigid motion for every method.
"""

from __future__ import annotations

import gzip
import json
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy import ndimage

from study.alignment.frame import chest_frame
from study.datasets import Anatomy, Dataset
from study.errors import StudyError
from study.evaluation.pair import Pair
from study.files.volumes import write_volume
from study.geometry.points import nearest
from study.naming import split_sweep
from study.results.clouds import Clouds, first_places
from study.skeleton.template import template_graph
from study.types import Floats, Ints, Mesh, RigidTransform, Volume

VERTICES = 3600  # of the surface drawn, each a point of the CT's cloud: about 4 mm apart
VOXEL_MM = np.array([1.4, 1.4, 2.5])
MARGIN_MM = 12.0
WINDOW_HU = (-200.0, 650.0)  # black to white: fat to dense bone and vessels with contrast agent
STEP_MM = 0.02  # of places in the files
SAME_MM = 0.1  # a pair made again lies where it was, but for rounding and another maker's arithmetic
_INT16 = np.iinfo(np.int16)


@dataclass
class Packed:
    """Arrays as one compressed text with a table of where each begins.

    Attributes:
        table: by name: ``at`` (bytes), ``n`` (numbers), ``type``; of points also ``origin`` and ``step``, mm.
    """

    table: dict[str, dict[str, Any]] = field(default_factory=dict)
    _parts: list[bytes] = field(default_factory=list)
    _size: int = 0

    def points(self, name: str, points: Floats) -> None:
        """Add points (n, 3) mm, as int16 steps from their middle."""
        low, high = points.min(axis=0), points.max(axis=0)
        origin = (low + high) / 2
        step = max(STEP_MM, float((high - low).max()) / 2 / _INT16.max)
        self.numbers(name, np.round((points - origin) / step).astype("<i2"))
        self.table[name] |= {"origin": origin.round(4).tolist(), "step": round(step, 6)}

    def numbers(self, name: str, values: np.ndarray[Any, Any]) -> None:
        """Add integers as they are."""
        content = np.ascontiguousarray(values).tobytes()
        self.table[name] = {"at": self._size, "n": int(values.size), "type": values.dtype.str[1:]}
        padded = content + bytes(-len(content) % 4)  # typed arrays begin at multiples of their size
        self._parts.append(padded)
        self._size += len(padded)

    def text(self) -> str:
        """All of it, gzip and base64."""
        return b64encode(gzip.compress(b"".join(self._parts), compresslevel=9, mtime=0)).decode("ascii")


@dataclass(frozen=True)
class Drawn:
    """A CT and the surface that stands for its cloud.

    Attributes:
        anatomy: without its images.
        rows: (v,) rows of the cloud that the surface has as vertices.
        script: what the CT's file says.
    """

    anatomy: Anatomy
    rows: Ints
    script: str


def drawn_ct(dataset: Dataset, name: str, key: str) -> Drawn:
    """One person's CT crop, surface and waypoints, for ``key``.

    Raises:
        StudyError: as `Dataset.anatomy`.
    """
    anatomy = dataset.anatomy(name)
    assert anatomy.image is not None  # a person whom a CT is of
    rows, faces = coarse_surface(anatomy.mesh, anatomy.cloud.points, VERTICES)
    packed = Packed()
    packed.points("source", anatomy.cloud.points[rows])
    packed.numbers("faces", faces.astype("<u2"))
    assert anatomy.cloud.parts is not None
    packed.numbers("parts", anatomy.cloud.parts[rows].astype("<i1"))
    packed.points("waypoints", anatomy.waypoints.points)
    spaces = [label.rpartition(".")[0] for label in anatomy.waypoints.labels]
    links = [[k, k + 1] for k in range(len(spaces) - 1) if spaces[k] == spaces[k + 1]]
    script = call(
        key, {"table": packed.table, "path": links}, packed.text(), nifti=ct_crop(anatomy.image, anatomy.mesh)
    )
    return Drawn(anatomy.without_images(), rows, script)


def coarse_surface(mesh: Mesh, points: Floats, n: int) -> tuple[Ints, Ints]:
    """A coarse surface whose vertices are rows of a cloud sampled from a fine one.

    The cloud's points farthest from each other are kept; every vertex of the fine surface goes to the nearest of them,
    and triangles that keep three corners stay.

    Returns:
        rows (v,) of ``points`` in rising order, and faces (f, 3), indices into those rows.
    """
    chosen = [0]
    gap = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(n, len(points)):
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, np.linalg.norm(points - points[chosen[-1]], axis=1))
    rows = np.sort(np.array(chosen, dtype=np.int64))
    _, corner = nearest(mesh.vertices, points[rows])
    faces = corner[mesh.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    first = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)  # the same triangle begins at one corner
    return rows, np.unique(turned, axis=0)


def ct_crop(image: Volume, mesh: Mesh) -> str:
    """The CT around a surface as base64 of a NIfTI file: 0 at the window's low end, 255 at its high one."""
    low, high = mesh.vertices.min(axis=0) - MARGIN_MM, mesh.vertices.max(axis=0) + MARGIN_MM
    shape = np.ceil((high - low) / VOXEL_MM).astype(int)
    grid = np.indices(shape).reshape(3, -1).T * VOXEL_MM + low
    values = ndimage.map_coordinates(image.values, image.to_index(grid).T, order=1, output=np.float32, cval=-1000.0)
    shades = np.clip((values - WINDOW_HU[0]) / (WINDOW_HU[1] - WINDOW_HU[0]), 0, 1) * 255
    crop = Volume(
        np.round(shades).astype(np.uint8).reshape(shape), VOXEL_MM, RigidTransform(np.eye(3), low), image.name
    )
    with TemporaryDirectory() as folder:
        return b64encode(write_volume(crop, Path(folder) / "ct.nii.gz").read_bytes()).decode("ascii")


def drawn_pair(dataset: Dataset, source: Drawn, target: str, there: Anatomy | None, clouds: Path, key: str) -> str:
    """What the file of one pair says: US cloud, truth and goal, and what each method made of it.

    Args:
        dataset: of both.
        source: the CT.
        target: name of the patient.
        there: the patient's anatomy, without images; None where it is a known deformation of the CT's.
        clouds: of the run.
        key: of the pair.

    Raises:
        StudyError: a run whose pair is not the one that data and code of now give.
    """
    anatomy = source.anatomy
    pair = dataset.pair(anatomy, dataset.patient(target, there or dataset.anatomy(split_sweep(target)[0], anatomy)))
    cases = {method: case for (a, b, method), case in Clouds(clouds).items() if (a, b) == (anatomy.name, target)}
    for method, case in cases.items():
        require_same(pair, method, case, clouds)
    back, packed = pair.alignment.T_us_ct.inverse, Packed()
    rest = anatomy.cloud.points[source.rows]
    packed.points("us", back.apply(pair.alignment.target.cloud.points))
    goal = pair.waypoints_us if pair.true_waypoints is None else pair.true_waypoints
    packed.points("goal", back.apply(goal))
    if pair.true_points is not None:
        packed.points("true", back.apply(pair.true_points[source.rows]) - rest)
    for number, case in enumerate(cases.values()):
        packed.points(f"{number}.warped", back.apply(case["warped"][source.rows]) - rest)
        for name in ("path", "g_ct", "g_us"):
            if name in case:
                packed.points(f"{number}.{name}", back.apply(case[name]))
    edges = template_graph(chest_frame(pair.alignment.source.cloud)).edges
    packed.numbers("edges", np.unique(np.sort(edges, axis=1), axis=0).astype("<u2"))
    return call(key, {"table": packed.table, "methods": list(cases), "goal": goal_of(pair)}, packed.text())


def goal_of(pair: Pair) -> str:
    """What the goal of a pair's waypoints is, in words."""
    return "where they truly belong" if pair.has_truth else "where the paper's protocol puts them on the US cloud"


def require_same(pair: Pair, method: str, case: Mapping[str, Floats], clouds: Path) -> None:
    """Refuse a case of another pair than that of now.

    Raises:
        StudyError: that case.
    """
    points = pair.alignment.source.cloud.points
    now = first_places(points, pair.alignment.T_us_ct)
    told = f"{clouds}: {pair.name}, {method}: expected the clouds that data and code of now give"
    if case["warped"].shape != points.shape or case["start"].shape != now.shape:
        raise StudyError(f"{told} {points.shape}, got {case['warped'].shape}; run the data set again")
    apart = float(np.abs(case["start"] - now).max())
    if apart > SAME_MM:
        raise StudyError(f"{told}, got a start {apart:.1f} mm from theirs; run the data set again")


def call(key: str, about: Mapping[str, Any], blob: str, **texts: str) -> str:
    """A script that hands its content to the viewer."""
    return f"study.take({json.dumps(key)}, {json.dumps({**about, 'blob': blob, **texts}, separators=(',', ':'))});\n"
