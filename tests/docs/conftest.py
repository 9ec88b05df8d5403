"""Small sample files under the names that the pages use. A part of a page adds its own here."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from study import phantom
from study.files.clouds import write_ply
from study.types import Floats, PointCloud, RigidTransform

T_TRACKER = RigidTransform.random(np.random.default_rng(4))
LPS = [-1.0, -1.0, 1.0]


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sample files, and `study` in its ``bin``."""
    folder = tmp_path_factory.mktemp("samples")
    program = folder / "bin" / "study"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m study "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    clouds_and_waypoints(folder)
    return folder


def clouds_and_waypoints(folder: Path) -> None:
    """``ct.ply``, ``us.ply`` in a tracker's frame, ``waypoints.mrk.json`` in LPS, and ``ct.nii.gz``."""
    rng = np.random.default_rng(3)
    person, patient = phantom.draw_subject("ct1", 0), phantom.draw_subject("patient", 0)
    ct = phantom.reference_cloud(person, 3000, rng).points
    us = phantom.anterior_cloud(patient, 2500, 0.5, 2, rng).points
    write_ply(PointCloud(ct), folder / "ct.ply")
    write_ply(PointCloud(T_TRACKER.apply(us)), folder / "us.ply")
    way = phantom.waypoints(person)
    points = [
        {"label": label, "position": (place * LPS).tolist()}
        for label, place in zip(way.labels, way.points, strict=True)
    ]
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    (folder / "waypoints.mrk.json").write_text(json.dumps({"markups": [markup]}), encoding="utf-8")
    small_ct(ct * LPS, folder / "ct.nii.gz")


def small_ct(points: Floats, path: Path) -> None:
    """A CT of 4 mm voxels, 300 HU where the points (n, 3) mm, LPS, are and -1000 elsewhere."""
    low = points.min(axis=0) - 20
    voxels = np.round((points - low) / 4).astype(int)
    values = np.full(voxels.max(axis=0) + 6, -1000, dtype=np.int16)
    values[tuple(voxels.T)] = 300
    image = sitk.GetImageFromArray(np.ascontiguousarray(values.T))
    image.SetOrigin(low.tolist())
    image.SetSpacing([4.0] * 3)
    sitk.WriteImage(image, str(path))
