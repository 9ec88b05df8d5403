"""A virtual sweep: what a tracked linear probe would record over a known anatomy, error by error (sec. II-C.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.geometry.points import unit
from study.geometry.rays import first_hits
from study.types import Bools, Floats, Mesh, RigidTransform
from study.ultrasound.breathing import quiet_breathing
from study.ultrasound.hand import Hand
from study.ultrasound.probe import Probe
from study.ultrasound.skin import Skin
from study.ultrasound.sweep_errors import LATENCY_S, SweepErrors
from study.ultrasound.tracked import TrackedSweep

SPEED_ASSUMED_M_S = 1540.0
SPEED_FAT_M_S = 1440.0
JITTER_LENGTH_MM = 2.0  # a hand-drawn contour strays smoothly, not pixel by pixel


def simulate_sweep(
    mesh: Mesh,
    front: ArrayLike,
    errors: SweepErrors,
    rng: np.random.Generator,
    *,
    up: ArrayLike = (0.0, 0.0, 1.0),
    probe: Probe | None = None,
    T_base_patient: RigidTransform | None = None,
    name: str = "us:virtual",
) -> TrackedSweep:
    """A multi-line hand-held sweep over an anatomy whose truth is known (sec. II-C.2).

    Lines run head to foot and back, side by side, over a smooth skin; the probe follows its normal. Every beam
    stops at what it meets first. Switching one error does not change the random draws of another, so two sweeps
    of one seed differ by that error only. Breathing moves the anatomy about where it is given, its mean position over
    many breaths: there the truth of a patient lies, whatever part of them a sweep meets.

    Args:
        mesh: sternum and cartilages, mm; its parts are not used.
        front: (3,) direction towards the skin, in the mesh's frame.
        errors: what goes wrong, and by how much.
        rng: draws the hand and the errors.
        up: (3,) direction towards the head.
        probe: the probe; a 12L3-like one when None.
        T_base_patient: the mesh's frame to the tracker's base frame; the same frame when None.
        name: of the sweep.

    Returns:
        Masks, stamped frames and poses, with the calibration and latency that the experimenter believes in.

    Raises:
        StudyError: directions that are none, or an anatomy that the probe cannot see.
    """
    probe = probe or Probe()
    steady, drops, strips, breath, calibration, latency, tracking, contour = rng.spawn(8)
    skin = Skin(mesh, front, up, probe.skin_mm)
    hand = Hand.over(skin, probe, _strips(errors, strips, probe), steady)

    frame_times = _frame_times(errors, steady, drops, hand)
    depth = _cast_frames(mesh, hand, frame_times, quiet_breathing(frame_times, errors.breathing_mm, breath))
    depth += _delay_in_fat(errors, depth)
    depth += _contour_jitter(errors, contour, depth.shape, probe.pixel_mm)
    masks = _render(depth, probe)
    if not masks.any():
        raise StudyError(
            f"{mesh.name}: expected bone within {probe.depth_mm:g} mm of the skin, got none; check the mesh"
        )
    pose_times, poses = _track(errors, tracking, hand, T_base_patient or RigidTransform())
    return TrackedSweep(
        frame_times_s=frame_times + LATENCY_S,
        poses=poses,
        pose_times_s=pose_times,
        pose_valid=np.ones(len(poses), dtype=bool),
        masks=masks,
        pixel_spacing_mm=(probe.pixel_mm, probe.pixel_mm),
        T_probe_image=probe.T_probe_image @ _calibration_error(errors, calibration, probe),
        latency_s=_believed_latency_s(errors, latency),
        name=name,
    )


def _strips(errors: SweepErrors, rng: np.random.Generator, probe: Probe) -> Floats:
    """Widths (k,) mm missed between neighbouring lines, negative where they overlap; more than any chest needs."""
    return errors.missed_mm * rng.uniform(0.5, 1.5, 100) if errors.missed_mm else np.full(100, -probe.overlap_mm)


def _frame_times(errors: SweepErrors, steady: np.random.Generator, drops: np.random.Generator, hand: Hand) -> Floats:
    """When the frames that were kept are taken, (f,) s."""
    # Frames are not quite evenly spaced: a frame grabber waits for the next picture.
    times = np.arange(0.05, hand.duration_s, 1 / hand.probe.frames_per_s)
    times = times + steady.uniform(-0.004, 0.004, len(times))
    return times[drops.random(len(times)) >= errors.dropped]


def _cast_frames(mesh: Mesh, hand: Hand, times: Floats, breath_mm: Floats) -> Floats:
    """Depth (f, w) mm of the first surface under each column, infinite where there is none.

    ``breath_mm`` (f,) is the chest's displacement along cranio-ventral from its mean position.
    """
    rotation, position = hand.poses_at(times)
    probe, skin = hand.probe, hand.skin
    lateral = (np.arange(probe.shape[1]) - (probe.shape[1] - 1) / 2) * probe.pixel_mm
    face = position + probe.T_probe_image.translation[2] * rotation[:, :, 2]
    origins = face[:, None, :] + lateral[:, None] * rotation[:, None, :, 0]
    directions = np.broadcast_to(rotation[:, None, :, 2], origins.shape)
    # Breathing moves x to x + s (cranial + ventral)/sqrt(2) and widens the chest by 1.5 mm a side for 4 mm of s.
    # Casting at the body at rest with the inverse motion applied to the rays leaves their parameter, depth, as it is.
    half_width = (skin.high[0] - skin.low[0]) / 2
    middle = (skin.high[0] + skin.low[0]) / 2
    axes = skin.axes
    local_o, local_d = origins @ axes.T, directions @ axes.T
    shift = breath_mm[:, None, None] * np.array([0.0, 1.0, 1.0]) / np.sqrt(2)
    widen = 1 + 1.5 / 4 * breath_mm[:, None] / half_width
    local_o = local_o - shift
    local_o[..., 0] = (local_o[..., 0] - middle) / widen + middle
    local_d = local_d.copy()
    local_d[..., 0] /= widen
    depth, _ = first_hits(mesh, local_o.reshape(-1, 3) @ axes, local_d.reshape(-1, 3) @ axes)
    return depth.reshape(len(position), -1)


def _delay_in_fat(errors: SweepErrors, depth: Floats) -> Floats:
    """How much deeper (f, w) mm echoes seem: the machine turns time into depth at one speed, fat is slower."""
    return np.minimum(errors.fat_mm, depth) * (SPEED_ASSUMED_M_S / SPEED_FAT_M_S - 1)


def fat_delay_mm(errors: SweepErrors, shown: Floats) -> Floats:
    """How much of the depths (n,) mm that the machine shows is delay in fat: `_delay_in_fat`, seen from behind it."""
    slow = SPEED_ASSUMED_M_S / SPEED_FAT_M_S
    return np.minimum(errors.fat_mm * (slow - 1), np.maximum(shown, 0.0) * (1 - 1 / slow))


def _contour_jitter(errors: SweepErrors, rng: np.random.Generator, shape: tuple[int, ...], pixel_mm: float) -> Floats:
    """Smooth error (f, w) mm of the annotated line, independent from frame to frame."""
    sigma = JITTER_LENGTH_MM / pixel_mm
    noise = gaussian_filter1d(rng.normal(size=shape).astype(np.float32), sigma, axis=1, mode="wrap")
    jitter: Floats = errors.contour_mm * noise * np.sqrt(2 * np.sqrt(np.pi) * sigma)
    return jitter


def _render(depth: Floats, probe: Probe) -> Bools:
    """Masks (f, h, w) with a line ``line_mm`` thick from the surface down."""
    rows, columns = probe.shape
    masks = np.zeros((len(depth), rows, columns), dtype=bool)
    frame, column = np.nonzero(depth < probe.depth_mm)
    top = np.ceil(depth[frame, column] / probe.pixel_mm).astype(np.int64)
    for below in range(round(probe.line_mm / probe.pixel_mm)):
        row = top + below
        inside = (row >= 0) & (row < rows)
        masks[frame[inside], row[inside], column[inside]] = True
    return masks


def _track(
    errors: SweepErrors, rng: np.random.Generator, hand: Hand, T_base_patient: RigidTransform
) -> tuple[Floats, Floats]:
    """Times (p,) s and poses (p, 4, 4) ``T_base_probe`` that the robot records."""
    # The robot records a little longer than the frames last, so that no latency pushes a frame out.
    times = np.arange(-1.0, hand.duration_s + 1.0, 1 / hand.probe.poses_per_s)
    rotation, position = hand.poses_at(times)
    position = position + errors.tracking_mm * rng.normal(size=position.shape)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = T_base_patient.rotation @ rotation
    poses[:, :3, 3] = T_base_patient.apply(position)
    return times, poses


def _calibration_error(errors: SweepErrors, rng: np.random.Generator, probe: Probe) -> RigidTransform:
    """What calibration gets wrong: a shift and a turn about the middle of the image, in the image frame."""
    shift, axis = (unit(rng.normal(size=3), "draw") for _ in range(2))  # any direction
    turn = Rotation.from_rotvec(np.radians(errors.calibration_deg) * axis).as_matrix()
    middle = np.array([probe.aperture_mm / 2, probe.depth_mm / 2, 0.0])
    return RigidTransform(turn, middle - turn @ middle + errors.calibration_mm * shift)


def _believed_latency_s(errors: SweepErrors, rng: np.random.Generator) -> float:
    """The latency (s) that the experimenter takes out: the true one but for what is left in and its residual."""
    residual_s = errors.latency_residual_s * rng.choice([-1.0, 1.0])
    return float(LATENCY_S - errors.latency_uncorrected_s + residual_s)
