"""What can be wrong with a pair of clouds, in named sizes, and the pair with just that wrong.

The pairs are synthetic people whom nothing else draws: cohort seeds 521-540, neither reported nor tuned on. What is
drawn is drawn by the name of its use and not of the level, so the levels of one pair differ in the disturbance alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from study import phantom
from study.ct.parts import parts_from_labels
from study.ct.surface import sample_cloud, surface
from study.data.manifest import load_manifest
from study.errors import StudyError
from study.geometry.points import nearest
from study.phantom.between import between
from study.phantom.surface import canonical_surface
from study.seeds import named_rng
from study.types import CARTILAGES, Bools, Floats, Ints, Mesh, Part, PointCloud
from study.ultrasound.cloud import sweep_cloud
from study.ultrasound.sweep_errors import SweepErrors
from study.ultrasound.virtual_sweep import simulate_sweep

SEEDS = tuple(range(521, 541))  # one pair of people each: ct1 and the patient of that cohort
FRONT = np.array([0.0, 1.0, 0.0])  # RAS+
STRIP_LENGTH_MM = 45.0  # the middle of the 30-60 mm of `phantom.anterior_cloud`
MARGIN_MM = 10.0  # of the box around the cloud that outliers fill
DEG_PER_MM = SweepErrors().calibration_deg / SweepErrors().calibration_mm  # of a calibration error
SWEEP_SPACING_MM = 1.5


@dataclass(frozen=True)
class Disturbance:
    """A pair of clouds, described; the default is a careful acquisition.

    Attributes:
        noise_mm: SD per axis of the US points.
        outlier_share: of the US points, uniform in the cloud's box and 10 mm around it, 0 to below 1.
        strips: strips of the US that are missing, 45 mm long, anywhere and in any direction of the chest's front.
        strip_mm: their width.
        branch_share: of one cartilage of the US, from its lateral end, that is missing; the rest of it at 1, too.
        deformation: how far the patient differs from the CT's person; 1 is how people do.
        ct_points: of the CT cloud.
        us_points: of the US cloud, where it is sampled.
        calibration_mm: shift of the probe's calibration, with 0.3 degrees per mm; a virtual sweep with all its other
            errors then makes the US cloud. None samples it from the visible surface.
        voxel_mm: edge of a CT voxel, from which the CT cloud then comes by the road of a real CT. None samples it from
            the exact surface.
    """

    noise_mm: float = 0.5
    outlier_share: float = 0.0
    strips: int = 0
    strip_mm: float = 6.0
    branch_share: float = 0.0
    deformation: float = 1.0
    ct_points: int = 9000
    us_points: int = 6000
    calibration_mm: float | None = None
    voxel_mm: float | None = None

    def __post_init__(self) -> None:
        if not (self.noise_mm >= 0 and 0 <= self.outlier_share < 1 and 0 <= self.branch_share <= 1):
            raise StudyError(f"expected noise of 0 mm or more, shares of 0-1 and outliers below 1, got {self}")
        if self.strips < 0 or not self.strip_mm > 0:
            raise StudyError(f"expected 0 strips or more of a width above 0, got {self.strips} of {self.strip_mm} mm")


@dataclass(frozen=True)
class Level:
    """One size of one kind of disturbance.

    Attributes:
        kind: of the disturbance, a key of `KINDS`.
        value: the size, in the kind's unit.
        disturbance: the whole of it.
    """

    kind: str
    value: float
    disturbance: Disturbance


@dataclass(frozen=True)
class Kind:
    """A kind of disturbance.

    Attributes:
        title: of its panel.
        unit: of the sizes, for the axis.
    """

    title: str
    unit: str


KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "noise": Kind("Noise of the US points", "SD per axis (mm)"),
        "outliers": Kind("Outliers among the US points", "share (%)"),
        "strips": Kind("Missing strips, 6 mm wide", "number"),
        "strip_width": Kind("Width of 4 missing strips", "mm"),
        "branch": Kind("Missing part of one cartilage", "share from its lateral end (%)"),
        "deformation": Kind("Size of the deformation", "1: as people differ"),
        "calibration": Kind("Calibration error", "shift (mm), with 0.3° per mm"),
        "density": Kind("Points of each cloud", "number, in thousands"),
        "voxel": Kind("Voxel of the CT", "edge (mm)"),
    }
)


def levels(base: Disturbance | None = None) -> list[Level]:
    """Every level of every kind, in the order of `KINDS`.

    Args:
        base: what is not varied; a careful acquisition when None.
    """
    b = base or Disturbance()
    listed: dict[str, dict[float, Disturbance]] = {
        "noise": {mm: replace(b, noise_mm=mm) for mm in (0.0, 0.5, 1.0, 2.0, 4.0)},
        "outliers": {100 * share: replace(b, outlier_share=share) for share in (0.0, 0.05, 0.15, 0.45)},
        "strips": {n: replace(b, strips=n) for n in (0, 4, 16)},
        "strip_width": {mm: replace(b, strips=4, strip_mm=mm) for mm in (6.0, 18.0)},
        "branch": {100 * share: replace(b, branch_share=share) for share in (0.0, 0.5, 1.0)},
        "deformation": {share: replace(b, deformation=share) for share in (0.0, 0.5, 1.0, 1.5)},
        "calibration": {mm: replace(b, calibration_mm=mm) for mm in (0.0, 2.0, 4.0)},
        "density": {n / 1000: replace(b, ct_points=n, us_points=n) for n in (1000, 3000, 10_000, 50_000)},
        "voxel": {mm: replace(b, voxel_mm=mm) for mm in (1.5, 2.5, 4.0)},
    }
    return [Level(kind, float(value), one) for kind, sizes in listed.items() for value, one in sizes.items()]


@dataclass(frozen=True)
class DisturbedPair:
    """Two clouds in RAS+, what is undisturbed of the second, and where the path belongs.

    Attributes:
        ct: CT cloud, its true parts known.
        us: US cloud, its parts those of the nearest point of the undisturbed one; with times where it was swept.
        waypoints: (k, 3) mm, of the CT.
        goal: (k, 3) mm, where they truly belong in the US.
    """

    ct: PointCloud
    us: PointCloud
    waypoints: Floats
    goal: Floats


def disturbed_pair(disturbance: Disturbance, seed: int) -> DisturbedPair:
    """The pair of people of a cohort seed, under a disturbance.

    Raises:
        StudyError: a CT too coarse to hold the anatomy.
    """
    d = disturbance
    person, patient = phantom.draw_subject("ct1", seed), phantom.draw_subject("patient", seed)
    if d.deformation != 1:
        patient = between(person, patient, d.deformation)
    clean = phantom.anterior_cloud(patient, d.us_points, 0.0, 0, named_rng(seed, "robustness/us"))
    seen = clean if d.calibration_mm is None else _swept(patient, d.calibration_mm, seed)
    us, times = seen.points, seen.times
    _, index = nearest(us, clean.points)
    kept = ~_missing(d, us, _true_parts(clean)[index], seed)
    us = us[kept] + d.noise_mm * named_rng(seed, "robustness/noise").normal(size=us.shape)[kept]
    n_seen, outliers = len(us), named_rng(seed, "robustness/outliers")
    us = _with_outliers(us, d.outlier_share, outliers)
    if times is not None:  # an outlier is seen at any time
        n_outliers = len(us) - n_seen
        times = np.concatenate([times[kept], outliers.uniform(times.min(), times.max(), n_outliers)])
    _, index = nearest(us, clean.points)
    path = phantom.waypoints(person).points
    return DisturbedPair(
        _ct_cloud(person, d, seed),
        PointCloud(us, f"us:{seed}", _true_parts(clean)[index], FRONT, times),
        path,
        phantom.truth_map(person, patient, path),
    )


def _true_parts(cloud: PointCloud) -> Ints:
    assert cloud.parts is not None  # the phantom's clouds are labelled
    return cloud.parts


@lru_cache(maxsize=4)
def _whole_surface(seed: int, n: int) -> PointCloud:
    """The CT cloud of most levels of a pair: sampled once, shared."""
    return phantom.reference_cloud(phantom.draw_subject("ct1", seed), n, named_rng(seed, "robustness/ct"))


def _ct_cloud(person: phantom.SyntheticSubject, d: Disturbance, seed: int) -> PointCloud:
    if d.voxel_mm is None:
        return _whole_surface(seed, d.ct_points)
    _, labels = phantom.ct_volume(person, d.voxel_mm, named_rng(seed, "robustness/scanner"))
    mask = parts_from_labels(labels, load_manifest().label_ids("totalsegmentator_v2"))
    return sample_cloud(surface(mask), d.ct_points, named_rng(seed, "robustness/ct"))


def _swept(patient: phantom.SyntheticSubject, calibration_mm: float, seed: int) -> PointCloud:
    """The cloud, RAS+ and with times, of a virtual sweep over a patient with that calibration error and all others."""
    surface_ = canonical_surface()
    used, faces = np.unique(surface_.faces, return_inverse=True)
    parts = np.full(len(surface_.vertices), int(Part.STERNUM))
    parts[surface_.faces] = surface_.parts[:, None]
    mesh = Mesh(patient.phi.apply(surface_.vertices[used]), faces.reshape(-1, 3), parts[used], f"phantom:{seed}")
    errors = replace(SweepErrors(), calibration_mm=calibration_mm, calibration_deg=DEG_PER_MM * calibration_mm)
    sweep = simulate_sweep(mesh, FRONT, errors, named_rng(seed, "robustness/sweep"))
    return sweep_cloud(sweep, spacing_mm=SWEEP_SPACING_MM).cloud


def _missing(d: Disturbance, us: Floats, parts: Ints, seed: int) -> Bools:
    """Which US points (n,) lie in a missing strip or in the missing part of a cartilage."""
    gone = np.zeros(len(us), dtype=bool)
    rng = named_rng(seed, "robustness/strips")
    for _ in range(d.strips):
        middle, angle = us[rng.integers(len(us)), [0, 2]], rng.uniform(0, np.pi)
        offset = us[:, [0, 2]] - middle
        along, across = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        gone |= (np.abs(offset @ along) < STRIP_LENGTH_MM / 2) & (np.abs(offset @ across) < d.strip_mm / 2)
    part = CARTILAGES[named_rng(seed, "robustness/branch").integers(len(CARTILAGES))]
    if d.branch_share > 0:
        mine = parts == part
        lateral = np.abs(us[:, 0] - us[parts == Part.STERNUM, 0].mean())
        gone |= mine & (lateral >= np.quantile(lateral[mine], 1 - d.branch_share))
    return gone


def _with_outliers(us: Floats, share: float, rng: np.random.Generator) -> Floats:
    """The cloud with so many uniform points in its box that they are a ``share`` of all."""
    n = round(len(us) * share / (1 - share))
    low, high = us.min(axis=0) - MARGIN_MM, us.max(axis=0) + MARGIN_MM
    return np.concatenate([us, rng.uniform(low, high, (n, 3))])
