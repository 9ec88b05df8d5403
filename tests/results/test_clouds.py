"""Clouds kept for pictures: rounded to a step, told from altered ones, no part of what a run is compared by."""

from pathlib import Path

import numpy as np
import pytest

from study.errors import StudyError
from study.registration import Registration
from study.results.clouds import STEP_MM, Clouds, Steps, pack, write_clouds
from study.types import Floats, RigidTransform

START = RigidTransform()


def registration(warped: Floats) -> Registration:
    return Registration(warped, warped, RigidTransform(), True, 0, "made")


def test_points_come_back_to_half_a_step(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    near, path = 900 + rng.normal(scale=80, size=(500, 3)), rng.normal(scale=60, size=(20, 3))
    far = rng.normal(scale=900, size=(500, 3))  # farther apart than int16 counts in steps
    packed = {
        ("a", "p", "icp"): pack(registration(near), path, START),
        ("a", "p", "cpd"): pack(registration(far), path, START),
    }
    write_clouds(packed, tmp_path / "clouds.npz")
    clouds = Clouds(tmp_path / "clouds.npz")
    assert set(clouds) == set(packed)
    assert set(clouds["a", "p", "icp"]) == {"warped", "path", "start"}
    assert np.abs(clouds["a", "p", "icp"]["warped"] - near).max() <= STEP_MM / 2 + 1e-9
    assert np.abs(clouds["a", "p", "icp"]["path"] - path).max() <= STEP_MM / 2 + 1e-9
    assert np.abs(clouds["a", "p", "cpd"]["warped"] - far).max() <= np.ptp(far, axis=0).max() / 2 / 32767
    assert Steps.of(far).step_mm > STEP_MM


def test_equal_cases_give_equal_bytes_in_any_order(tmp_path: Path) -> None:
    path = np.zeros((3, 3))
    packed = {("a", "p", m): pack(registration(np.full((60, 3), float(k))), path, START) for k, m in enumerate("xyz")}
    write_clouds(packed, tmp_path / "one")
    write_clouds(dict(reversed(packed.items())), tmp_path / "two")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_what_is_no_file_of_clouds_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"got: .*run the data set again"):
        Clouds(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no clouds", encoding="utf-8")
    with pytest.raises(StudyError, match="run the data set again"):
        Clouds(tmp_path / "text.npz")
