"""Tracked ultrasound (sec. II): calibrations, masks to cloud; the virtual sweep and the sizes of its errors."""

from study.ultrasound.b_mode_of_ct import b_mode_like, ct_frame, frame_below, frame_of, skin_depth_mm
from study.ultrasound.bmode import BONE, CARTILAGE, Echo, simulate_bmode
from study.ultrasound.bone_surface import BoneFinder, BoneSurface, find_bone_surface, mask_sweep
from study.ultrasound.cloud import (
    SweepCloud,
    SweepReport,
    contour_points,
    frame_fates,
    sweep_cloud,
    thin_evenly,
    upper_contour,
)
from study.ultrasound.constant_shift import constant_shift_mm
from study.ultrasound.probe import Probe
from study.ultrasound.spatial import SpatialCalibration, calibrate_spatial
from study.ultrasound.sweep_errors import ERROR_SOURCES, LATENCY_S, SweepErrors, budget_cases, error_table
from study.ultrasound.temporal import LatencyCalibration, calibrate_latency
from study.ultrasound.tracked import TrackedSweep
from study.ultrasound.virtual_calibration import simulate_calibration_views, simulate_latency_run
from study.ultrasound.virtual_sweep import simulate_sweep
from study.ultrasound.visible import true_parts, visible_mesh, visible_surface

__all__ = [
    "BONE",
    "CARTILAGE",
    "ERROR_SOURCES",
    "LATENCY_S",
    "BoneFinder",
    "BoneSurface",
    "Echo",
    "LatencyCalibration",
    "Probe",
    "SpatialCalibration",
    "SweepCloud",
    "SweepErrors",
    "SweepReport",
    "TrackedSweep",
    "b_mode_like",
    "budget_cases",
    "calibrate_latency",
    "calibrate_spatial",
    "constant_shift_mm",
    "contour_points",
    "ct_frame",
    "error_table",
    "find_bone_surface",
    "frame_below",
    "frame_fates",
    "frame_of",
    "mask_sweep",
    "simulate_bmode",
    "simulate_calibration_views",
    "simulate_latency_run",
    "simulate_sweep",
    "skin_depth_mm",
    "sweep_cloud",
    "thin_evenly",
    "true_parts",
    "upper_contour",
    "visible_mesh",
    "visible_surface",
]
