"""Reading recorded landmarks of one CT: the paper's manual cut (sec. II-C.1), written down so it can be repeated."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from study.ct.landmarks import Landmarks
from study.errors import StudyError
from study.files.yaml_text import line_of, located, read_yaml, repeated_keys
from study.types import CARTILAGES, Floats, Part

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
    """Read ``annotations/<subject>.yaml``.

    Raises:
        StudyError: no file, not YAML, a key that is missing, unknown, repeated or of the wrong kind (the message has
            its place), or points that are no RAS+ chest.
    """
    path = Path(path)
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


def _by_part(points: _Points) -> dict[Part, Floats]:
    return {part: np.array(getattr(points, part.name.lower()), dtype=np.float64) for part in CARTILAGES}
