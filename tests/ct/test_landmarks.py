"""Landmarks that are no RAS+ chest are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from study.ct.landmarks import Landmarks
from study.errors import StudyError
from study.types import Part


def test_landmarks_that_are_no_chest_are_refused(landmarks: Landmarks) -> None:
    flip = np.array([-1.0, 1.0, 1.0])
    with pytest.raises(StudyError, match="sides swapped"):
        replace(landmarks, junctions={part: point * flip for part, point in landmarks.junctions.items()})
    with pytest.raises(StudyError, match="top to bottom"):
        replace(landmarks, sternum=landmarks.sternum[::-1])
    with pytest.raises(StudyError, match="two points down the sternum"):
        replace(landmarks, sternum=landmarks.sternum[:1])
    with pytest.raises(StudyError, match="attachments of cartilages 2-5 on both sides, got none of left_5"):
        replace(landmarks, attachments={p: x for p, x in landmarks.attachments.items() if p is not Part.LEFT_5})
    far = landmarks.attachments[Part.RIGHT_2] + [1000.0, 0.0, 0.0]
    with pytest.raises(StudyError, match="8-150 mm from junction to attachment of right 2, got 1000"):
        replace(landmarks, junctions={**landmarks.junctions, Part.RIGHT_2: far})
    low = landmarks.attachments[Part.RIGHT_2] - [0.0, 0.0, 40.0]
    with pytest.raises(StudyError, match="right attachments 2-5 from head to feet"):
        replace(landmarks, attachments={**landmarks.attachments, Part.RIGHT_2: low})
