"""Names sort as people sort them."""

from __future__ import annotations

from itertools import permutations

import pytest

from study.naming import natural_key


@pytest.mark.parametrize(
    "names",
    [
        ["ct1", "ct2", "ct10"],
        ["2", "10", "a"],
        ["1.2.9", "1.2.10", "1.10.1"],
        ["ct", "ct1", "ct1a"],
        ["ct01", "ct2"],
    ],
)
def test_runs_of_digits_sort_as_numbers(names: list[str]) -> None:
    for given in permutations(names):
        assert sorted(given, key=natural_key) == names


def test_any_two_names_can_be_compared() -> None:
    names = ["", "a", "1", "1a", "a1", "ct²", "ct٣", "p-1"]  # a superscript is no number, an Arabic three is one
    assert len(sorted(names, key=natural_key)) == len(names)
    assert natural_key("ct٣") == natural_key("ct3")
