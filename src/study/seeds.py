"""Random generators that come from a seed and a name."""

from __future__ import annotations

from zlib import crc32

import numpy as np

from study.errors import StudyError


def named_rng(seed: int, name: str) -> np.random.Generator:
    """The generator of what is called ``name``, such as ``"ct1/patient/icp"``, in a run of ``seed``.

    It depends on what is drawn for and not on when: generators handed on in order would give other numbers as soon as
    one method more is run, a pair is left out or two workers share the work. Of the name counts a checksum, the same
    on every machine, which Python's own hash is not.

    Raises:
        StudyError: a negative seed.
    """
    if seed < 0:
        raise StudyError(f"expected a seed of 0 or more, got {seed}; give another")
    return np.random.default_rng([seed, crc32(name.encode())])
