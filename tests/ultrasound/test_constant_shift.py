"""The constant part of a sweep's errors, against the same sweep without them."""

from dataclasses import replace

import numpy as np
import pytest
from small_sweeps import flat_sweep

from study.errors import StudyError
from study.geometry.rays import surface_distance_mm
from study.types import RigidTransform
from study.ultrasound.cloud import contour_points
from study.ultrasound.constant_shift import constant_shift_mm
from study.ultrasound.probe import Probe
from study.ultrasound.sweep_errors import SweepErrors


def test_the_shift_of_a_calibration_is_that_of_every_pixel(record):
    clean, off = (record(errors) for errors in (SweepErrors.none(), SweepErrors.only("calibration")))
    right, frames, *_ = contour_points(clean)
    wrong, also, *_ = contour_points(off)
    assert np.array_equal(frames, also)  # the same pixels, so points pair
    shift = constant_shift_mm(off, SweepErrors.only("calibration"))
    np.testing.assert_allclose(shift, (wrong - right).mean(axis=0), atol=1e-9)
    assert 0.3 < np.linalg.norm(shift) < 1.2


def test_fat_shifts_the_cloud_along_the_beams(record):
    errors = SweepErrors.only("speed of sound")
    clean, slow = record(SweepErrors.none()), record(errors)
    beam = contour_points(clean)[2]
    shift = constant_shift_mm(slow, errors)
    # Every echo here comes from below the fat: 0.69 mm along each beam, and beams fan out around the chest.
    assert 0.6 < shift @ beam < 10 * (1540 / 1440 - 1) + 1e-9
    assert np.linalg.norm(shift - (shift @ beam) * beam) < 0.1


def test_fat_that_is_deeper_than_the_bone_delays_by_the_way_to_it():
    errors = replace(SweepErrors.none(), fat_mm=100.0)
    probe = Probe()
    sweep = flat_sweep(T_probe_image=probe.T_probe_image)  # shown at 19.75 mm, truly at 1440/1540 of that
    shift = constant_shift_mm(sweep, errors, probe)
    np.testing.assert_allclose(np.linalg.norm(shift), 19.75 * (1 - 1440 / 1540), atol=1e-9)


@pytest.mark.parametrize("source", ["latency", "breathing", "tracking", "contour jitter", "dropped frames"])
def test_what_has_no_constant_part_shifts_nothing(record, source):
    errors = SweepErrors.only(source)
    assert np.abs(constant_shift_mm(record(errors), errors)).max() < 1e-12


def test_once_the_shift_is_out_the_cloud_lies_on_the_surface(record, seen):
    every = SweepErrors()
    errors = replace(SweepErrors.none(), calibration_mm=every.calibration_mm, fat_mm=every.fat_mm)
    sweep = record(errors, 1)
    points = contour_points(sweep)[0][::20]
    as_it_is, without = (
        surface_distance_mm(points - off, seen).mean() for off in (np.zeros(3), constant_shift_mm(sweep, errors))
    )
    assert without < 0.5 * as_it_is


def test_the_shift_turns_with_the_trackers_frame(record):
    sweep, errors = record(SweepErrors()), SweepErrors()
    motion = RigidTransform.random(np.random.default_rng(3))
    away = replace(sweep, poses=motion.matrix @ sweep.poses)
    np.testing.assert_allclose(
        constant_shift_mm(away, errors), motion.rotation @ constant_shift_mm(sweep, errors), atol=1e-9
    )


def test_a_sweep_that_shows_nothing_has_no_shift():
    with pytest.raises(StudyError, match="expected a virtual sweep with masks and a calibration"):
        constant_shift_mm(flat_sweep(T_probe_image=None), SweepErrors())
    with pytest.raises(StudyError, match="expected a contour in some tracked frame"):
        constant_shift_mm(flat_sweep(masks=np.zeros((60, 60, 100), dtype=bool)), SweepErrors())
