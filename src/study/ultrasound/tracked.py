"""A tracked sweep: frames, poses, their clocks, and the pose of each frame (sec. II-A, II-B)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.types import Bools, Floats, RigidTransform


@dataclass(frozen=True, eq=False)
class TrackedSweep:
    """Ultrasound frames and the poses of the probe that took them, each with its own time stamps (sec. II).

    An image point of column c and row r lies at ``(c * sx, r * sy, 0)`` mm in the image frame (pixel centres at
    whole numbers, row 0 at the transducer) and at ``T_base_probe @ T_probe_image`` of that in the base frame.

    Attributes:
        frame_times_s: (f,) s, time stamps of the frames, never falling.
        poses: (p, 4, 4) ``T_base_probe``, mm; rows that are not valid may hold anything.
        pose_times_s: (p,) s, rising.
        pose_valid: (p,) bool, False where the tracker lost the probe.
        masks: (f, h, w) bool, True on bone and cartilage; None before annotation.
        images: (f, h, w) grey B-mode; None where only the masks were kept.
        pixel_spacing_mm: (sx, sy) mm, lateral and along the beam; None before calibration.
        T_probe_image: image frame to probe frame; None before calibration.
        latency_s: how late frames are stamped: a frame stamped t shows the world at ``t - latency_s``.
        name: what it is, for messages: ``"us:p3"``.
        frame_names: names of the probe's and of the base frame, as PLUS calls them in its transforms.
        frame_fields: what a recording says of its frames beyond all this (other tools' transforms), as text, by the
            frame's stamp (s); kept for writing. Entries of other stamps are dropped.
        notes: how the recording was read where there was a choice, a sentence each.

    Raises:
        StudyError: shapes that do not belong together, times that fall, rotations that are none.
    """

    frame_times_s: Floats
    poses: Floats
    pose_times_s: Floats
    pose_valid: Bools
    masks: Bools | None = None
    images: NDArray[Any] | None = None
    pixel_spacing_mm: tuple[float, float] | None = None
    T_probe_image: RigidTransform | None = None
    latency_s: float = 0.0
    name: str = "sweep"
    frame_names: tuple[str, str] = ("Probe", "Tracker")
    frame_fields: Mapping[float, Mapping[str, str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        f, p = len(self.frame_times_s), len(self.poses)
        for key, shape in (("frame_times_s", (f,)), ("pose_times_s", (p,)), ("poses", (p, 4, 4))):
            array = np.array(getattr(self, key), dtype=np.float64)
            if array.shape != shape or shape[0] == 0:
                raise StudyError(f"{self.name}: expected {key} of shape {shape}, at least one, got {array.shape}")
            array.flags.writeable = False
            object.__setattr__(self, key, array)
        valid = np.array(self.pose_valid, dtype=bool)
        if valid.shape != (p,):
            raise StudyError(f"{self.name}: expected pose_valid of shape {(p,)}, one per pose, got {valid.shape}")
        valid.flags.writeable = False
        object.__setattr__(self, "pose_valid", valid)
        self._check_times()
        self._check_poses()
        stamps = set(self.frame_times_s.tolist())
        kept = {time: dict(fields) for time, fields in self.frame_fields.items() if time in stamps}
        object.__setattr__(self, "frame_fields", kept)
        if self.masks is None and self.images is None:
            raise StudyError(f"{self.name}: expected masks or B-mode images, got neither; pass at least one")
        for key in ("masks", "images"):
            stack = getattr(self, key)
            if stack is not None:
                # A view, not a copy: 2,000 frames are tens of megabytes and more.
                stack = np.asarray(stack, dtype=bool if key == "masks" else None).view()
                if stack.ndim != 3 or len(stack) != f or 0 in stack.shape:
                    raise StudyError(f"{self.name}: expected {key} of shape ({f}, rows, columns), got {stack.shape}")
                stack.flags.writeable = False
                object.__setattr__(self, key, stack)
        if self.masks is not None and self.images is not None and self.masks.shape != self.images.shape:
            raise StudyError(
                f"{self.name}: expected masks as large as the images {self.images.shape}, got {self.masks.shape}"
            )
        if self.pixel_spacing_mm is not None:
            sx, sy = (float(value) for value in self.pixel_spacing_mm)
            if not (0 < sx < 10 and 0 < sy < 10):
                raise StudyError(f"{self.name}: expected pixels of 0-10 mm, got {sx:g} x {sy:g}; check the units")
            object.__setattr__(self, "pixel_spacing_mm", (sx, sy))
        if not abs(self.latency_s) < 10:
            raise StudyError(f"{self.name}: expected a latency in seconds, got {self.latency_s!r}; milliseconds?")

    def _check_times(self) -> None:
        for key, falls in (("frame_times_s", np.less), ("pose_times_s", np.less_equal)):
            times = getattr(self, key)
            if not np.isfinite(times).all():
                row = int(np.flatnonzero(~np.isfinite(times))[0])
                raise StudyError(f"{self.name}: expected finite {key}, got {times[row]} in row {row}; drop that row")
            late = np.flatnonzero(falls(times[1:], times[:-1]))
            if late.size:
                row = int(late[0]) + 1
                raise StudyError(
                    f"{self.name}: expected rising {key}, got {times[row]:.6f} s after {times[row - 1]:.6f} s in row"
                    f" {row}; sort them or drop duplicates"
                )

    def _check_poses(self) -> None:
        rotations = self.poses[self.pose_valid, :3, :3]
        # Trackers write six digits: rotations are only that close to proper ones.
        proper = np.isfinite(self.poses[self.pose_valid]).all(axis=(1, 2))
        with np.errstate(invalid="ignore"):
            proper &= np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0) < 1e-3
            proper &= np.einsum("pi,pi->p", np.cross(rotations[:, 0], rotations[:, 1]), rotations[:, 2]) > 0
        if not proper.all():
            row = int(np.flatnonzero(self.pose_valid)[np.flatnonzero(~proper)[0]])
            raise StudyError(
                f"{self.name}: expected poses that are proper rotations and translations, got something else in row"
                f" {row}; mark it invalid or check the column order"
            )

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.frame_times_s)

    def frame_poses(self, max_gap_s: float = 0.25) -> tuple[Floats, Bools, Bools]:
        """The pose of the probe when each frame was really taken: latency out, slerp between neighbours.

        Args:
            max_gap_s: poses further apart than this do not say what happened between them.

        Returns:
            poses (f, 4, 4), NaN where there is none; inside (f,), False where the frame lies outside the tracked
            interval; tracked (f,), False where a neighbouring pose is not valid or the gap is too long.
        """
        times = self.pose_times_s
        query = self.frame_times_s - self.latency_s
        inside = (query >= times[0]) & (query <= times[-1])
        before = np.clip(np.searchsorted(times, query, side="right") - 1, 0, len(times) - 1)
        # A frame exactly on a pose needs no second one.
        after = np.where(times[before] == query, before, np.minimum(before + 1, len(times) - 1))
        gap = times[after] - times[before]
        tracked = inside & self.pose_valid[before] & self.pose_valid[after] & (gap <= max_gap_s)
        poses = np.full((len(query), 4, 4), np.nan)
        b, a = before[tracked], after[tracked]
        weight = np.divide(query[tracked] - times[b], gap[tracked], out=np.zeros(len(b)), where=gap[tracked] > 0)
        if weight.size:
            start = Rotation.from_matrix(self.poses[b, :3, :3])
            turn = (start.inv() * Rotation.from_matrix(self.poses[a, :3, :3])).as_rotvec()
            # Slerp: the turn from one pose to the next about its fixed axis, in proportion to time.
            poses[tracked, :3, :3] = (start * Rotation.from_rotvec(weight[:, None] * turn)).as_matrix()
            shift = self.poses[a, :3, 3] - self.poses[b, :3, 3]
            poses[tracked, :3, 3] = self.poses[b, :3, 3] + weight[:, None] * shift
            poses[tracked, 3] = (0.0, 0.0, 0.0, 1.0)
        return poses, inside, tracked
