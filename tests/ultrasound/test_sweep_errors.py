"""Sources of error: every one named, sized and switched once."""

import dataclasses

import pytest

from study.errors import StudyError
from study.ultrasound.sweep_errors import ERROR_SOURCES, SweepErrors, budget_cases, error_table


def test_the_budget_has_every_source_once():
    cases = budget_cases()
    assert [name for name, _ in cases] == ["none", *ERROR_SOURCES, "all", "all, latency not corrected"]
    assert len({errors for _, errors in cases}) == len(cases) == 12
    rows = error_table()
    assert {row["field"] for row in rows} == {field.name for field in dataclasses.fields(SweepErrors)}
    assert all(row["unit"] and len(str(row["reason"])) > 20 for row in rows)
    with pytest.raises(StudyError, match="expected one of latency"):
        SweepErrors.only("gremlins")
    for bad in ({"fat_mm": -1.0}, {"dropped": 1.0}, {"breathing_mm": float("nan")}):
        with pytest.raises(StudyError, match="expected a size"):
            SweepErrors(**bad)
