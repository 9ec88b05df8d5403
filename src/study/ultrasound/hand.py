"""The hand that moves a virtual probe over the skin: its lines, its way along them, and how it strays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from study.types import Floats
from study.ultrasound.probe import Probe
from study.ultrasound.skin import Skin

STRAY_MM = 0.7  # root mean square, off the line and along it
WOBBLE_DEG = 1.5  # root mean square, about each axis of the probe
PAST_MM = 5.0  # how far lines run, and cover, past the anatomy

Drift = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Hand:
    """A probe's way over the skin in lines from head to foot and back (sec. II-C.2), in the patient's frame.

    Attributes:
        skin: what the probe's face follows.
        probe: the probe.
        corner_times_s: (m,) s, rising from 0, when it is at each corner.
        corners: (m, 2) mm, corners of the way in the frontal plane.
        stray: two functions of time (s), mm off the way across and along the body.
        wobble: three functions of time (s), degrees about the probe's x, y and z.
    """

    skin: Skin
    probe: Probe
    corner_times_s: Floats
    corners: Floats
    stray: tuple[Drift, Drift]
    wobble: tuple[Drift, Drift, Drift]

    @classmethod
    def over(cls, skin: Skin, probe: Probe, strips: Floats, rng: np.random.Generator) -> Hand:
        """The way over a skin.

        Args:
            skin: the skin.
            probe: the probe.
            strips: (k,) mm left out between neighbouring lines, more than there are lines; negative for an overlap.
            rng: draws how the hand strays.
        """
        corner_times_s, corners = _way(skin, probe, _line_centres(skin, probe, strips))
        stray_a, stray_b, roll, pitch, yaw = (
            _drift(rng, size) for size in (STRAY_MM, STRAY_MM, WOBBLE_DEG, WOBBLE_DEG, WOBBLE_DEG)
        )
        return cls(skin, probe, corner_times_s, corners, (stray_a, stray_b), (pitch, roll, yaw))

    @property
    def duration_s(self) -> float:
        """Time from the first corner to the last."""
        return float(self.corner_times_s[-1])

    def poses_at(self, times_s: Floats) -> tuple[Floats, Floats]:
        """Rotations (n, 3, 3) and positions (n, 3) mm of the probe at times (n,) s: at rest before and after."""
        t = np.clip(times_s, 0.0, self.duration_s)
        ab = np.column_stack([np.interp(t, self.corner_times_s, self.corners[:, i]) for i in range(2)])
        face, normals = self.skin.points(ab + np.column_stack([stray(t) for stray in self.stray]))
        z = -normals
        x = np.cross(self.skin.axes[1], z)
        x /= np.linalg.norm(x, axis=1)[:, None]
        rotation = np.stack([x, np.cross(z, x), z], axis=2)
        wobble = Rotation.from_euler("xyz", np.column_stack([turn(t) for turn in self.wobble]), degrees=True)
        rotation = rotation @ wobble.as_matrix()
        # The face, not the flange, follows the skin.
        return rotation, face - self.probe.T_probe_image.translation[2] * rotation[:, :, 2]


def _drift(rng: np.random.Generator, size: float) -> Drift:
    """A smooth random function of time (s) with root mean square ``size``: how a hand strays."""
    n = 6
    hertz, phase = rng.uniform(0.05, 0.4, n), rng.uniform(0, 2 * np.pi, n)
    return lambda t: size * np.sqrt(2 / n) * np.sin(2 * np.pi * t[:, None] * hertz + phase).sum(axis=1)


def _line_centres(skin: Skin, probe: Probe, strips: Floats) -> Floats:
    """Where the lines run, (k,) mm along the left-right axis."""
    a, low, high = _seen_strip(skin, probe)

    # Each line begins where the last one ended, less the overlap, or plus the strip that was missed.
    def lines_from(start: float) -> tuple[Floats, float]:
        centres = [float(np.interp(start, low, a))]
        for strip in strips:
            end = float(np.interp(centres[-1], a, high))
            if end >= skin.high[0] + PAST_MM or centres[-1] >= a[-1]:
                break
            centres.append(float(np.interp(end + strip, low, a)))
        return np.array(centres), end - skin.high[0] - PAST_MM

    _, spare = lines_from(skin.low[0] - PAST_MM)
    return lines_from(skin.low[0] - PAST_MM - spare / 2)[0]


def _seen_strip(skin: Skin, probe: Probe) -> tuple[Floats, Floats, Floats]:
    """Centres (n,) mm along the left-right axis, and from where (n,) to where (n,) mm a line there sees bone."""
    a = np.arange(skin.low[0] - 60.0, skin.high[0] + 60.0)
    b = np.linspace(skin.low[1], skin.high[1], 7)
    points, normals = skin.points(np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2))
    across = np.cross(normals, skin.axes[1])
    across /= np.linalg.norm(across, axis=1)[:, None]
    # Around a chest the beams of neighbouring lines converge: what counts is how wide a line sees at the bone.
    bone = points - (probe.skin_mm + 4.0) * normals
    edges = [((bone + side * probe.aperture_mm / 2 * across) @ skin.axes[0]).reshape(len(a), -1) for side in (-1, 1)]
    low, high = np.sort([edge.mean(axis=1) for edge in edges], axis=0)
    return a, low, high


def _way(skin: Skin, probe: Probe, centres: Floats) -> tuple[Floats, Floats]:
    """Times (m,) s and plane positions (m, 2) mm of the corners of the way."""
    ends = np.array([skin.low[1] - PAST_MM, skin.high[1] + PAST_MM])
    corners = np.array([(centre, ends[(line + side) % 2]) for line, centre in enumerate(centres) for side in (0, 1)])
    # Speed along the body, not along its shadow on the frontal plane.
    steps = []
    for start, stop in pairwise(corners):
        points, _ = skin.points(start + np.linspace(0, 1, 20)[:, None] * (stop - start))
        steps.append(np.linalg.norm(np.diff(points, axis=0), axis=1).sum() / probe.speed_mm_s)
    return np.concatenate([[0.0], np.cumsum(steps)]), corners
