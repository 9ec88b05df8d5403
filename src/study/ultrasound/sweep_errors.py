"""What goes wrong in a virtual sweep: every source of error, its size and where the size comes from."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from study.errors import StudyError

LATENCY_S = 0.268  # sec. II-B


def _size(value: float, unit: str, source: str, reason: str) -> Any:
    """A field of `SweepErrors`: its size, its unit, the name of its source of error and where the size is from."""
    return field(default=value, metadata={"unit": unit, "source": source, "reason": reason})


@dataclass(frozen=True)
class SweepErrors:
    """Size of every error of a virtual sweep; 0 turns one off.

    The default is a careful acquisition: all sources on, the latency calibrated away up to its residual. Fields
    that belong to one source of error are switched together (`only`); `error_table` prints all with their reasons.

    Raises:
        StudyError: a size that is negative or not finite, or a share of dropped frames of 1 or more.
    """

    latency_uncorrected_s: float = _size(
        0.0, "s", "latency", "0 once calibrated; `only('latency')` leaves in the 268 ms of sec. II-B"
    )
    latency_residual_s: float = _size(
        0.005, "s", "latency residual", "bound met by calibrate_latency in its tests; either sign"
    )
    calibration_mm: float = _size(
        1.0,
        "mm",
        "calibration",
        "1.0-1.1 mm reported for robotic ultrasound; a shift in any direction",
    )
    calibration_deg: float = _size(
        0.3, "deg", "calibration", "bound met by calibrate_spatial in its tests; about any axis"
    )
    tracking_mm: float = _size(0.1, "mm", "tracking", "robot repeatability (vendor class, unverified); SD per axis")
    fat_mm: float = _size(
        10.0, "mm", "speed of sound", "fat at 1,440 m/s instead of 1,540: 10 mm shift an echo by 0.69 mm"
    )
    contour_mm: float = _size(
        0.4, "mm", "contour jitter", "two pixels of an annotator's hand (assumed, no published value found); SD"
    )
    dropped: float = _size(0.05, "fraction", "dropped frames", "a frame grabber under load (assumed)")
    missed_mm: float = _size(
        4.0, "mm", "missed strips", "mean gap a hand leaves between lines without seeing it (assumed)"
    )
    breathing_mm: float = _size(
        4.0,
        "mm",
        "breathing",
        "3-5 mm cranially and ventrally, 1-2 mm laterally in quiet breathing; peak to peak of a mean breath, which"
        " others differ from as `study.ultrasound.breathing` says",
    )

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            limit = 1.0 if entry.name == "dropped" else np.inf
            if not 0 <= value < limit:
                raise StudyError(
                    f"{entry.name}: expected a size from 0 to below {limit:g} {entry.metadata['unit']}, got {value!r}"
                )

    @classmethod
    def none(cls) -> SweepErrors:
        """Every error off."""
        return cls(**{entry.name: 0.0 for entry in fields(cls)})

    @classmethod
    def only(cls, source: str) -> SweepErrors:
        """One source of error alone, at its default size; ``"latency"`` is the whole latency, not corrected.

        Raises:
            StudyError: a name that is not in ``ERROR_SOURCES``.
        """
        sizes = {entry.name: getattr(cls(), entry.name) for entry in fields(cls) if entry.metadata["source"] == source}
        if not sizes:
            raise StudyError(f"expected one of {', '.join(ERROR_SOURCES)}, got {source!r}")
        if source == "latency":
            sizes["latency_uncorrected_s"] = LATENCY_S
        return replace(cls.none(), **sizes)


ERROR_SOURCES: tuple[str, ...] = tuple(dict.fromkeys(entry.metadata["source"] for entry in fields(SweepErrors)))


def budget_cases() -> list[tuple[str, SweepErrors]]:
    """Name and errors of each case of the error budget: none, each source alone, all, all with the latency left in."""
    alone = [(source, SweepErrors.only(source)) for source in ERROR_SOURCES]
    every = SweepErrors()
    return [
        ("none", SweepErrors.none()),
        *alone,
        ("all", every),
        ("all, latency not corrected", replace(every, latency_uncorrected_s=LATENCY_S)),
    ]


def error_table() -> list[dict[str, str | float]]:
    """One row per field of `SweepErrors`: source, field, size, unit, and where the size comes from."""
    return [
        {
            "source": entry.metadata["source"],
            "field": entry.name,
            "size": getattr(SweepErrors(), entry.name),
            "unit": entry.metadata["unit"],
            "reason": entry.metadata["reason"],
        }
        for entry in fields(SweepErrors)
    ]
