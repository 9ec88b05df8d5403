"""Landmarks of one CT: where cartilages and sternum begin and end, the paper's manual cut (sec. II-C.1) in numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from study.errors import StudyError
from study.types import CARTILAGES, Floats, Part


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

    Raises:
        StudyError: as `check_chest`.
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
