"""The simulated recordings give back the truth they were made with."""

import numpy as np

from study.ultrasound.probe import Probe
from study.ultrasound.spatial import calibrate_spatial
from study.ultrasound.sweep_errors import LATENCY_S
from study.ultrasound.temporal import calibrate_latency
from study.ultrasound.virtual_calibration import simulate_calibration_views, simulate_latency_run


def test_the_simulated_calibration_run_gives_its_latency_back():
    found = calibrate_latency(*simulate_latency_run(LATENCY_S, np.random.default_rng(0)))
    assert abs(found.latency_s - LATENCY_S) < 0.005


def test_the_simulated_calibration_views_give_the_place_of_the_image_back():
    probe = Probe()
    found = calibrate_spatial(*simulate_calibration_views(np.random.default_rng(0), probe=probe))
    off = found.T_probe_image @ probe.T_probe_image.inverse
    assert np.linalg.norm(found.T_probe_image.translation - probe.T_probe_image.translation) < 0.3
    assert off.angle_deg < 0.3
    np.testing.assert_allclose(found.pixel_spacing_mm, probe.pixel_mm, rtol=0.005)
