"""Cohorts: who is the atlas, who is the patient, and what is known of the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from study import phantom
from study.cartilage_growth import parts_from_landmarks, parts_from_ribs
from study.ct import parts_from_labels, sample_cloud, surface
from study.data.fetch import fetch, fetch_all, path_of
from study.data.landmarks import read_landmarks
from study.data.manifest import Cohort, Manifest, Subject, load_manifest
from study.data.volumes import read_labels, read_masks, read_volume
from study.deform import planted_deformation
from study.errors import StudyError
from study.params import PHANTOM_SEED, StudyParams
from study.pipeline import named_rng
from study.sweep import SweepErrors, simulate_sweep, true_parts
from study.types import Floats, Mesh, PointCloud, RigidTransform, Volume, Waypoints
from study.us import SweepReport, sweep_cloud
from study.waypoints import intercostal_waypoints

FRONT = np.array([0.0, 1.0, 0.0])  # RAS+: anterior
PLANTED_SOURCE = ("open", "lidc-0001")
PLANTED_SIZES_MM: Mapping[str, float] = {  # mean distance after a rigid fit, as between people
    "planted1": 5.0,
    "planted2": 6.0,
    "planted3": 7.0,
    "planted4": 8.0,
    "planted5": 9.0,
}
TruthMap = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Anatomy:
    """One person's sternum and cartilages, from a CT (sec. II-C.1).

    Attributes:
        name: of the subject.
        mesh: surface with parts, RAS+ mm.
        cloud: Poisson-disc samples of it, labelled.
        waypoints: the 20 waypoints: exact on the phantom, else by the paper's protocol on the labelled cloud.
        image, mask: the CT and its `Part` volume; None for a planted deformation, which has no image of its own.
    """

    name: str
    mesh: Mesh
    cloud: PointCloud
    waypoints: Waypoints
    image: Volume | None = None
    mask: Volume | None = None


@dataclass(frozen=True)
class Patient:
    """A simulated patient: what a virtual sweep sees of an anatomy.

    Attributes:
        anatomy: the truth, RAS+.
        cloud: the US cloud in the tracker's base frame; it knows its front, not its parts.
        labelled: the same cloud with the parts of the nearest true surface, as the paper's manual segmentation.
        T_us_ras: RAS+ to the tracker's base frame.
        report: frames used and dropped.
    """

    anatomy: Anatomy
    cloud: PointCloud
    labelled: PointCloud
    T_us_ras: RigidTransform
    report: SweepReport


def cohort_of(dataset: str) -> str:
    """The manifest's cohort that a dataset's files are in: its own, but `open` for ``planted``."""
    return PLANTED_SOURCE[0] if dataset == "planted" else dataset


def origin_of(dataset: str, name: str) -> str | None:
    """The subject whose known deformation this one is; None for a subject with a CT of its own."""
    return PLANTED_SOURCE[1] if dataset == "planted" and name in PLANTED_SIZES_MM else None


def pairs(dataset: str, params: StudyParams, manifest: Manifest | None = None) -> list[tuple[str, str]]:
    """The (CT, patient) pairs of a dataset.

    The phantom has one patient, as the paper; in the open cohorts each subject in turn is the patient of all others.
    A subject with role ``ct`` is never the patient, one with role ``patient`` never the CT.

    Raises:
        StudyError: no such dataset, nobody to pair, or real scans under a name that promises a known truth.
    """
    manifest = manifest or load_manifest()
    if dataset == "planted" and dataset not in manifest.cohorts:
        sources, targets = [PLANTED_SOURCE[1]], list(PLANTED_SIZES_MM)
    else:
        cohort = manifest.cohort(dataset)
        if dataset == "planted" or (dataset == "phantom" and cohort.kind != "generated"):
            raise StudyError(
                f"{manifest.path.name}: expected another name for a cohort of one's own, got {dataset!r}, whose truth "
                "is known; rename it"
            )
        subjects = cohort.subjects
        sources = [name for name, subject in subjects.items() if subject.role in ("ct", "any")]
        targets = [name for name, subject in subjects.items() if subject.role in ("patient", "any")]
    if params.max_targets:
        targets = targets[: params.max_targets]
    chosen = []
    for target in targets:
        others = [source for source in sources if source != target]
        chosen += [(source, target) for source in others[: params.max_sources or None]]
    if not chosen:
        raise StudyError(f"dataset {dataset!r}: expected two subjects or more, one of them a patient; got none to pair")
    return chosen


def load_anatomy(
    dataset: str, name: str, params: StudyParams, seed: int = 0, manifest: Manifest | None = None
) -> Anatomy:
    """One subject's surface and cloud, fetched or generated (sec. II-C.1).

    Raises:
        StudyError: an unknown name, a failed download, or an image without the anatomy.
    """
    origin = origin_of(dataset, name)
    if origin is not None:
        return plant(load_anatomy(dataset, origin, params, seed, manifest), name)
    manifest = manifest or load_manifest()
    cohort, subject = _subject(dataset, name, manifest)
    if cohort.kind == "generated":
        return phantom_anatomy(name, PHANTOM_SEED, params, seed)
    image, mask = _read(manifest, subject)
    return anatomy_of(name, image, mask, params.ct_points, named_rng(seed, f"{dataset}/{name}/anatomy"))


def phantom_anatomy(name: str, cohort_seed: int, params: StudyParams, seed: int = 0) -> Anatomy:
    """A synthetic person by the road of a real CT: volume and labels, surface, cloud; the waypoints are exact.

    Args:
        name: one of ``phantom.SUBJECTS``.
        cohort_seed: draws the person; ``PHANTOM_SEED`` is the reported cohort's.
        params: density of volume and cloud.
        seed: of the cloud's samples.
    """
    drawn = phantom.draw_subject(name, cohort_seed)
    image, labels = phantom.ct_volume(drawn, params.phantom_spacing_mm, named_rng(cohort_seed, f"ct/{name}"))
    mask = parts_from_labels(labels, load_manifest().label_ids("totalsegmentator_v2"))
    anatomy = anatomy_of(name, image, mask, params.ct_points, named_rng(seed, f"phantom/{name}/anatomy"))
    return replace(anatomy, waypoints=phantom.waypoints(drawn))


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
        labels: label volume on the CT's grid. Cartilage is taken from it where ``ids`` names it, else grown between
            the ribs' ends and the sternum.
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
        volume = read_labels(labels, image)
        mask = parts_from_labels(volume, ids) if "costal_cartilages" in ids else parts_from_ribs(image, volume, ids)
    return anatomy_of(image.name, image, mask, n_points, rng)


def fetch_subject(dataset: str, name: str, manifest: Manifest, progress: bool = False) -> None:
    """Fetch and verify the files that a subject's anatomy is read from.

    Raises:
        StudyError: an unknown name, or a file that cannot be had.
    """
    cohort, subject = _subject(dataset, name, manifest)
    alone = cohort.model_copy(update={"subjects": {name: subject}})
    fetch_all(manifest.model_copy(update={"cohorts": {name: alone}}), name, progress=progress)


def files_of_subject(dataset: str, name: str, manifest: Manifest) -> dict[str, Path]:
    """The files of a subject that are here, by key; a landmark file under its path in the manifest.

    Raises:
        StudyError: an unknown name.
    """
    _, subject = _subject(dataset, name, manifest)
    paths = {file.key: path_of(file) for file in manifest.files_of_subject(subject)}
    landmarks = manifest.landmarks_path(subject)
    if landmarks is not None:
        paths[str(subject.landmarks)] = landmarks
    return {key: path for key, path in paths.items() if path.exists()}


def _subject(dataset: str, name: str, manifest: Manifest) -> tuple[Cohort, Subject]:
    cohort = manifest.cohort(cohort_of(dataset))
    if name not in cohort.subjects:
        raise StudyError(f"{dataset}: expected a subject among {', '.join(cohort.subjects)}, got {name!r}")
    return cohort, cohort.subjects[name]


def _read(manifest: Manifest, subject: Subject) -> tuple[Volume, Volume]:
    """The CT and its mask of parts, from labels, rib labels or landmarks."""
    if subject.ct is None:
        raise StudyError(f"{manifest.path.name}: expected a ct for every subject of a file cohort, got none")
    image = read_volume(fetch(manifest.file(subject.ct)))
    chosen = subject.labels or subject.rib_labels
    landmarks = manifest.landmarks_path(subject)
    if chosen is not None:
        file = manifest.file(chosen.file)
        if file.is_family:
            paths = {mask.key.partition("/")[2]: fetch(mask) for mask in manifest.masks(chosen).values()}
            labels, ids = read_masks(paths, image)
        else:
            labels = read_labels(fetch(file), image)
            ids = manifest.label_ids(chosen.map)
        mask = parts_from_labels(labels, ids) if subject.labels else parts_from_ribs(image, labels, ids)
    elif landmarks is not None:
        mask = parts_from_landmarks(image, read_landmarks(landmarks))
    else:
        raise StudyError(
            f"{manifest.path.name}: expected labels, rib_labels or landmarks for {subject.title or subject.ct!r}, "
            "got none; without them cartilage cannot be told from muscle"
        )
    return image, mask


def plant(source: Anatomy, name: str) -> Anatomy:
    """The patient ``name`` of ``planted``: an anatomy under a known smooth deformation."""
    deform = _deformation(source.mesh, name)
    mesh = replace(source.mesh, vertices=deform(source.mesh.vertices), name=name)
    cloud = replace(source.cloud, points=deform(source.cloud.points), name=f"ct:{name}")
    waypoints = replace(source.waypoints, points=deform(source.waypoints.points))
    return Anatomy(name, mesh, cloud, waypoints)


def _deformation(mesh: Mesh, name: str) -> TruthMap:
    return planted_deformation(mesh.vertices, PLANTED_SIZES_MM[name], named_rng(0, f"planted/{name}")).apply


def has_truth(dataset: str) -> bool:
    """Whether the deformation between a dataset's people is known."""
    return dataset in ("phantom", "planted")


def truth_map(dataset: str, source: Anatomy, target: str) -> TruthMap | None:
    """Where each point of the source anatomy truly lies in the target's, both RAS+; None between two real people."""
    if dataset == "phantom":
        one, other = (phantom.draw_subject(name, PHANTOM_SEED) for name in (source.name, target))
        return partial(phantom.truth_map, one, other)
    if dataset == "planted":
        return _deformation(source.mesh, target)
    return None


def make_patient(anatomy: Anatomy, params: StudyParams, seed: int = 0, errors: SweepErrors | None = None) -> Patient:
    """Sweep an anatomy with a virtual tracked probe whose base frame is anywhere (sec. II-C.2).

    Args:
        anatomy: the person on the couch.
        params: density of the cloud.
        seed: of the hand, the errors and the base frame.
        errors: what goes wrong; every source at its default size when None.
    """
    rng = named_rng(seed, f"{anatomy.name}/sweep")
    T_us_ras = RigidTransform.random(named_rng(seed, f"{anatomy.name}/base"))
    sweep = simulate_sweep(
        anatomy.mesh,
        FRONT,
        SweepErrors() if errors is None else errors,
        rng,
        T_base_patient=T_us_ras,
        name=f"us:{anatomy.name}",
    )
    seen = sweep_cloud(sweep, spacing_mm=params.us_spacing_mm)
    cloud = replace(seen.cloud, front=seen.front)
    labelled = replace(cloud, parts=true_parts(T_us_ras.inverse.apply(cloud.points), anatomy.mesh))
    return Patient(anatomy, cloud, labelled, T_us_ras, seen.report)
