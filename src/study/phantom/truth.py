"""What is known exactly of the synthetic people: where places of one are in another, waypoints, sizes."""

from __future__ import annotations

import numpy as np

from study.phantom.subject import SyntheticSubject
from study.phantom.wall import (
    BODY_BOTTOM_MM,
    CARTILAGE,
    COURSES,
    STERNUM_TOP_MM,
    centrelines,
    sternum_half_width,
)
from study.types import Floats, Waypoints

WAYPOINTS_PER_GAP = ((2, 3), (3, 3), (4, 4))  # upper level, number (sec. IV-B)


def truth_map(source: SyntheticSubject, target: SyntheticSubject, points: Floats) -> Floats:
    """Where (n, 3) mm places of one subject are in another, RAS+: φ_target ∘ φ_source⁻¹, exact."""
    return target.phi.apply(source.phi.inverse(points))


def waypoints(subject: SyntheticSubject) -> Waypoints:
    """The 20 waypoints, RAS+ mm: midpoints of places that correspond on neighbouring cartilages (sec. IV-B).

    Each cartilage is cut into equal parts, 3, 3 and 4 from above on each side; the midpoint of the parts' middles is
    a canonical place in the intercostal space and φ takes it to the subject, so row i is the same place in every
    subject.
    """
    lines = centrelines()
    points, labels = [], []
    for side, name in ((1, "R"), (-1, "L")):
        for upper, count in WAYPOINTS_PER_GAP:
            middles = []
            for level in (upper, upper + 1):
                mine = (lines.level == level) & (lines.side == side)
                wanted = (np.arange(count) + 0.5) / count * COURSES[level][0]
                middles.append(lines.xz[mine][np.searchsorted(lines.arc[mine], wanted)])
            x, z = np.mean(middles, axis=0).T
            points.append(np.column_stack([x, np.zeros(count), z]))
            labels += [f"{name}{upper}-{upper + 1}.{k + 1}" for k in range(count)]
    return Waypoints(subject.phi.apply(np.concatenate(points)), tuple(labels))


def measures(subject: SyntheticSubject) -> dict[str, float]:
    """Sizes of a subject as an anatomist measures them, mm and degrees.

    Returns:
        ``manubrium_mm``, ``body_mm``, ``sternum_width_mm`` (at levels 3-4), ``sternal_angle_deg``, and
        ``cartilage_<side>_<level>_mm`` along the middle of the cartilage from sternum to bone.
    """
    half = float(sternum_half_width(np.array([-45.0]))[0])
    sizes = {
        "manubrium_mm": _length_mm(subject, _midline(*np.linspace(0, STERNUM_TOP_MM, 50))),
        "body_mm": _length_mm(subject, _midline(*np.linspace(BODY_BOTTOM_MM, 0, 50))),
        "sternum_width_mm": _length_mm(subject, np.array([[-half, 0, -45.0], [half, 0, -45.0]])),
        "sternal_angle_deg": _sternal_angle_deg(subject),
    }
    lines = centrelines()
    for side, sign in (("right", 1), ("left", -1)):
        for level in (2, 3, 4, 5):
            mine = (lines.level == level) & (lines.side == sign) & (lines.arc >= 0) & (lines.tissue == CARTILAGE)
            x, z = lines.xz[mine].T
            course = np.column_stack([x, np.zeros(len(x)), z])
            sizes[f"cartilage_{side}_{level}_mm"] = _length_mm(subject, course)
    return sizes


def _sternal_angle_deg(subject: SyntheticSubject) -> float:
    """The angle between manubrium and body, 180 where they lie in one line."""
    top, upper, lower, bottom = subject.phi.apply(_midline(45.0, 8.0, -8.0, -85.0))
    lean = (top - upper) / np.linalg.norm(top - upper) @ ((bottom - lower) / np.linalg.norm(bottom - lower))
    return float(np.degrees(np.arccos(lean)))


def _length_mm(subject: SyntheticSubject, canonical: Floats) -> float:
    """Length in the subject of a line through canonical points (n, 3)."""
    return float(np.linalg.norm(np.diff(subject.phi.apply(canonical), axis=0), axis=1).sum())


def _midline(*z: float) -> Floats:
    """Canonical points (n, 3) mm on the middle of the wall at heights ``z``."""
    return np.column_stack([np.zeros(len(z)), np.zeros(len(z)), z])
