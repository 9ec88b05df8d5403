"""The whole road by the command line, from files as a site has them, gives the waypoints of the study's inner road."""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from phantom_files import scan
from site_files import SEED, Scene, read_fiducials, scene, write_site

from study import register_pair
from study.cli import main
from study.ct.growth import parts_from_landmarks
from study.datasets.people import anatomy_of
from study.files.clouds import read_ply, read_timed_ply
from study.files.landmarks import read_landmarks
from study.seeds import named_rng

METHODS = ("gaussian_process", "skeleton_graph")
POINTS, SPACING_MM = 2000, 2.0
FILES_MM = 0.1  # what files and command line may add


def study(*words: str | Path) -> str:
    said = StringIO()
    with redirect_stdout(said):
        assert main([str(word) for word in words]) == 0
    return said.getvalue()


@pytest.fixture(scope="module")
def made() -> Scene:
    return scene(POINTS, SPACING_MM)


@pytest.fixture(scope="module")
def site(made: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the site's files, and what the three commands made of them."""
    folder = tmp_path_factory.mktemp("site")
    write_site(folder, made)
    ct, us, masks = folder / "ct.ply", folder / "us.ply", folder / "masks.seg.nrrd"
    study("cloud", folder / "CT", "--labels", folder / "segmentations", "--points", str(POINTS), "--out", ct)
    said = study("sweep", folder / "recording.nrrd", "--masks", masks, "--spacing", str(SPACING_MM), "--out", us)
    front = said.split("--front ")[1].split()[0]
    for method in METHODS:
        way = ["--waypoints", folder / "waypoints.mrk.json", "--front", front]
        study("register", ct, us, *way, "--method", method, "--out", folder / method)
    return folder


@pytest.mark.parametrize("method", METHODS)
def test_waypoints_are_those_of_the_inner_road(site: Path, made: Scene, method: str) -> None:
    way = register_pair(made.ct.cloud.points, made.patient.cloud, method, SEED).transfer(made.ct.waypoints.points)
    labels, points = read_fiducials(site / method / "waypoints_us.mrk.json")
    assert tuple(labels) == tuple(made.ct.waypoints.labels)
    apart = np.linalg.norm(points - way, axis=1)
    # Both roads have the same masks, pixel for pixel, so the masks' own error is in both and none is allowed for.
    assert apart.max() <= FILES_MM, apart


def test_every_step_on_the_way_is_that_of_the_inner_road(site: Path, made: Scene) -> None:
    np.testing.assert_allclose(read_ply(site / "ct.ply"), made.ct.cloud.points, atol=1e-6)
    points, times = read_timed_ply(site / "us.ply")
    np.testing.assert_allclose(points, made.patient.cloud.points, atol=1e-6)
    assert made.patient.cloud.times is not None
    np.testing.assert_allclose(times, made.patient.cloud.times, atol=1e-6)


def test_landmarks_of_slicer_give_the_cloud_that_grows_from_them(site: Path) -> None:
    out, marks = site / "grown.ply", site / "landmarks.mrk.json"
    study("cloud", site / "CT", "--landmarks", marks, "--points", str(POINTS), "--out", out)
    image, _ = scan("ct1")
    parts = parts_from_landmarks(image, read_landmarks(marks))
    expected = anatomy_of("CT", image, parts, POINTS, named_rng(SEED, "cloud/CT")).cloud.points
    np.testing.assert_allclose(read_ply(out), expected, atol=1e-6)
