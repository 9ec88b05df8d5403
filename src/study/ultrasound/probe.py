"""The probe of sec. II-A: what its images measure, how fast they come and how the hand moves it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from study.types import RigidTransform


@dataclass(frozen=True)
class Probe:
    """A linear probe and the hand that moves it; lengths mm, rates per second.

    Attributes:
        aperture_mm: width of the image; 51 mm is the class of a 12L3 (vendor data not verified).
        depth_mm: depth of the image (sec. II-A).
        pixel_mm: edge of a pixel.
        frames_per_s: frame rate (sec. II-A).
        poses_per_s: rate of the robot (sec. II-A).
        speed_mm_s: speed of the hand along a line.
        overlap_mm: how far neighbouring lines overlap when none is missed.
        skin_mm: tissue in front of the most prominent bone around.
        line_mm: thickness of the annotated line in a mask.
    """

    aperture_mm: float = 51.0
    depth_mm: float = 35.0
    pixel_mm: float = 0.2
    frames_per_s: float = 30.0
    poses_per_s: float = 100.0
    speed_mm_s: float = 20.0
    overlap_mm: float = 8.0
    skin_mm: float = 11.0
    line_mm: float = 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of an image."""
        return round(self.depth_mm / self.pixel_mm), round(self.aperture_mm / self.pixel_mm)

    @property
    def T_probe_image(self) -> RigidTransform:
        """Image frame (mm) to probe frame: x along the aperture, y into the body, the flange 120 mm behind the face."""
        columns = self.shape[1]
        rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        return RigidTransform(rotation, np.array([-(columns - 1) / 2 * self.pixel_mm, 0.0, 120.0]))
