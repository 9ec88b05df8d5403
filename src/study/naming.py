"""Names: as people sort them, and of the several sweeps and deformations that one person can have."""

from __future__ import annotations

import re

# No name in a manifest can hold these two.
SWEEP, PLANTED = "#", "+"


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key of a name in which a run of digits counts as a number: ct2 before ct10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def sweep_name(anatomy: str, sweep: int) -> str:
    """What a patient is called in a sweep: ``p03`` in the first, number 0, ``p03#1`` in the second."""
    return f"{anatomy}{SWEEP}{sweep}" if sweep else anatomy


def split_sweep(patient: str) -> tuple[str, int]:
    """The anatomy that was swept, and the number of the sweep: ``("p03", 1)`` of ``p03#1``."""
    anatomy, mark, number = patient.partition(SWEEP)
    return anatomy, int(number) if mark else 0


def planted_name(person: str, deformation: str) -> str:
    """What a person under a planted deformation is called: ``lung1+planted3``."""
    return f"{person}{PLANTED}{deformation}"


def person_of(name: str) -> str:
    """The person behind the name of a CT or a patient, whichever sweep or planted deformation it is.

    >>> [person_of(name) for name in ("p03", "p03#1", "lung1+planted3", "lung1+planted3#2")]
    ['p03', 'p03', 'lung1', 'lung1']
    """
    return name.partition(SWEEP)[0].partition(PLANTED)[0]
