"""Parameters of a run, and the profiles that name them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from study.errors import StudyError

POPULATION_SEED = 701  # draws the people of the full spread; on none of them was anything tuned or tried before
PHANTOM_SEED = 1  # draws the reported phantom anatomies; their mean distance after a rigid fit lies in 5-10 mm


@dataclass(frozen=True)
class StudyParams:
    """How much of a cohort is run, and how finely.

    Attributes:
        ct_points: points of a CT cloud (about 9,000 in the authors' data).
        us_spacing_mm: distance between neighbouring points of a US cloud.
        phantom_spacing_mm: voxel of the phantom's CT volumes.
        max_sources: CTs per patient, from the first; 0 for all.
        max_targets: patients, from the first; 0 for all.
        radius_mm: sphere of path transfer (sec. III-D).
    """

    ct_points: int = 9000
    us_spacing_mm: float = 1.5
    phantom_spacing_mm: float = 1.5
    max_sources: int = 0
    max_targets: int = 0
    radius_mm: float = 20.0

    def __post_init__(self) -> None:
        lengths_mm = (self.us_spacing_mm, self.phantom_spacing_mm, self.radius_mm)
        if self.ct_points < 500 or not all(0 < length < np.inf for length in lengths_mm):
            raise StudyError(f"expected ct_points >= 500 and positive lengths, got {self}")
        if min(self.max_sources, self.max_targets) < 0:
            raise StudyError(f"expected max_sources and max_targets >= 0, 0 for all, got {self}")


PROFILES: Mapping[str, StudyParams] = MappingProxyType(
    {
        "full": StudyParams(),
        "quick": StudyParams(ct_points=3000, us_spacing_mm=2.5, phantom_spacing_mm=2.5, max_sources=2, max_targets=1),
    }
)


def find_profile(name: str) -> StudyParams:
    """The profile called ``name``.

    Raises:
        StudyError: no such profile.
    """
    if name not in PROFILES:
        raise StudyError(f"expected a profile among {', '.join(PROFILES)}, got {name!r}")
    return PROFILES[name]


def override(params: StudyParams, **changes: Any) -> StudyParams:
    """The same parameters with some replaced.

    Raises:
        StudyError: an unknown name, or a value of another type or out of range.
    """
    known = {entry.name for entry in fields(params)}
    unknown = sorted(set(changes) - known)
    if unknown:
        raise StudyError(f"expected parameters among {', '.join(sorted(known))}, got {', '.join(unknown)}")
    for name, value in changes.items():
        _check_type(name, value, type(getattr(params, name)))
    return replace(params, **changes)


def _check_type(name: str, value: Any, kind: type) -> None:
    """A bool is no number here, though Python says so; a whole number is one with a fraction."""
    fits = isinstance(value, kind) or (kind is float and isinstance(value, int))
    if not fits or (isinstance(value, bool) and kind is not bool):
        raise StudyError(f"parameter {name}: expected {kind.__name__}, got {value!r} ({type(value).__name__})")


def check_parameters(namespace: Mapping[str, Any], **allowed: type) -> None:
    """Refuse what a notebook does not know; papermill itself would inject it and go on.

    Call it in the cell after the parameters with ``globals()``.

    Args:
        namespace: names and values so far.
        allowed: type of each parameter, by name.

    Raises:
        StudyError: a plain value under an unknown name, a missing parameter or one of another type.
    """
    kernel = {"In", "Out"}
    plain = (str, bytes, bool, int, float, list, tuple, dict, set, type(None))
    given = {
        name: value
        for name, value in namespace.items()
        if not name.startswith("_") and name not in kernel and isinstance(value, plain)
    }
    unknown = sorted(set(given) - set(allowed))
    if unknown:
        raise StudyError(f"expected parameters among {', '.join(allowed)}, got unknown {', '.join(unknown)}")
    for name, kind in allowed.items():
        _check_type(name, given.get(name), kind)
