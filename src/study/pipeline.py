"""One pair from start to end: coarse alignment, then a method (sec. III)."""

from __future__ import annotations

from dataclasses import replace
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike

from study.coarse import Alignment, align
from study.errors import StudyError
from study.methods import METHODS
from study.types import Method, PointCloud, Registration, as_points


def named_rng(seed: int, name: str) -> np.random.Generator:
    """A generator that depends on what is computed, not on when: seed plus a checksum of the name."""
    if seed < 0:
        raise StudyError(f"expected a seed of 0 or more, got {seed}")
    return np.random.default_rng([seed, crc32(name.encode())])


def find_method(name: str) -> Method:
    """The method called ``name``.

    Raises:
        StudyError: no such method.
    """
    if name not in METHODS:
        raise StudyError(f"expected a method among {', '.join(METHODS)}, got {name!r}")
    return METHODS[name]


def register_aligned(alignment: Alignment, method: Method, rng: np.random.Generator) -> Registration:
    """Run one method from a coarse alignment.

    The method sees both clouds in the US frame; the result is expressed from the CT cloud's own frame.
    """
    source, T0 = alignment.source.cloud, alignment.T_us_ct
    result = method.register(source.moved(T0), alignment.target.cloud, rng)
    return replace(
        result,
        source=source.points,
        T_us_ct=result.T_us_ct @ T0,
    )


def register_pair(
    ct_points: ArrayLike, us_points: ArrayLike, method: str = "skeleton_graph", seed: int = 0
) -> Registration:
    """Register a CT cartilage cloud to a US cartilage cloud (sec. III).

    Args:
        ct_points: (n, 3) mm, sternum and cartilages 2-5 of both sides, any rigid pose.
        us_points: (m, 3) mm, the same anatomy as ultrasound sees it, any rigid pose.
        method: a name in ``METHODS``.
        seed: draws of the method.

    Returns:
        the registration: ``warped`` (n, 3) mm in the US cloud's frame, ``transfer`` for waypoints.

    Raises:
        StudyError: bad arrays, no sternum, a missing branch, an unknown method.
    """
    chosen = find_method(method)
    alignment = align(PointCloud(as_points(ct_points, "ct"), "ct"), PointCloud(as_points(us_points, "us"), "us"))
    return replace(register_aligned(alignment, chosen, named_rng(seed, f"ct/us/{method}")), method=method)
