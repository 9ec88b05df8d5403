"""The virtual sweep: every error alone, of the size it claims, over an anatomy that is known."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import KDTree
from small_sweeps import FRONT, depths_mm
from trimesh.creation import box

from study.errors import StudyError
from study.geometry.rays import surface_distance_mm
from study.types import Mesh, RigidTransform
from study.ultrasound import virtual_sweep
from study.ultrasound.breathing import quiet_breathing
from study.ultrasound.cloud import contour_points, sweep_cloud
from study.ultrasound.probe import Probe
from study.ultrasound.sweep_errors import ERROR_SOURCES, LATENCY_S, SweepErrors
from study.ultrasound.virtual_sweep import simulate_sweep
from study.ultrasound.visible import true_parts, visible_mesh, visible_surface


def test_without_errors_the_cloud_is_the_visible_surface(chest, record, seen):
    result = sweep_cloud(record(SweepErrors.none()))
    distance = surface_distance_mm(result.cloud.points, seen)
    assert distance.mean() < 0.2
    assert np.percentile(distance, 99) < 1.5
    # ... and all of it: the points of the independent fixture have cloud beside them.
    fixture = visible_surface(chest, FRONT, 2.0, np.random.default_rng(0))
    assert np.mean(KDTree(result.cloud.points).query(fixture.points)[0] < 2.5) > 0.98
    assert result.report.n_dropped == 0
    assert result.cloud.parts is None
    assert result.front @ FRONT > 0.95
    assert set(true_parts(result.cloud.points, chest)) == set(range(9))


@pytest.mark.parametrize("seed", range(6))
def test_with_every_error_but_breathing_the_cloud_lies_within_1_5_mm(mean_error_mm, seed):
    error = mean_error_mm(dataclasses.replace(SweepErrors(), breathing_mm=0.0), seed)
    assert 0.3 < error < 1.5


def test_with_every_error_it_does_so_on_average(mean_error_mm):
    # A small chest meets few breaths, and single sweeps lie farther off: `benchmarks/coarse_margins.py` counts them.
    assert np.mean([mean_error_mm(SweepErrors(), seed) for seed in range(6)]) < 1.5


def test_uncorrected_latency_shifts_by_speed_times_lag(record):
    errors = SweepErrors.only("latency")
    sweep = record(errors)
    assert sweep.latency_s == 0
    wrong, frames, _, _ = contour_points(sweep)
    right, also, _, _ = contour_points(dataclasses.replace(sweep, latency_s=LATENCY_S))
    assert (frames == also).all()
    shift = np.linalg.norm(wrong - right, axis=1)
    # The hand strays and tilts: its speed is 20 mm/s on the average over the lines, within a tenth.
    assert np.median(shift) == pytest.approx(Probe().speed_mm_s * LATENCY_S, rel=0.1)
    # Neighbouring lines run in opposite directions, so the shift tears them apart.
    along = (wrong - right)[np.abs(shift - 5.36) < 1, 2]
    assert (along > 4).mean() > 0.2
    assert (along < -4).mean() > 0.2


def test_uncorrected_latency_spoils_the_cloud(mean_error_mm):
    corrected = mean_error_mm(SweepErrors())
    left_in = dataclasses.replace(SweepErrors(), latency_uncorrected_s=LATENCY_S)
    assert mean_error_mm(left_in) > corrected + 0.5


def test_fat_makes_echoes_seem_deeper(record):
    clean, fat = (record(errors) for errors in (SweepErrors.none(), SweepErrors.only("speed of sound")))
    assert np.nanmin(depths_mm(clean)) > 5
    assert np.nanmean(depths_mm(fat) - depths_mm(clean)) == pytest.approx(10 * (1540 / 1440 - 1), abs=0.02)
    np.testing.assert_array_equal(clean.poses, fat.poses)


def test_contour_jitter_has_its_size(record):
    clean, jitter = (record(errors) for errors in (SweepErrors.none(), SweepErrors.only("contour jitter")))
    difference = depths_mm(jitter) - depths_mm(clean)
    # Rounding to pixels of 0.2 mm adds 0.08 mm in quadrature.
    assert np.nanstd(difference) == pytest.approx(np.hypot(SweepErrors().contour_mm, 0.08), rel=0.05)
    assert abs(np.nanmean(difference)) < 0.02


def test_tracking_noise_has_its_size(record):
    clean, noisy = (record(errors) for errors in (SweepErrors.none(), SweepErrors.only("tracking")))
    difference = noisy.poses - clean.poses
    assert difference[:, :3, 3].std() == pytest.approx(0.1, rel=0.05)
    assert not difference[:, :, :3].any()
    np.testing.assert_array_equal(noisy.masks, clean.masks)


def test_calibration_error_has_its_size(record):
    sweep = record(SweepErrors.only("calibration"))
    error = Probe().T_probe_image.inverse @ sweep.T_probe_image
    middle = np.array([[51 / 2, 35 / 2, 0.0]])
    assert np.linalg.norm(error.apply(middle) - middle) == pytest.approx(1.0)
    assert error.angle_deg == pytest.approx(0.3)


def test_latency_residual_has_its_size(record):
    found = {record(SweepErrors.only("latency residual"), seed).latency_s for seed in range(6)}
    assert found == {LATENCY_S - 0.005, LATENCY_S + 0.005}


def test_dropped_frames_and_missed_strips(chest, record, seen):
    clean = record(SweepErrors.none())
    dropped = record(SweepErrors.only("dropped frames"))
    assert dropped.n_frames / clean.n_frames == pytest.approx(0.95, abs=0.02)
    assert set(dropped.frame_times_s) < set(clean.frame_times_s)
    fixture = visible_surface(chest, FRONT, 2.0, np.random.default_rng(0)).points
    strips = sweep_cloud(record(SweepErrors.only("missed strips")))
    assert surface_distance_mm(strips.cloud.points, seen).mean() < 0.2
    missed = fixture[KDTree(strips.cloud.points).query(fixture)[0] > 2]
    assert 0.01 < len(missed) / len(fixture) < 0.15


def swept_plate(errors, **options):
    near = box((120, 4, 100))
    plate = Mesh(near.vertices, near.faces, np.zeros(len(near.vertices)))
    return simulate_sweep(plate, FRONT, errors, np.random.default_rng(0), **options)


@pytest.mark.parametrize("speed_mm_s", [20.0, 600.0])  # many breaths; less than one
def test_breathing_moves_the_chest_by_what_it_says(speed_mm_s):
    fast = Probe(speed_mm_s=speed_mm_s, frames_per_s=min(1.5 * speed_mm_s, 120.0))
    clean, breath = (swept_plate(errors, probe=fast) for errors in (SweepErrors.none(), SweepErrors.only("breathing")))
    taken_s = breath.frame_times_s - LATENCY_S
    assert (np.ptp(taken_s) < 2) == (speed_mm_s > 100)
    displacement = quiet_breathing(taken_s, SweepErrors().breathing_mm, np.random.default_rng(0).spawn(8)[3])
    difference = depths_mm(breath) - depths_mm(clean)
    seen = np.isfinite(difference).sum(axis=1) > 100  # not at the plate's ends
    assert seen.sum() > 40
    # Half-way between head and front; pixels of 0.2 mm and beams that are not quite upright blur it.
    shown = np.nanmedian(difference[seen], axis=1)
    np.testing.assert_allclose(shown, -displacement[seen] / np.sqrt(2), atol=0.35)
    assert np.ptp(shown) > 0.5


def test_without_breathing_nobody_breathes_and_nothing_else_changes(monkeypatch):
    still = dataclasses.replace(SweepErrors(), breathing_mm=0.0)
    off, on = swept_plate(still), swept_plate(SweepErrors())
    monkeypatch.setattr(virtual_sweep, "quiet_breathing", lambda times, size, rng: np.zeros(len(times)))
    without = swept_plate(SweepErrors())
    np.testing.assert_array_equal(off.masks, without.masks)
    assert (on.masks != off.masks).any()
    for other in (off, on):
        np.testing.assert_array_equal(other.frame_times_s, without.frame_times_s)
        np.testing.assert_array_equal(other.poses, without.poses)
        np.testing.assert_array_equal(other.T_probe_image.matrix, without.T_probe_image.matrix)
        assert other.latency_s == without.latency_s


@pytest.mark.parametrize("source", ERROR_SOURCES)
def test_each_source_alone_does_something_and_less_than_it_may(record, seen, source):
    clean, alone = (record(errors) for errors in (SweepErrors.none(), SweepErrors.only(source)))
    assert any(
        not np.array_equal(a, b)
        for a, b in (
            (clean.masks, alone.masks),
            (clean.poses, alone.poses),
            (clean.T_probe_image.matrix, alone.T_probe_image.matrix),
            (clean.latency_s, alone.latency_s),
        )
    )
    limit = 4.0 if source == "latency" else 1.2
    assert surface_distance_mm(sweep_cloud(alone).cloud.points, seen).mean() < limit


def test_same_seed_same_sweep_and_parts_do_not_leak(chest, record):
    blind = dataclasses.replace(chest, parts=np.zeros(len(chest.vertices), dtype=int))
    a, b = record(SweepErrors(), 3), simulate_sweep(blind, FRONT, SweepErrors(), np.random.default_rng(3))
    np.testing.assert_array_equal(a.masks, b.masks)
    np.testing.assert_array_equal(a.poses, b.poses)
    np.testing.assert_array_equal(a.frame_times_s, b.frame_times_s)


def test_the_base_frame_moves_the_cloud_and_nothing_else(chest, record):
    T_base_patient = RigidTransform.random(np.random.default_rng(8))
    at_home = record(SweepErrors(), 2)
    away = simulate_sweep(chest, FRONT, SweepErrors(), np.random.default_rng(2), T_base_patient=T_base_patient)
    np.testing.assert_array_equal(at_home.masks, away.masks)
    points, _, beam, _ = contour_points(at_home)
    moved, _, moved_beam, _ = contour_points(away)
    np.testing.assert_allclose(moved, T_base_patient.apply(points), atol=1e-6)
    np.testing.assert_allclose(moved_beam, T_base_patient.rotation @ beam, atol=1e-9)


def test_another_frame_of_the_patient_sees_the_same(chest):
    """Front and up are arguments: nothing relies on the axes being right, front and head."""
    turn = RigidTransform.random(np.random.default_rng(9))
    rng = np.random.default_rng(2)
    moved = simulate_sweep(
        chest.moved(turn), turn.rotation @ FRONT, SweepErrors.none(), rng, up=turn.rotation @ np.array([0.0, 0.0, 1.0])
    )
    points = turn.inverse.apply(sweep_cloud(moved).cloud.points)
    assert surface_distance_mm(points, chest).mean() < 0.2


def test_the_picture_is_the_probe_s(record):
    sweep = record(SweepErrors())
    assert sweep.masks.shape[1:] == (175, 255)
    assert np.median(np.diff(sweep.frame_times_s)) == pytest.approx(1 / 30, rel=0.02)
    assert np.ptp(np.diff(sweep.frame_times_s)) > 0.003  # uneven
    assert np.diff(sweep.pose_times_s) == pytest.approx(0.01)
    frames, columns = np.nonzero(sweep.masks.any(axis=1))
    thickness = sweep.masks.sum(axis=1)[frames, columns]
    assert np.median(thickness) == 5


def test_what_lies_behind_is_not_seen():
    """A small plate behind a large one leaves no trace in the cloud."""
    near, far = box((120, 4, 100)), box((40, 4, 40))
    far.apply_translation((0, -12, 0))
    both = Mesh(
        np.vstack([near.vertices, far.vertices]),
        np.vstack([near.faces, far.faces + len(near.vertices)]),
        np.repeat([0, 1], [len(near.vertices), len(far.vertices)]),
    )
    cloud = sweep_cloud(simulate_sweep(both, FRONT, SweepErrors.none(), np.random.default_rng(0))).cloud.points
    assert cloud[:, 1].min() > -2.5
    # Rounding to pixels must not push the surface up or down: a whole pixel would be 0.2 mm.
    middle = cloud[(np.abs(cloud[:, 0]) < 50) & (np.abs(cloud[:, 2]) < 40)]
    assert middle[:, 1].mean() == pytest.approx(2.0, abs=0.03)
    shown = visible_surface(both, FRONT, 3.0, np.random.default_rng(0))
    np.testing.assert_allclose(shown.points[:, 1], 2.0, atol=1e-3)
    assert set(visible_mesh(both, FRONT).parts) == {0}


@pytest.mark.parametrize(
    ("front", "up", "message"),
    [
        ((0, 0, 0), (0, 0, 1), "front as a direction"),
        ((0, np.nan, 0), (0, 0, 1), "front as a direction"),
        ((0, 1), (0, 0, 1), "front as a direction"),
        ((0, 1, 0), (0, 1, 0.1), "up and front at an angle"),
    ],
)
def test_wrong_directions_are_refused(chest, front, up, message):
    with pytest.raises(StudyError, match=message):
        simulate_sweep(chest, front, SweepErrors(), np.random.default_rng(0), up=up)


def test_a_mesh_inside_out_is_refused(chest):
    flipped = dataclasses.replace(chest, faces=chest.faces[:, ::-1])
    with pytest.raises(StudyError, match="inside out"):
        simulate_sweep(flipped, FRONT, SweepErrors(), np.random.default_rng(0))
