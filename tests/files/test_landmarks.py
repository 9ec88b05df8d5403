"""Landmark files are read, and a fault in one is told by its place."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from drawn_chest import drawn_landmarks

from study.ct.landmarks import Landmarks
from study.errors import StudyError
from study.files.landmarks import read_landmarks
from study.types import CARTILAGES

ROOT = Path(__file__).parents[2]


def as_file(landmarks: Landmarks) -> dict:
    return {
        "subject": landmarks.subject,
        "frame": "RAS+ mm",
        "made_by": "test",
        "method": "drawn",
        "junctions": {part.name.lower(): landmarks.junctions[part].tolist() for part in CARTILAGES},
        "attachments": {part.name.lower(): landmarks.attachments[part].tolist() for part in CARTILAGES},
        "sternum": landmarks.sternum.tolist(),
    }


def test_landmark_file_round_trip_and_located_errors(tmp_path: Path) -> None:
    landmarks = drawn_landmarks()
    path = tmp_path / "drawn.yaml"
    good = as_file(landmarks)
    path.write_text(yaml.safe_dump(good))
    read = read_landmarks(path)
    assert all((read.junctions[part] == landmarks.junctions[part]).all() for part in CARTILAGES)
    assert (read.sternum == landmarks.sternum).all()
    mirrored = {key: [-v[0], *v[1:]] for key, v in good["junctions"].items()}
    cases = [
        ({**good, "frame": "LPS mm"}, "frame"),
        ({**good, "junctions": {**good["junctions"], "left_3": [1.0, 2.0]}}, r"junctions\.left_3"),
        ({**good, "attachments": {**good["attachments"], "left_9": [1.0, 2.0, 3.0]}}, r"attachments\.left_9"),
        ({k: v for k, v in good.items() if k != "sternum"}, "sternum"),
        ({**good, "junctions": {**good["junctions"], "right_2": [1.0, "x", 3.0]}}, r"junctions\.right_2\.1"),
        ({**good, "junctions": mirrored}, "sides swapped"),
        ({**good, "sternum": good["sternum"][::-1]}, "top to bottom"),
        ({**good, "junctions": {**good["junctions"], "left_5": good["attachments"]["left_5"]}}, "left"),
        (["a list"], "the file"),
    ]
    for content, place in cases:
        path.write_text(yaml.safe_dump(content))
        with pytest.raises(StudyError, match=place):
            read_landmarks(path)
    path.write_text("a: [1, 2")
    with pytest.raises(StudyError, match="expected YAML"):
        read_landmarks(path)
    with pytest.raises(StudyError, match="nothing there"):
        read_landmarks(tmp_path / "absent.yaml")


def test_committed_landmark_files_are_chests() -> None:
    files = sorted((ROOT / "annotations").glob("*.yaml"))
    assert len(files) >= 3
    for file in files:
        landmarks = read_landmarks(file)
        assert landmarks.subject == file.stem
        assert landmarks.hard_to_see
