"""The whole road by the command line, from files as a site has them, gives the waypoints of the study's inner road."""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from phantom_files import scan
from site_files import SEED, Scene, read_fiducials, scene, write_site

from study import Registration, register_pair, sweep_cloud
from study.cli import main
from study.ct.growth import parts_from_landmarks
from study.datasets.people import anatomy_of
from study.files.clouds import read_ply, read_timed_ply
from study.files.landmarks import read_landmarks
from study.seeds import named_rng
from study.types import Bools, Floats, Ints
from study.ultrasound import cloud as cloud_module
from study.ultrasound import upper_contour

METHODS = ("gaussian_process", "skeleton_graph")
POINTS, SPACING_MM = 2000, 1.5
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


def inner(made: Scene, method: str, us: object = None) -> Registration:
    """The pair as the study registers it, without a file; another cloud of the patient where one is given."""
    return register_pair(made.ct.cloud.points, made.patient.cloud if us is None else us, method, SEED)


def masks_own_error_mm(made: Scene, method: str, way: Floats) -> Floats:
    """How far each waypoint (k,) moves, mm, at most over three draws, when every edge lies elsewhere in its pixel.

    A mask says in which pixel the surface begins, not where in it, and the reader takes the middle. So each edge is
    moved along its beam by an even draw of half a pixel either way, and the pair is registered again.
    """
    moved = []
    for draw in range(3):

        def anywhere(masks: Bools, draw: int = draw) -> tuple[Ints, Ints, Floats]:
            frames, columns, rows = upper_contour(masks)
            rng = np.random.default_rng(draw)
            return frames, columns, rows + rng.uniform(-0.5, 0.5, len(rows))

        with patch.object(cloud_module, "upper_contour", anywhere):
            us = sweep_cloud(made.sweep, spacing_mm=SPACING_MM)
        moved.append(np.linalg.norm(inner(made, method, us).transfer(made.ct.waypoints.points) - way, axis=1))
    return np.max(moved, axis=0)


@pytest.mark.parametrize("method", METHODS)
def test_waypoints_are_those_of_the_inner_road(site: Path, made: Scene, method: str) -> None:
    way = inner(made, method).transfer(made.ct.waypoints.points)
    labels, points = read_fiducials(site / method / "waypoints_us.mrk.json")
    assert tuple(labels) == tuple(made.ct.waypoints.labels)
    apart = np.linalg.norm(points - way, axis=1)
    own = masks_own_error_mm(made, method, way)
    assert own.max() > 0.01  # pixels of 0.4 mm do move a waypoint, so the draw reached the registration
    assert (apart <= own + FILES_MM).all(), (apart, own)
    # Both roads have the same masks here, so their error is no excuse.
    assert apart.max() <= FILES_MM, (apart, own)


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
