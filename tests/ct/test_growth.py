"""Cartilage grown in a drawn CT."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn_chest import IDS, junction
from phantom_files import ribseg_labels, scan, structure_ids

from study.ct.growth import parts_from_landmarks, parts_from_ribs, rib_ends
from study.ct.landmarks import Landmarks
from study.ct.parts import on_grid, parts_from_labels
from study.errors import StudyError
from study.types import CARTILAGES, Part, Volume


def dice(found: Volume, truth: np.ndarray, grid: Volume) -> dict[Part, float]:
    index = np.rint(found.to_index(grid.to_mm(np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3)))).astype(int)
    inside = ((index >= 0) & (index < found.shape)).all(axis=1)
    values = np.full(len(index), int(Part.UNKNOWN))
    values[inside] = found.values[tuple(index[inside].T)]
    values = values.reshape(grid.shape)
    return {
        part: float(2 * ((values == part) & (truth == part)).sum() / ((values == part).sum() + (truth == part).sum()))
        for part in Part
        if part > Part.UNKNOWN
    }


def test_rib_labels_alone_find_every_part(drawn: tuple[Volume, Volume, np.ndarray]) -> None:
    ct, labels, parts = drawn
    scores = dice(parts_from_ribs(ct, labels, IDS), parts, ct)
    assert len(scores) == 9
    assert min(scores.values()) > 0.8, scores


def test_landmarks_alone_find_every_part(drawn: tuple[Volume, Volume, np.ndarray], landmarks: Landmarks) -> None:
    ct, _, parts = drawn
    scores = dice(parts_from_landmarks(ct, landmarks), parts, ct)
    assert min(scores.values()) > 0.8, scores


def test_rib_ends_are_where_they_were_drawn(drawn: tuple[Volume, Volume, np.ndarray]) -> None:
    ends = rib_ends(drawn[1], IDS)
    assert set(ends) == set(CARTILAGES)
    for part in CARTILAGES:
        assert np.linalg.norm(ends[part] - junction(part)) < 5.0  # the tube's round cap


def test_images_and_landmarks_that_do_not_fit_are_refused(
    drawn: tuple[Volume, Volume, np.ndarray], landmarks: Landmarks
) -> None:
    ct, _, _ = drawn
    with pytest.raises(StudyError, match="Hounsfield units"):
        parts_from_landmarks(ct.with_values(ct.values + 1024), landmarks)
    with pytest.raises(StudyError, match="inside the image"):
        parts_from_landmarks(ct.crop([0, 0, 0], [80, 99, 99]), landmarks)
    hollow = replace(landmarks, sternum=landmarks.sternum - [0.0, 45.0, 0.0])
    with pytest.raises(StudyError, match="expected a sternum"):
        parts_from_landmarks(ct, hollow)
    in_lung = {**landmarks.junctions, Part.LEFT_4: junction(Part.LEFT_4) - [0.0, 28.0, 0.0]}
    with pytest.raises(StudyError, match="junction of left_4, got -"):
        parts_from_landmarks(ct, replace(landmarks, junctions=in_lung))
    bottom = int(ct.to_index([[0.0, 0.0, junction(Part.LEFT_5)[2] - 2.0]])[0, 2])
    with pytest.raises(StudyError, match="right_5, left_5 cut off by the field of view"):
        parts_from_landmarks(ct.crop([0, 0, bottom], [999, 999, 999]), landmarks)


def test_the_sternum_of_a_round_chest_is_found_ahead_of_its_rib_ends() -> None:
    """Of this phantom the sternum lies more than the search's 14 mm in front of the plane through the rib ends."""
    image, labels = scan("ct5")
    found = on_grid(parts_from_ribs(image, ribseg_labels(labels), IDS), labels)
    truth = on_grid(parts_from_labels(labels, structure_ids()), labels)
    a, b = (volume.values > Part.UNKNOWN for volume in (found, truth))
    assert 2 * (a & b).sum() / (a.sum() + b.sum()) > 0.8
