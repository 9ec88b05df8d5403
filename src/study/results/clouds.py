"""``clouds.npz``: where each case of a run put the CT's points, its path and its nodes; what a picture of it needs.

A run can be judged without it, so it is no part of what a run is compared by, and `results/reference` has none.
"""

from __future__ import annotations

import io
import json
from base64 import b64decode, b64encode
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from study.errors import StudyError
from study.files.atomic import write_bytes
from study.registration import Registration
from study.types import Floats, RigidTransform

CLOUDS = "clouds.npz"
N_FIRST = 30  # points by which a pair is known again
STEP_MM = 0.01  # places are kept in steps of this size, a fraction of what any picture shows
CaseName = tuple[str, str, str]  # source, target, method
_INT16 = np.iinfo(np.int16)


@dataclass(frozen=True)
class Steps:
    """Points as whole steps from an origin.

    Attributes:
        origin_mm: (3,) mm.
        step_mm: `STEP_MM`, or more where points lie too far apart for it.
        values: (n, 3) int16.
    """

    origin_mm: Floats
    step_mm: float
    values: np.ndarray[tuple[int, ...], np.dtype[np.int16]]

    @classmethod
    def of(cls, points: Floats) -> Steps:
        """Points (n, 3) mm, to the nearest step."""
        low, high = points.min(axis=0), points.max(axis=0)
        origin = (low + high) / 2
        step = max(STEP_MM, float((high - low).max()) / 2 / _INT16.max)
        return cls(origin, step, np.round((points - origin) / step).astype(np.int16))

    @property
    def points(self) -> Floats:
        """(n, 3) mm."""
        return self.origin_mm + self.step_mm * self.values.astype(np.float64)


def pack(result: Registration, path: Floats, start: RigidTransform) -> str:
    """What is kept of one registration, as text for a journal.

    Args:
        result: of a pair.
        path: (k, 3) mm, the CT's waypoints carried into the US frame.
        start: the pair's coarse alignment, CT to US.
    """
    graphs = {name: getattr(result, name).nodes for name in ("g_ct", "g_us") if hasattr(result, name)}
    clouds = {"warped": result.warped, "path": path, "start": first_places(result.source, start), **graphs}
    steps = {name: Steps.of(points) for name, points in clouds.items()}
    arrays: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]] = {}
    for name, of in steps.items():
        arrays[name] = of.values
        arrays[f"{name}_grid"] = np.array([*of.origin_mm, of.step_mm])
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    return b64encode(content.getvalue()).decode("ascii")


def first_places(source: Floats, start: RigidTransform) -> Floats:
    """Where the coarse alignment puts some points of a CT: the same only for the same clouds of CT and US."""
    return start.apply(source[:: max(1, len(source) // N_FIRST)])


def write_clouds(packed: Mapping[CaseName, str], path: Path) -> None:
    """Write what `pack` made of each case; equal cases give equal bytes."""
    names = sorted(packed)
    parts = [np.frombuffer(b64decode(packed[name]), dtype=np.uint8) for name in names]
    ends = np.cumsum([len(part) for part in parts])
    content = io.BytesIO()
    whole = np.concatenate(parts) if parts else np.empty(0, dtype=np.uint8)
    np.savez(content, cases=np.array(json.dumps(names)), ends=ends, packed=whole)
    write_bytes(path, content.getvalue())


class Clouds(Mapping[CaseName, Mapping[str, Floats]]):
    """The cases of a ``clouds.npz``: each case's points (n, 3) mm in the US frame, by what they are.

    ``warped``: a row for each CT point; ``path``: the carried waypoints; ``start``: see `first_places`; ``g_ct`` and
    ``g_us``: nodes of a method's graphs, where it has any.
    """

    def __init__(self, path: Path) -> None:
        """Read which cases there are.

        Raises:
            StudyError: no such file, or not one of these.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                names, self._ends, self._packed = json.loads(str(file["cases"])), file["ends"], file["packed"]
        except (OSError, ValueError, KeyError) as error:
            told = " ".join(str(error).split())
            raise StudyError(f"expected the clouds of a run at {path}, got: {told}; run the data set again") from error
        self._places = {(str(a), str(b), str(c)): k for k, (a, b, c) in enumerate(names)}

    def __getitem__(self, case: CaseName) -> Mapping[str, Floats]:
        k = self._places[case]
        start = int(self._ends[k - 1]) if k else 0
        with np.load(io.BytesIO(self._packed[start : int(self._ends[k])].tobytes()), allow_pickle=False) as file:
            names = [name for name in file.files if not name.endswith("_grid")]
            grids = {name: file[f"{name}_grid"] for name in names}
            return {name: Steps(grids[name][:3], float(grids[name][3]), file[name]).points for name in names}

    def __iter__(self) -> Iterator[CaseName]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)
