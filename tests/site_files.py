"""What a site has before anything of this package has run: a CT on a disc, a PLUS recording, points of 3D Slicer."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import SimpleITK as sitk
from phantom_files import landmark_file, masks_folder, nifti, points_file, scan, structure_ids
from plus_files import plus_recording

from study.ct.parts import parts_from_labels
from study.datasets import people
from study.params import StudyParams
from study.seeds import named_rng
from study.types import Bools, Floats, Waypoints
from study.ultrasound import Probe, SweepErrors, TrackedSweep, sweep_cloud

SEED = 0
PROBE = Probe(pixel_mm=0.4, frames_per_s=30.0)
LPS = [-1.0, -1.0, 1.0]


@dataclass(frozen=True)
class Scene:
    """A CT, and a sweep over another person as it is in memory, with the patient that the study makes of it."""

    ct: people.Anatomy
    sweep: TrackedSweep
    patient: people.Patient


@cache
def scene(ct_points: int, us_spacing_mm: float, errors: SweepErrors | None = None) -> Scene:
    """The inner road up to the two clouds, with coarser pixels than the study's; every error at its size when None."""
    ids = structure_ids()
    persons = []
    for name in ("ct1", "patient"):
        image, labels = scan(name)
        rng = named_rng(SEED, "cloud/CT")  # as `study cloud CT` draws
        persons.append(people.anatomy_of(name, image, parts_from_labels(labels, ids), ct_points, rng))
    kept = []

    def keep(sweep: TrackedSweep, **given: float) -> object:
        kept.append(sweep)
        return sweep_cloud(sweep, **given)

    params = StudyParams(ct_points=ct_points, us_spacing_mm=us_spacing_mm)
    with (
        patch.object(people, "simulate_sweep", partial(people.simulate_sweep, probe=PROBE)),
        patch.object(people, "sweep_cloud", keep),
    ):
        patient = people.make_patient(persons[1], params, SEED, errors)
    return Scene(persons[0], kept[0], patient)


def write_site(folder: Path, made: Scene) -> None:
    """``CT/`` (DICOM), ``segmentations/``, ``landmarks.mrk.json``, ``recording.nrrd`` with its configuration,
    ``masks.seg.nrrd`` and ``waypoints.mrk.json``.
    """
    dicom_series(folder, folder / "CT")
    masks_folder(folder / "segmentations")
    parts = parts_from_labels(scan("ct1")[1], structure_ids())
    points_file(folder / "landmarks.mrk.json", landmark_file(parts, folder / "landmarks.yaml"))
    (folder / "landmarks.yaml").unlink()
    assert made.sweep.masks is not None
    plus_recording(folder / "recording.nrrd", as_plus_records(made.sweep))
    segmentation(made.sweep.masks, folder / "masks.seg.nrrd")
    fiducials(made.ct.waypoints, folder / "waypoints.mrk.json")


def dicom_series(scratch: Path, folder: Path) -> None:
    """The CT as a scanner stores it: slices from foot to head, rows along L and P, the values in short integers."""
    plain = nifti(scan("ct1")[0], scratch / "ct.nii.gz")
    image = sitk.DICOMOrient(sitk.Cast(sitk.ReadImage(str(plain)), sitk.sitkInt16), "LPS")
    plain.unlink()
    folder.mkdir()
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k in range(image.GetSize()[2]):
        one = image[:, :, k]
        place = "\\".join(f"{value:.6f}" for value in image.TransformIndexToPhysicalPoint((0, 0, k)))
        for tag, value in {
            "0008|0060": "CT",
            "0020|000e": "1.2.3",
            "0020|000d": "1.2.4",
            "0008|0018": f"1.2.3.{k + 1}",
            "0020|0013": str(k),
            "0020|0032": place,
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0028|1052": "0",
            "0028|1053": "1",
        }.items():
            one.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"IM{k:04d}.dcm"))
        writer.Execute(one)


def as_plus_records(sweep: TrackedSweep) -> TrackedSweep:
    """The sweep as PLUS stores it: the latency out of the stamps, and B-mode: a bright line with speckle around it."""
    assert sweep.masks is not None
    rng = np.random.default_rng(0)
    speckle = rng.integers(0, 60, sweep.masks.shape[1:], dtype=np.uint8)
    images = np.where(sweep.masks, np.uint8(220), speckle)
    return replace(sweep, frame_times_s=sweep.frame_times_s - sweep.latency_s, latency_s=0.0, images=images)


def segmentation(masks: Bools, path: Path) -> None:
    """Masks (f, h, w) as 3D Slicer saves a segmentation: one segment, cropped to what was drawn."""
    image = sitk.GetImageFromArray(masks.astype(np.uint8))
    box = tuple(slice(int(used.min()), int(used.max()) + 1) for used in np.nonzero(masks)[::-1])
    image = image[box]
    for key, value in (("Name", "bone"), ("LabelValue", "1"), ("Layer", "0")):
        image.SetMetaData(f"Segment0_{key}", value)
    sitk.WriteImage(image, str(path), True)


def fiducials(way: Waypoints, path: Path) -> None:
    """Waypoints as 3D Slicer saves a point list."""
    points = [
        {"label": label, "position": (place * LPS).tolist()}
        for label, place in zip(way.labels, way.points, strict=True)
    ]
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    path.write_text(json.dumps({"markups": [markup]}), encoding="utf-8")


def read_fiducials(path: Path) -> tuple[list[str], Floats]:
    """Labels and points (k, 3) mm, RAS, of a point list, read by hand."""
    markup = json.loads(path.read_text(encoding="utf-8"))["markups"][0]
    sign = np.array(LPS) if markup["coordinateSystem"] == "LPS" else np.ones(3)
    points = markup["controlPoints"]
    return [one["label"] for one in points], np.array([one["position"] for one in points]) * sign
