"""Names sort as people sort them, and tell the person behind a sweep or a deformation."""

from __future__ import annotations

from itertools import permutations

import pytest

from study.naming import natural_key, person_of, planted_name, split_sweep, sweep_name


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


@pytest.mark.parametrize("person", ["p03", "lidc-0001", "totalseg-example", "a.b_c"])
def test_a_person_is_known_in_every_sweep_and_deformation(person: str) -> None:
    assert sweep_name(person, 0) == person  # the first sweep is called as the only one is
    planted = planted_name(person, "planted3")
    names = [sweep_name(who, sweep) for who in (person, planted) for sweep in (0, 1, 12)]
    assert len(set(names)) == 6
    assert {person_of(name) for name in names} == {person}
    assert [split_sweep(name) for name in names] == [(who, k) for who in (person, planted) for k in (0, 1, 12)]
