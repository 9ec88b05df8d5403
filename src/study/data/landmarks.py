"""Recorded landmarks of one CT: the paper's manual cut (sec. II-C.1), written down so that it can be repeated."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from study.errors import StudyError
from study.types import CARTILAGES, Floats, Part

Point = Annotated[list[Annotated[float, Field(ge=-3000.0, le=3000.0)]], Field(min_length=3, max_length=3)]


@dataclass(frozen=True)
class Landmarks:
    """Where the cartilages 2-5 and the sternum of one CT begin and end; RAS+ mm.

    Attributes:
        subject: name of the CT.
        junctions: centre (3,) of each cartilage's cross-section where its rib ends.
        attachments: centre (3,) of each cartilage's cross-section where it meets the sternum.
        sternum: (2, 3) or more, a line down the middle of the bone, from above the 2nd to below the 5th attachments.
        made_by: who or what placed them.
        method: how.
        hard_to_see: places that were uncertain, in words.
    """

    subject: str
    junctions: Mapping[Part, Floats]
    attachments: Mapping[Part, Floats]
    sternum: Floats
    made_by: str
    method: str
    hard_to_see: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_chest(self)


def check_chest(landmarks: Landmarks) -> None:
    """The landmarks lie as an RAS+ chest has them.

    Raises:
        StudyError: a cartilage missing, sides swapped, levels out of order, upside down, metres, or a cartilage
            that is implausibly short or long; the message names it.
    """
    name = f"landmarks of {landmarks.subject}"
    for what in ("junctions", "attachments"):
        absent = [part.name.lower() for part in CARTILAGES if part not in getattr(landmarks, what)]
        if absent:
            raise StudyError(
                f"{name}: expected {what} of cartilages 2-5 on both sides, got none of {', '.join(absent)}"
            )
    if landmarks.sternum.ndim != 2 or landmarks.sternum.shape[1] != 3 or len(landmarks.sternum) < 2:
        raise StudyError(f"{name}: expected at least two points down the sternum, got shape {landmarks.sternum.shape}")
    if landmarks.sternum[0, 2] <= landmarks.sternum[-1, 2] + 20.0:
        raise StudyError(
            f"{name}: expected the sternum from top to bottom, 20 mm or more, got {landmarks.sternum.tolist()}"
        )
    for side, sign in (("right", 1.0), ("left", -1.0)):
        for level in (2, 3, 4, 5):
            part = Part.cartilage(side, level)
            junction, attachment = landmarks.junctions[part], landmarks.attachments[part]
            if sign * (junction[0] - attachment[0]) <= 0:
                raise StudyError(
                    f"{name}: expected the {side} rib {level} to the {side} of its sternal end (RAS+, {side} is "
                    f"{'+' if sign > 0 else '-'}x), got x = {junction[0]:.1f} and {attachment[0]:.1f}; "
                    "sides swapped, or LPS for RAS?"
                )
            length = float(np.linalg.norm(junction - attachment))
            if not 8.0 <= length <= 150.0:
                raise StudyError(
                    f"{name}: expected 8-150 mm from junction to attachment of {side} {level}, got {length:.1f}"
                )
        heights = np.array([landmarks.attachments[Part.cartilage(side, level)][2] for level in (2, 3, 4, 5)])
        if (np.diff(heights) >= 0).any():
            raise StudyError(f"{name}: expected {side} attachments 2-5 from head to feet, got z = {heights.tolist()}")


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
        StudyError: no file, not YAML, a key that is missing, unknown or of the wrong kind (the message has its
            place), or points that are no RAS+ chest.
    """
    path = Path(path)
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise StudyError(
            f"expected a landmark file at {path}, got nothing there; make one as the README shows"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise StudyError(f"{path.name}: expected YAML, got {' '.join(str(error).split())}; mend the file") from error
    try:
        file = _File.model_validate(raw)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(step) for step in first["loc"]) or "the file"
        got = str(first["input"])[:60]
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        raise StudyError(f"{path.name}: {place}: expected another value: {first['msg']}; got {got}{more}") from error
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
