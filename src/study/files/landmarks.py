"""Reading recorded landmarks of one CT: the paper's manual cut (sec. II-C.1), written down so it can be repeated."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from study.ct.landmarks import Landmarks
from study.errors import StudyError
from study.files.waypoints import read_waypoint_file
from study.files.yaml_text import line_of, located, read_yaml, repeated_keys
from study.types import CARTILAGES, Floats, Part

FIDUCIALS = (".mrk.json", ".fcsv")
LABEL = r"(?P<what>junction|attachment) (?P<side>right|left) (?P<level>[2-5])|sternum (?P<number>\d{1,3})"
Point = Annotated[list[Annotated[float, Field(ge=-3000.0, le=3000.0)]], Field(min_length=3, max_length=3)]  # RAS+ mm


class _Points(BaseModel):
    model_config = ConfigDict(extra="forbid")

    right_2: Point
    right_3: Point
    right_4: Point
    right_5: Point
    left_2: Point
    left_3: Point
    left_4: Point
    left_5: Point


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")

    subject: str = Field(min_length=1)
    frame: Literal["RAS+ mm"]
    made_by: str = Field(min_length=1)
    method: str = Field(min_length=1)
    hard_to_see: list[str] = []
    junctions: _Points
    attachments: _Points
    sternum: Annotated[list[Point], Field(min_length=2)]


def read_landmarks(path: str | os.PathLike[str]) -> Landmarks:
    """Read ``annotations/<subject>.yaml``, or a point list of 3D Slicer (``.mrk.json``, ``.fcsv``).

    The points of a list are labelled ``junction right 2``, ``attachment left 5``, ``sternum 1``, ``sternum 2`` ... from
    the head down; ``_``, ``.`` and ``-`` serve as well as a space.

    Raises:
        StudyError: no file, not YAML, a key that is missing, unknown, repeated or of the wrong kind (the message has
            its place), a point list with other labels, or points that are no RAS+ chest.
    """
    path = Path(path)
    if path.name.lower().endswith(FIDUCIALS):
        return _from_points(path)
    try:
        raw, root = read_yaml(path)
    except FileNotFoundError as error:
        raise StudyError(
            f"expected a landmark file at {path}, got nothing there; make one as docs/use.md shows"
        ) from error
    if faults := repeated_keys(root):
        raise located(faults, root, path.name)
    try:
        file = _File.model_validate(raw)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(step) for step in first["loc"]) or "the file"
        got = str(first["input"])[:60]
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        raise StudyError(
            f"{path.name}: {place}{line_of(root, first['loc'])}: expected another value: {first['msg']};"
            f" got {got}{more}; mend the file"
        ) from error
    return Landmarks(
        file.subject,
        _by_part(file.junctions),
        _by_part(file.attachments),
        np.array(file.sternum, dtype=np.float64),
        file.made_by,
        file.method,
        tuple(file.hard_to_see),
    )


def _from_points(path: Path) -> Landmarks:
    """Landmarks of a labelled point list."""
    file = read_waypoint_file(path)
    ends: dict[str, dict[Part, Floats]] = {"junction": {}, "attachment": {}}
    sternum: dict[int, Floats] = {}
    for label, point in zip(file.waypoints.labels, file.waypoints.points, strict=True):
        found = re.fullmatch(LABEL, " ".join(re.split(r"[\s_.-]+", label.strip().lower())))
        if found is None:
            raise StudyError(
                f"{path.name}: expected labels as in 'junction right 2', 'attachment left 5' and 'sternum 1', got "
                f"{label!r}; rename the point"
            )
        table: dict[Any, Floats] = sternum if found["number"] else ends[found["what"]]
        key = int(found["number"]) if found["number"] else Part.cartilage(found["side"], int(found["level"]))
        if key in table:
            raise StudyError(f"{path.name}: expected each label once, got {label!r} twice; rename or delete one")
        table[key] = point
    if len(sternum) < 2:
        raise StudyError(f"{path.name}: expected 'sternum 1', 'sternum 2' or more, got {len(sternum)}; place them")
    line = np.array([sternum[number] for number in sorted(sternum)])
    return Landmarks(
        path.name.split(".")[0], ends["junction"], ends["attachment"], line, "not stated", f"points of {path.name}"
    )


def _by_part(points: _Points) -> dict[Part, Floats]:
    return {part: np.array(getattr(points, part.name.lower()), dtype=np.float64) for part in CARTILAGES}
