"""The people of a data set: an anatomy from a CT, and the patient that a virtual sweep makes of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from study.ct.growth import parts_from_landmarks, parts_from_ribs
from study.ct.parts import parts_from_labels
from study.ct.surface import sample_cloud, surface
from study.errors import StudyError
from study.evaluation.waypoints import intercostal_waypoints
from study.files.landmarks import read_landmarks
from study.files.volumes import masks_in, read_labels, read_masks, read_volume
from study.naming import sweep_name
from study.params import StudyParams
from study.phantom.deformation import Deformation
from study.seeds import named_rng
from study.types import Floats, Mesh, PointCloud, RigidTransform, Volume, Waypoints
from study.ultrasound.cloud import SweepReport, sweep_cloud
from study.ultrasound.constant_shift import constant_shift_mm
from study.ultrasound.sweep_errors import SweepErrors
from study.ultrasound.tracked import TrackedSweep
from study.ultrasound.virtual_sweep import simulate_sweep
from study.ultrasound.visible import true_parts

FRONT = np.array([0.0, 1.0, 0.0])  # RAS+: anterior


@dataclass(frozen=True)
class Anatomy:
    """One person's sternum and cartilages, from a CT (sec. II-C.1).

    Attributes:
        name: of the subject.
        mesh: surface with parts, RAS+ mm.
        cloud: Poisson-disc samples of it, labelled.
        waypoints: the 20 waypoints: exact on the phantom, else by the paper's protocol on the labelled cloud.
        image, mask: the CT and its `Part` volume; None for a planted deformation, which has no image of its own.
        planted: the deformation that made this person out of another one; None for a person of their own.
    """

    name: str
    mesh: Mesh
    cloud: PointCloud
    waypoints: Waypoints
    image: Volume | None = None
    mask: Volume | None = None
    planted: Deformation | None = None

    def without_images(self) -> Anatomy:
        """The same without its images, which are large and of no use to a registration."""
        return replace(self, image=None, mask=None)


@dataclass(frozen=True)
class Patient:
    """A simulated patient: what a virtual sweep sees of an anatomy.

    Attributes:
        anatomy: the truth, RAS+.
        cloud: the US cloud in the tracker's base frame; it knows its front, not its parts.
        labelled: the same cloud with the parts of the nearest true surface, as the paper's manual segmentation.
        T_us_ras: RAS+ to the tracker's base frame.
        report: frames used and dropped.
        shift_mm: (3,) mm, base frame, the constant part of the sweep's errors; see `constant_shift_mm`.
        sweep: its number among the sweeps of this anatomy.
    """

    anatomy: Anatomy
    cloud: PointCloud
    labelled: PointCloud
    T_us_ras: RigidTransform
    report: SweepReport
    shift_mm: Floats
    sweep: int = 0

    @property
    def name(self) -> str:
        """Of the patient in this sweep, see `study.naming.sweep_name`."""
        return sweep_name(self.anatomy.name, self.sweep)


def anatomy_of(name: str, image: Volume, mask: Volume, n_points: int, rng: np.random.Generator) -> Anatomy:
    """Surface, cloud and protocol waypoints of a CT whose parts are known (sec. II-C.1, IV-B)."""
    mesh = replace(surface(mask), name=name)
    cloud = replace(sample_cloud(mesh, n_points, rng), name=f"ct:{name}")
    return Anatomy(name, mesh, cloud, intercostal_waypoints(cloud), image, mask)


def read_anatomy(
    ct: Path,
    n_points: int,
    rng: np.random.Generator,
    *,
    labels: Path | None = None,
    ids: Mapping[str, int] | None = None,
    landmarks: Path | None = None,
) -> Anatomy:
    """The anatomy of a CT of one's own, from a label volume or a landmark file (sec. II-C.1).

    Args:
        ct: image file, or folder of a DICOM series.
        n_points: of the cloud.
        rng: of the samples.
        labels: label volume on the CT's grid, or a folder of masks named after structures. Cartilage is taken from it
            where ``ids`` names it and the folder has it, else grown between the ribs' ends and the sternum.
        ids: label id of each structure.
        landmarks: landmark file instead of labels.

    Raises:
        StudyError: both or neither of labels and landmarks, an unreadable file, or an image without the anatomy.
    """
    if (labels is None) == (landmarks is None):
        raise StudyError(f"expected labels or landmarks, got {'neither' if labels is None else 'both'}; give one")
    image = read_volume(ct)
    if labels is None:
        assert landmarks is not None
        mask = parts_from_landmarks(image, read_landmarks(landmarks))
    else:
        ids = ids or {}
        if labels.is_dir():
            volume, ids = read_masks(masks_in(labels, ids), image)
        else:
            volume = read_labels(labels, image)
        mask = parts_from_labels(volume, ids) if "costal_cartilages" in ids else parts_from_ribs(image, volume, ids)
    return anatomy_of(image.name, image, mask, n_points, rng)


def make_patient(
    anatomy: Anatomy, params: StudyParams, seed: int = 0, errors: SweepErrors | None = None, sweep: int = 0
) -> Patient:
    """Sweep an anatomy with a virtual tracked probe whose base frame is anywhere (sec. II-C.2).

    Args:
        anatomy: the person on the couch.
        params: density of the cloud.
        seed: of the hand, the errors and the base frame.
        errors: what goes wrong; every source at its default size when None.
        sweep: its number; another one has a hand, errors and a base frame of its own.
    """
    errors = SweepErrors() if errors is None else errors
    name = sweep_name(anatomy.name, sweep)
    T_us_ras = RigidTransform.random(named_rng(seed, f"{name}/base"))
    tracked = sweep_over(anatomy, T_us_ras, named_rng(seed, f"{name}/sweep"), errors)
    seen = sweep_cloud(tracked, spacing_mm=params.us_spacing_mm)
    cloud = replace(seen.cloud, front=seen.front)
    labelled = replace(cloud, parts=true_parts(T_us_ras.inverse.apply(cloud.points), anatomy.mesh))
    return Patient(anatomy, cloud, labelled, T_us_ras, seen.report, constant_shift_mm(tracked, errors), sweep)


def sweep_over(
    anatomy: Anatomy, T_us_ras: RigidTransform, rng: np.random.Generator, errors: SweepErrors | None = None
) -> TrackedSweep:
    """The virtual sweep over a person's front, in the tracker's frame; all errors at their sizes when None."""
    return simulate_sweep(
        anatomy.mesh,
        FRONT,
        SweepErrors() if errors is None else errors,
        rng,
        T_base_patient=T_us_ras,
        name=f"us:{anatomy.name}",
    )
