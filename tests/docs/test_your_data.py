"""Every command of docs/your-data.md, run as it stands and in its order, on small sample files."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from phantom_files import nifti, scan, structure_ids
from scipy.spatial import KDTree

from study.ct.parts import parts_from_labels
from study.files.clouds import read_ply
from study.files.meanings import FILES

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "your-data.md"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
RUNNERS = {"sh": ["bash", "-euo", "pipefail", "-c"], "python": [sys.executable, "-c"]}
LPS = [-1.0, -1.0, 1.0]


@pytest.fixture(scope="module")
def done(samples: Path) -> Path:
    """The folder after every block of the page; a block of another language is not run."""
    blocks = [(kind, code) for kind, code in BLOCK.findall(PAGE.read_text(encoding="utf-8")) if kind in RUNNERS]
    assert len(blocks) >= 5
    environment = os.environ | {
        "PATH": os.pathsep.join([str(samples / "bin"), os.environ["PATH"]]),
        "PYTHONPATH": str(ROOT / "src"),
        "PYTHONUTF8": "1",
    }
    for kind, code in blocks:
        run = subprocess.run(
            [*RUNNERS[kind], code], cwd=samples, env=environment, capture_output=True, encoding="utf-8", timeout=300
        )
        assert run.returncode == 0, f"{code}\n{run.stdout}\n{run.stderr}"
        assert "warning" not in run.stderr, f"{code}\n{run.stderr}"
    return samples


def test_waypoints_end_in_the_trackers_frame_with_normals_and_bounds(done: Path) -> None:
    robot = json.loads((done / "registered" / "waypoints_robot.json").read_text(encoding="utf-8"))
    given = json.loads((done / "waypoints.mrk.json").read_text(encoding="utf-8"))["markups"][0]["controlPoints"]
    assert not robot["suspect"]
    assert [one["label"] for one in robot["waypoints"]] == [one["label"] for one in given]
    us = read_ply(done / "us.ply")
    for one in robot["waypoints"]:
        assert KDTree(us).query(one["position"])[0] < 25.0  # between two cartilages
        assert one["normal_from"] == "surface"
        assert 0 < one["bound_mm"] < 10


def test_the_resampled_ct_lies_where_warped_is(done: Path) -> None:
    image = sitk.ReadImage(str(done / "ct_in_us_frame.nii.gz"))
    # The CT also shows ribs and other cartilages, so the parts that the cloud has are carried by the same field.
    parts = parts_from_labels(scan("ct1")[1], structure_ids())
    there = sitk.ReadImage(str(nifti(parts.with_values((parts.values > 0).astype(np.uint8)), done / "parts.nii.gz")))
    field = sitk.ReadImage(str(done / "registered" / "displacement.nii.gz"), sitk.sitkVectorFloat64)
    moved = sitk.Resample(there, image, sitk.DisplacementFieldTransform(field), sitk.sitkNearestNeighbor, 0)
    inside = sitk.GetArrayFromImage(moved).T > 0
    values = sitk.GetArrayFromImage(image).T
    assert np.median(values[inside]) > np.median(values[~inside]) + 100  # HU
    bone = np.argwhere(inside)
    places = np.array([image.TransformIndexToPhysicalPoint(index.tolist()) for index in bone]) * LPS
    warped = read_ply(done / "registered" / "warped.ply")
    assert np.median(KDTree(warped).query(places)[0]) < 4.0  # a voxel
    assert np.median(KDTree(places).query(warped)[0]) < 4.0


def test_the_page_of_formats_names_every_file() -> None:
    formats = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in formats for name in FILES)
    assert (ROOT / "docs" / "formats.md").name in PAGE.read_text(encoding="utf-8")
