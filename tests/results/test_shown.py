"""The pairs that are drawn are the median and the largest of the reference, whatever the profile."""

from __future__ import annotations

import pytest

from study.errors import StudyError
from study.results import REFERENCE, Run, typical_and_worst


def test_the_typical_pair_is_the_median_and_the_worst_the_largest() -> None:
    errors = Run(REFERENCE / "open").per_pair.loc["waypoint_error"]["skeleton_graph"].dropna()
    typical, worst = typical_and_worst("open", list(errors.index))
    assert errors[worst] == errors.max()
    assert (errors < errors[typical]).sum() == (len(errors) - 1) // 2
    assert typical != worst


def test_it_chooses_among_those_that_there_are() -> None:
    errors = Run(REFERENCE / "open").per_pair.loc["waypoint_error"]["skeleton_graph"].dropna()
    two = list(errors.index[:2])
    assert set(typical_and_worst("open", two)) == set(two)
    assert typical_and_worst("elsewhere", two) == (two[0], two[0])
    with pytest.raises(StudyError, match="expected pairs"):
        typical_and_worst("open", [])
