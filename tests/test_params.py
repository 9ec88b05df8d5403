from __future__ import annotations

import math

import pytest

from study.errors import StudyError
from study.params import PROFILES, StudyParams, check_parameters, find_profile, override


def test_profiles_by_name() -> None:
    assert find_profile("full") == StudyParams()
    assert find_profile("quick").ct_points < StudyParams().ct_points
    with pytest.raises(StudyError, match=r"among full, quick, got 'fast'"):
        find_profile("fast")
    with pytest.raises(TypeError):
        PROFILES["mine"] = StudyParams()  # type: ignore[index]


@pytest.mark.parametrize(
    "wrong",
    [{"ct_points": 499}, {"us_spacing_mm": 0.0}, {"radius_mm": -1.0}, {"phantom_spacing_mm": math.nan},
     {"radius_mm": math.inf}, {"max_sources": -1}, {"max_targets": -1}],
)  # fmt: skip
def test_parameters_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(StudyError, match=next(iter(wrong))):
        override(StudyParams(), **wrong)


def test_override_changes_what_is_named_and_nothing_else() -> None:
    before = StudyParams()
    after = override(before, ct_points=4000, radius_mm=25)
    assert (after.ct_points, after.radius_mm, after.us_spacing_mm) == (4000, 25, before.us_spacing_mm)
    assert before == StudyParams()
    with pytest.raises(StudyError, match="got points, sead"):
        override(before, sead=1, points=3)
    for value in ("4000", True, 4000.0, None):
        with pytest.raises(StudyError, match=r"ct_points: expected int, got"):
            override(before, ct_points=value)


GOOD = {"dataset": "phantom", "seed": 0, "radius_mm": 20}
TYPES = {"dataset": str, "seed": int, "radius_mm": float}


def test_notebook_parameters_of_the_right_kind_pass() -> None:
    kernel = {"In": [""], "Out": {}, "_": 3, "_dh": ["."], "np": math, "helper": lambda: None}
    check_parameters({**GOOD, **kernel}, **TYPES)
    check_parameters({**GOOD, "radius_mm": 1.5}, **TYPES)


@pytest.mark.parametrize(
    ("given", "message"),
    [({"sede": 1}, r"among dataset, seed, radius_mm, got unknown sede"),
     ({"seed": "1"}, r"parameter seed: expected int, got '1' \(str\)"),
     ({"seed": True}, r"parameter seed: expected int, got True"),
     ({"seed": 1.0}, r"parameter seed: expected int"),
     ({"dataset": None}, r"parameter dataset: expected str, got None"),
     ({"radius_mm": "20"}, r"parameter radius_mm: expected float")],
)  # fmt: skip
def test_notebook_parameters_that_are_unknown_or_ill_typed_are_refused_by_name(given: dict, message: str) -> None:
    with pytest.raises(StudyError, match=message):
        check_parameters({**GOOD, **given}, **TYPES)


def test_a_missing_notebook_parameter_is_refused_by_name() -> None:
    with pytest.raises(StudyError, match="parameter seed"):
        check_parameters({"dataset": "phantom", "radius_mm": 1.0}, **TYPES)
