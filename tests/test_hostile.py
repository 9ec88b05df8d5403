"""A seeded part of benchmarks/hostile.py: each of these classes ends right, refused or warned, not wrong in silence."""

import hostile
import pandas as pd
import pytest

RIGHT = ("clean, front given", "half given 8 times", "patch sampled 20 times", "100,000 points")
NEVER_RIGHT = (
    "turned inside out, front given",
    "front given wrong way",
    "both twice or half life size",
    "US of the medial halves",
    "with cartilages 1, 6, 7, CT",
    "with 40 mm of ribs, US",
    "sternum uncut, CT",
    "levels 1-4",
    "no chest: plate with slots",
)


@pytest.mark.parametrize("kind", RIGHT)
def test_clean_input_is_right_and_not_suspect(kind: str) -> None:
    row = hostile.run(kind, 401, "ct2", 0)
    assert (row["outcome"], row["message"]) == ("right", "")


@pytest.mark.parametrize("kind", NEVER_RIGHT)
def test_hostile_input_is_refused_or_warned_of(kind: str) -> None:
    row = hostile.run(kind, 402, "ct3", 0)
    assert row["outcome"] in ("refused", "warned")
    assert row["message"]


def test_the_report_counts_what_is_wrong_in_silence_and_how_far() -> None:
    rows = [
        {"kind": "clean", "outcome": "right", "message": "", "mean_mm": 3.0},
        {"kind": "clean", "outcome": "right", "message": "bulge", "mean_mm": 3.0},
        {"kind": "front given wrong way", "outcome": "wrong in silence", "message": "", "mean_mm": 30.0},
        {"kind": "mirrored", "outcome": "wrong in silence", "message": "", "mean_mm": 30.0},
    ]
    text = hostile.report(pd.DataFrame(rows))
    assert "wrong in silence: 33.3%, by more than 10 mm: 1; of 2 clean cases 50.0%" in text
    assert "mirrored *" in text
