"""Phantom scans for tests, drawn once a process, and as the files that people have."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from study import phantom
from study.data.manifest import load_manifest
from study.files.landmarks import read_landmarks
from study.files.volumes import write_volume
from study.params import PHANTOM_SEED, StudyParams
from study.seeds import named_rng
from study.types import CARTILAGES, Part, Volume

SPACING_MM = 2.5
SMALL = StudyParams(ct_points=2000, us_spacing_mm=3.0, phantom_spacing_mm=SPACING_MM, max_sources=1, max_targets=1)


@cache
def scan(name: str) -> tuple[Volume, Volume]:
    """The CT and its labels, as `study.datasets.phantoms.PhantomDataset` draws them at `SPACING_MM`."""
    return _ct_volume(phantom.draw_subject(name, PHANTOM_SEED), SPACING_MM, named_rng(PHANTOM_SEED, f"ct/{name}"))


def cached_ct_volume(
    drawn: phantom.SyntheticSubject, spacing_mm: float, _rng: np.random.Generator
) -> tuple[Volume, Volume]:
    """In place of `phantom.ct_volume`, whose noise is the same in every run."""
    assert spacing_mm == SPACING_MM
    return scan(drawn.name)


_ct_volume = phantom.ct_volume


def structure_ids() -> dict[str, int]:
    return load_manifest().label_ids("totalsegmentator_v2")


def ribseg_labels(labels: Volume) -> Volume:
    """Rib labels as RibSeg has them: 1-12 right, 13-24 left, from the top; no cartilage, no sternum."""
    ids = structure_ids()
    table = np.zeros(256, dtype=np.uint8)
    for label, name in load_manifest().label_map("ribseg_v2").items():
        table[ids[name]] = label
    return replace(labels, values=table[labels.values])


def nifti(volume: Volume, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_volume(volume, path)


def landmark_file(parts: Volume, path: Path) -> Path:
    """Landmarks read off a volume of parts: the ends of each cartilage and the middle of the sternum."""
    sternum = parts.to_mm(np.argwhere(parts.values == Part.STERNUM))
    junctions, attachments = {}, {}
    for part in CARTILAGES:
        voxels = parts.to_mm(np.argwhere(parts.values == part))
        reach = np.abs(voxels[:, 0] - sternum[:, 0].mean())
        name = part.name.lower()
        junctions[name] = voxels[reach > reach.max() - 4].mean(axis=0).tolist()
        attachments[name] = voxels[reach < reach.min() + 4].mean(axis=0).tolist()
    line = [
        sternum[np.abs(sternum[:, 2] - z) < 4].mean(axis=0).tolist()
        for z in np.linspace(sternum[:, 2].max(), sternum[:, 2].min(), 5)
    ]
    content = {
        "subject": "phantom",
        "frame": "RAS+ mm",
        "made_by": "a test",
        "method": "read off its labels",
        "junctions": junctions,
        "attachments": attachments,
        "sternum": line,
    }
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def points_file(path: Path, source: Path, space: str = "LPS", rename: dict[str, str] | None = None) -> Path:
    """The landmarks of a YAML file as 3D Slicer saves points."""
    landmarks = read_landmarks(source)
    named = {f"junction {p.side} {p.level}": landmarks.junctions[p] for p in CARTILAGES}
    named |= {f"Attachment_{p.side}-{p.level}": landmarks.attachments[p] for p in CARTILAGES}
    named |= {f"sternum {k}": point for k, point in enumerate(landmarks.sternum, start=1)}
    sign = np.array([-1.0, -1.0, 1.0]) if space == "LPS" else np.ones(3)
    control = [
        {"label": (rename or {}).get(label, label), "position": (sign * point).tolist()}
        for label, point in reversed(named.items())  # in any order
    ]
    markup = {"type": "Fiducial", "coordinateSystem": space, "coordinateUnits": "mm", "controlPoints": control}
    path.write_text(json.dumps({"markups": [markup]}), encoding="utf-8")
    return path


def masks_folder(folder: Path, without: tuple[str, ...] = ()) -> Path:
    """The labels of a phantom as TotalSegmentator writes them: a binary file for each structure, others beside."""
    labels = scan("ct1")[1]
    for name, value in structure_ids().items():
        if name not in without:
            nifti(labels.with_values((labels.values == value).astype(np.uint8)), folder / f"{name}.nii.gz")
    nifti(labels.with_values(np.zeros(labels.shape, np.uint8)), folder / "liver.nii.gz")
    return folder


def own_manifest(folder: Path, names: tuple[str, ...] = ("ct1", "ct2"), cohort: str = "mine") -> Path:
    """A manifest of one's own: local NIfTI scans with labels, named relative to it."""
    files, subjects = {}, {}
    for name in names:
        for what, volume in zip(("ct", "labels"), scan(name), strict=True):
            nifti(volume, folder / "scans" / f"{name}_{what}.nii.gz")
            source = {"kind": "local", "path": f"scans/{name}_{what}.nii.gz"}
            files[f"{name}_{what}"] = {"role": what, "source": source}
        subjects[name] = {"ct": f"{name}_ct", "labels": {"file": f"{name}_labels", "map": "totalsegmentator_v2"}}
    path = folder / "my_manifest.yaml"
    path.write_text(yaml.safe_dump({"files": files, "cohorts": {cohort: {"subjects": subjects}}}), encoding="utf-8")
    return path
