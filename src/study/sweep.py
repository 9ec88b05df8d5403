"""A virtual sweep: what a tracked linear probe would record over a known anatomy, error by error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import ArrayLike
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import distance_transform_edt, gaussian_filter, gaussian_filter1d, maximum_filter
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.geometry import nearest
from study.types import Bools, Floats, Ints, Mesh, PointCloud, RigidTransform, TrackedSweep

SPEED_ASSUMED_M_S = 1540.0
SPEED_FAT_M_S = 1440.0
BREATH_S = 4.0  # 15 breaths a minute at rest
JITTER_LENGTH_MM = 2.0  # a hand-drawn contour strays smoothly, not pixel by pixel


def _size(value: float, unit: str, source: str, reason: str) -> Any:
    """A field of `SweepErrors`: its size, its unit, the name of its source of error and where the size is from."""
    return field(default=value, metadata={"unit": unit, "source": source, "reason": reason})


@dataclass(frozen=True)
class SweepErrors:
    """Size of every error of a virtual sweep; 0 turns one off.

    The default is a careful acquisition: all sources on, the latency calibrated away up to its residual. Fields
    that belong to one source of error are switched together (`only`); `error_table` prints all with their reasons.
    """

    latency_uncorrected_s: float = _size(
        0.0, "s", "latency", "0 once calibrated; `only('latency')` leaves in the 268 ms of sec. II-B"
    )
    latency_residual_s: float = _size(
        0.005, "s", "latency residual", "bound met by calibrate_latency in its tests; either sign"
    )
    calibration_mm: float = _size(
        1.0,
        "mm",
        "calibration",
        "1.0-1.1 mm reported for robotic ultrasound; a shift in any direction",
    )
    calibration_deg: float = _size(
        0.3, "deg", "calibration", "bound met by calibrate_spatial in its tests; about any axis"
    )
    tracking_mm: float = _size(0.1, "mm", "tracking", "robot repeatability (vendor class, unverified); SD per axis")
    fat_mm: float = _size(
        10.0, "mm", "speed of sound", "fat at 1,440 m/s instead of 1,540: 10 mm shift an echo by 0.69 mm"
    )
    contour_mm: float = _size(
        0.4, "mm", "contour jitter", "two pixels of an annotator's hand (assumed, no published value found); SD"
    )
    dropped: float = _size(0.05, "fraction", "dropped frames", "a frame grabber under load (assumed)")
    missed_mm: float = _size(
        4.0, "mm", "missed strips", "mean gap a hand leaves between lines without seeing it (assumed)"
    )
    breathing_mm: float = _size(
        4.0, "mm", "breathing", "3-5 mm cranially and ventrally, 1-2 mm laterally in quiet breathing; peak to peak"
    )

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            limit = 1.0 if entry.name == "dropped" else np.inf
            if not 0 <= value < limit:
                raise StudyError(
                    f"{entry.name}: expected a size from 0 to below {limit:g} {entry.metadata['unit']}, got {value!r}"
                )

    @classmethod
    def none(cls) -> SweepErrors:
        """Every error off."""
        return cls(**{entry.name: 0.0 for entry in fields(cls)})

    @classmethod
    def only(cls, source: str) -> SweepErrors:
        """One source of error alone, at its default size; ``"latency"`` is the whole latency, not corrected.

        Raises:
            StudyError: a name that is not in ``ERROR_SOURCES``.
        """
        sizes = {entry.name: getattr(cls(), entry.name) for entry in fields(cls) if entry.metadata["source"] == source}
        if not sizes:
            raise StudyError(f"expected one of {', '.join(ERROR_SOURCES)}, got {source!r}")
        if source == "latency":
            sizes["latency_uncorrected_s"] = LATENCY_S
        return replace(cls.none(), **sizes)


LATENCY_S = 0.268  # sec. II-B
ERROR_SOURCES: tuple[str, ...] = tuple(dict.fromkeys(entry.metadata["source"] for entry in fields(SweepErrors)))


def error_budget() -> list[tuple[str, SweepErrors]]:
    """The cases of the error budget: none, each source alone, all together, all with the latency left in."""
    alone = [(source, SweepErrors.only(source)) for source in ERROR_SOURCES]
    every = SweepErrors()
    return [
        ("none", SweepErrors.none()),
        *alone,
        ("all", every),
        ("all, latency not corrected", replace(every, latency_uncorrected_s=LATENCY_S)),
    ]


def error_table() -> list[dict[str, str | float]]:
    """One row per field of `SweepErrors`: source, field, size, unit, and where the size comes from."""
    return [
        {
            "source": entry.metadata["source"],
            "field": entry.name,
            "size": getattr(SweepErrors(), entry.name),
            "unit": entry.metadata["unit"],
            "reason": entry.metadata["reason"],
        }
        for entry in fields(SweepErrors)
    ]


@dataclass(frozen=True)
class Probe:
    """A linear probe and the hand that moves it.

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
        """Rows and columns of an image."""
        return round(self.depth_mm / self.pixel_mm), round(self.aperture_mm / self.pixel_mm)

    @property
    def T_probe_image(self) -> RigidTransform:
        """Image frame to probe frame: x along the aperture, y into the body, the flange 120 mm behind the face."""
        columns = self.shape[1]
        rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        return RigidTransform(rotation, np.array([-(columns - 1) / 2 * self.pixel_mm, 0.0, 120.0]))


def _unit(vector: ArrayLike, name: str) -> Floats:
    array = np.asarray(vector, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all() or not np.linalg.norm(array) > 0:
        raise StudyError(f"expected {name} as a direction (3,), got {array}")
    return array / np.linalg.norm(array)


def _first_hits(mesh: Mesh, origins: Floats, directions: Floats) -> tuple[Floats, Ints]:
    """What rays (n, 3) meet first.

    Returns:
        distance (n,) in lengths of the direction, infinite for no hit or one from inside; face (n,), -1 likewise.
    """
    # Open3D casts in single precision: near the origin of coordinates that is 1e-5 mm, elsewhere it may not be.
    centre = mesh.vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor((mesh.vertices - centre).astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32))
    )
    rays = np.concatenate([origins - centre, directions], axis=1).astype(np.float32)
    answer = scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)
    distance = answer["t_hit"].numpy().astype(np.float64)
    face = answer["primitive_ids"].numpy().astype(np.int64)
    # A beam that meets a face from behind began inside the body part: it saw no surface.
    seen = np.isfinite(distance) & (np.einsum("ni,ni->n", answer["primitive_normals"].numpy(), directions) < 0)
    return np.where(seen, distance, np.inf), np.where(seen, face, -1)


def surface_distance_mm(points: Floats, mesh: Mesh) -> Floats:
    """Exact distance (n,) mm from points to the triangles of a surface."""
    centre = mesh.vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor((mesh.vertices - centre).astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32))
    )
    query = o3d.core.Tensor((np.asarray(points) - centre).astype(np.float32))
    return scene.compute_distance(query, nthreads=1).numpy().astype(np.float64)


def true_parts(points: Floats, mesh: Mesh) -> Ints:
    """The part (n,) of the nearest vertex of the true surface: for judging a cloud, never for making one."""
    return mesh.parts[nearest(points, mesh.vertices)[1]]


class _Skin:
    """A smooth skin over the anatomy as a height over the frontal plane, and the axes of that plane.

    Axes: ``left-right`` a, ``up`` b, ``front`` c; right-handed.
    """

    def __init__(self, mesh: Mesh, front: ArrayLike, up: ArrayLike, skin_mm: float, step_mm: float = 2.0) -> None:
        c = _unit(front, "front")
        b = _unit(up, "up")
        if abs(b @ c) > 0.9:
            raise StudyError(
                f"expected up and front at an angle, got {b} and {c}; give the direction of the head as up"
            )
        b = _unit(b - (b @ c) * c, "up")
        self.axes = np.stack([np.cross(b, c), b, c])
        local = mesh.vertices @ self.axes.T
        self.low, self.high = local.min(axis=0), local.max(axis=0)
        margin = 60.0
        a_grid, b_grid = (np.arange(self.low[i] - margin, self.high[i] + margin + step_mm, step_mm) for i in range(2))
        A, B = np.meshgrid(a_grid, b_grid, indexing="ij")
        above = self.high[2] + 10.0
        origins = np.column_stack([A.ravel(), B.ravel(), np.full(A.size, above)]) @ self.axes
        distance, _ = _first_hits(mesh, origins, np.broadcast_to(-c, origins.shape))
        height = (above - distance).reshape(A.shape)
        hit = np.isfinite(height)
        if not hit.any():
            raise StudyError(
                f"{mesh.name}: expected a surface to be seen from the front {c}, got none; is it inside out?"
            )
        rows, columns = distance_transform_edt(~hit, return_distances=False, return_indices=True)
        filled = height[rows, columns]
        smooth = gaussian_filter(filled, 15.0 / step_mm, mode="nearest")
        # Whatever stands out of the smooth surface lifts the skin around it, so that tissue covers every bone.
        proud = maximum_filter(np.maximum(filled - smooth, 0.0), size=round(24.0 / step_mm) + 1)
        skin = smooth + gaussian_filter(proud, 12.0 / step_mm, mode="nearest") + skin_mm
        tilt = gaussian_filter(skin, 10.0 / step_mm, mode="nearest")
        slopes = np.gradient(tilt, step_mm)
        self._height, self._slope_a, self._slope_b = (
            RegularGridInterpolator((a_grid, b_grid), values, bounds_error=False, fill_value=None)
            for values in (skin, *slopes)
        )

    def points(self, ab: Floats) -> tuple[Floats, Floats]:
        """Skin points (n, 3) mm and outward normals (n, 3) over plane positions (n, 2), in the mesh's frame."""
        local = np.column_stack([ab, self._height(ab)])
        normals = np.column_stack([-self._slope_a(ab), -self._slope_b(ab), np.ones(len(ab))])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        return local @ self.axes, normals @ self.axes


def visible_mesh(
    mesh: Mesh, front: ArrayLike, *, up: ArrayLike = (0.0, 0.0, 1.0), skin_mm: float | None = None, step_mm: float = 0.5
) -> Mesh:
    """The faces that a probe on the skin can see: those its beams, along the skin's normals, meet first.

    Args:
        mesh: the anatomy, mm.
        front: (3,) direction towards the skin, in the mesh's frame.
        up: (3,) direction towards the head.
        skin_mm: tissue in front of the bone; the default probe's when None.
        step_mm: distance between beams on the skin.

    Raises:
        StudyError: directions that are none, or a surface that is not seen at all.
    """
    skin = _Skin(mesh, front, up, Probe.skin_mm if skin_mm is None else skin_mm)
    a, b = (np.arange(skin.low[i] - 40, skin.high[i] + 40, step_mm) for i in range(2))
    ab = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
    points, normals = skin.points(ab)
    distance, face = _first_hits(mesh, points, -normals)
    return _submesh(mesh, face[distance <= Probe.depth_mm], "visible")


def _submesh(mesh: Mesh, faces: Ints, what: str) -> Mesh:
    kept = mesh.faces[np.unique(faces)]
    if not len(kept):
        raise StudyError(f"{mesh.name}: expected a surface that is {what}, got none; check the front direction")
    vertices, renumbered = np.unique(kept, return_inverse=True)
    return Mesh(mesh.vertices[vertices], renumbered.reshape(-1, 3), mesh.parts[vertices], name=f"{mesh.name} ({what})")


def visible_surface(mesh: Mesh, front: ArrayLike, spacing_mm: float, rng: np.random.Generator) -> PointCloud:
    """The points that parallel beams from the front meet first, evenly spread: a test fixture, free of error.

    Args:
        mesh: the anatomy, mm.
        front: (3,) direction towards the skin.
        spacing_mm: typical distance between neighbouring points.
        rng: draws the beams.

    Returns:
        A cloud in the mesh's frame, labelled with the true parts.

    Raises:
        StudyError: a direction that is none, or too few points in view.
    """
    if not spacing_mm > 0:
        raise StudyError(f"expected a spacing above 0 mm, got {spacing_mm!r}")
    beam = -_unit(front, "front")
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1) / 2
    # Points spread over the surface, not beams over the plane: beams would leave the sides of a tube bare.
    facing = np.flatnonzero(normals @ beam < 0)
    n = round(4 * float(area[facing].sum()) / spacing_mm**2)
    chosen = rng.choice(facing, size=max(n, 1), p=area[facing] / area[facing].sum())
    u = np.sort(rng.random((len(chosen), 2)), axis=1)
    weights = np.column_stack([u[:, 0], u[:, 1] - u[:, 0], 1 - u[:, 1]])
    candidates = np.einsum("nk,nki->ni", weights, corners[chosen])
    back_off = 2 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    distance, _ = _first_hits(mesh, candidates - back_off * beam, np.broadcast_to(beam, candidates.shape))
    candidates = candidates[np.abs(distance - back_off) < 1e-2]
    if not len(candidates):
        raise StudyError(f"{mesh.name}: expected a surface to be seen from the front, got none; check the direction")
    # One candidate a cube, the first drawn, keeps the density even.
    cells = np.floor((candidates - candidates.min(axis=0)) / spacing_mm).astype(np.int64)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    points = candidates[first]
    return PointCloud(points, f"{mesh.name} (visible)", true_parts(points, mesh))


def _drift(rng: np.random.Generator, size: float) -> Callable[[Floats], Floats]:
    """A smooth random function of time (s) with root mean square ``size``: how a hand strays."""
    n = 6
    hertz, phase = rng.uniform(0.05, 0.4, n), rng.uniform(0, 2 * np.pi, n)
    return lambda t: size * np.sqrt(2 / n) * np.sin(2 * np.pi * t[:, None] * hertz + phase).sum(axis=1)


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
    of one seed differ by that error only.

    Args:
        mesh: sternum and cartilages, mm; its parts are not used.
        front: (3,) direction towards the skin, in the mesh's frame.
        errors: what goes wrong, and by how much.
        up: (3,) direction towards the head.
        probe: the probe; a 12L3-like one when None.
        T_base_patient: the mesh's frame to the tracker's base frame; the same frame when None.
        name: of the sweep.
        rng: draws the hand and the errors.

    Returns:
        Masks, stamped frames and poses, with the calibration and latency that the experimenter believes in.

    Raises:
        StudyError: directions that are none, or an anatomy that the probe cannot see.
    """
    probe = probe or Probe()
    T_base_patient = T_base_patient or RigidTransform()
    hand, drops, strips, breath, calibration, latency, tracking, contour = rng.spawn(8)
    skin = _Skin(mesh, front, up, probe.skin_mm)

    centres = _line_centres(skin, probe, errors, strips)
    corner_times, corners = _path(skin, probe, centres)
    duration = corner_times[-1]
    stray_a, stray_b, roll, pitch, yaw = (_drift(hand, size) for size in (0.7, 0.7, 1.5, 1.5, 1.5))

    def poses_at(times: Floats) -> tuple[Floats, Floats]:
        """Rotations (n, 3, 3) and positions (n, 3) of the probe in the patient's frame."""
        t = np.clip(times, 0.0, duration)
        ab = np.column_stack([np.interp(t, corner_times, corners[:, i]) for i in range(2)])
        face, normals = skin.points(ab + np.column_stack([stray_a(t), stray_b(t)]))
        z = -normals
        x = np.cross(skin.axes[1], z)
        x /= np.linalg.norm(x, axis=1)[:, None]
        rotation = np.stack([x, np.cross(z, x), z], axis=2)
        wobble = Rotation.from_euler("xyz", np.column_stack([pitch(t), roll(t), yaw(t)]), degrees=True)
        rotation = rotation @ wobble.as_matrix()
        # The face, not the flange, follows the skin.
        return rotation, face - probe.T_probe_image.translation[2] * rotation[:, :, 2]

    # Frames are not quite evenly spaced: a frame grabber waits for the next picture.
    frame_times = np.arange(0.05, duration, 1 / probe.frames_per_s)
    frame_times = frame_times + hand.uniform(-0.004, 0.004, len(frame_times))
    frame_times = frame_times[drops.random(len(frame_times)) >= errors.dropped]

    rotation, position = poses_at(frame_times)
    depth = _cast_frames(mesh, skin, probe, rotation, position, _breathing(errors, breath, frame_times))
    # The machine turns time into depth at one speed; fat on the way is slower, so echoes seem deeper.
    depth += np.minimum(errors.fat_mm, depth) * (SPEED_ASSUMED_M_S / SPEED_FAT_M_S - 1)
    depth += _contour_jitter(errors, contour, depth.shape, probe.pixel_mm)
    masks = _render(depth, probe)
    if not masks.any():
        raise StudyError(
            f"{mesh.name}: expected bone within {probe.depth_mm:g} mm of the skin, got none; check the mesh"
        )

    # The robot records a little longer than the frames last, so that no latency pushes a frame out.
    pose_times = np.arange(-1.0, duration + 1.0, 1 / probe.poses_per_s)
    rotation, position = poses_at(pose_times)
    position = position + errors.tracking_mm * tracking.normal(size=position.shape)
    poses = np.tile(np.eye(4), (len(pose_times), 1, 1))
    poses[:, :3, :3] = T_base_patient.rotation @ rotation
    poses[:, :3, 3] = T_base_patient.apply(position)
    residual_s = errors.latency_residual_s * latency.choice([-1.0, 1.0])
    return TrackedSweep(
        frame_times_s=frame_times + LATENCY_S,
        poses=poses,
        pose_times_s=pose_times,
        pose_valid=np.ones(len(poses), dtype=bool),
        masks=masks,
        pixel_spacing_mm=(probe.pixel_mm, probe.pixel_mm),
        T_probe_image=probe.T_probe_image @ _calibration_error(errors, calibration, probe),
        latency_s=float(LATENCY_S - errors.latency_uncorrected_s + residual_s),
        name=name,
    )


def _line_centres(skin: _Skin, probe: Probe, errors: SweepErrors, rng: np.random.Generator) -> Floats:
    """Where the lines run, (k,) mm along the left-right axis."""
    a = np.arange(skin.low[0] - 60.0, skin.high[0] + 60.0)
    b = np.linspace(skin.low[1], skin.high[1], 7)
    points, normals = skin.points(np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2))
    across = np.cross(normals, skin.axes[1])
    across /= np.linalg.norm(across, axis=1)[:, None]
    # Around a chest the beams of neighbouring lines converge: what counts is how wide a line sees at the bone.
    bone = points - (probe.skin_mm + 4.0) * normals
    edges = [((bone + side * probe.aperture_mm / 2 * across) @ skin.axes[0]).reshape(len(a), -1) for side in (-1, 1)]
    low, high = np.sort([edge.mean(axis=1) for edge in edges], axis=0)
    # Each line begins where the last one ended, less the overlap, or plus the strip that was missed.
    strips = errors.missed_mm * rng.uniform(0.5, 1.5, 100) if errors.missed_mm else np.full(100, -probe.overlap_mm)
    margin = 5.0

    def lines_from(start: float) -> tuple[Floats, float]:
        centres = [float(np.interp(start, low, a))]
        for strip in strips:
            end = float(np.interp(centres[-1], a, high))
            if end >= skin.high[0] + margin or centres[-1] >= a[-1]:
                break
            centres.append(float(np.interp(end + strip, low, a)))
        return np.array(centres), end - skin.high[0] - margin

    _, spare = lines_from(skin.low[0] - margin)
    return lines_from(skin.low[0] - margin - spare / 2)[0]


def _path(skin: _Skin, probe: Probe, centres: Floats) -> tuple[Floats, Floats]:
    """Times (m,) s and plane positions (m, 2) mm of the corners of the path."""
    ends = np.array([skin.low[1] - 5.0, skin.high[1] + 5.0])
    corners = np.array([(centre, ends[(line + side) % 2]) for line, centre in enumerate(centres) for side in (0, 1)])
    # Speed along the body, not along its shadow on the frontal plane.
    steps = []
    for start, stop in pairwise(corners):
        points, _ = skin.points(start + np.linspace(0, 1, 20)[:, None] * (stop - start))
        steps.append(np.linalg.norm(np.diff(points, axis=0), axis=1).sum() / probe.speed_mm_s)
    return np.concatenate([[0.0], np.cumsum(steps)]), corners


def _breathing(errors: SweepErrors, rng: np.random.Generator, times: Floats) -> Floats:
    """Displacement (n,) mm of the chest along cranio-ventral, about its mean position."""
    phase = rng.uniform(0, 2 * np.pi)
    return errors.breathing_mm / 2 * np.sin(2 * np.pi * times / BREATH_S + phase)


def _cast_frames(
    mesh: Mesh, skin: _Skin, probe: Probe, rotation: Floats, position: Floats, breath_mm: Floats
) -> Floats:
    """Depth (f, w) mm of the first surface under each column, infinite where there is none."""
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
    depth, _ = _first_hits(mesh, local_o.reshape(-1, 3) @ axes, local_d.reshape(-1, 3) @ axes)
    return depth.reshape(len(position), -1)


def _contour_jitter(errors: SweepErrors, rng: np.random.Generator, shape: tuple[int, ...], pixel_mm: float) -> Floats:
    """Smooth error (f, w) mm of the annotated line, independent from frame to frame."""
    sigma = JITTER_LENGTH_MM / pixel_mm
    noise = gaussian_filter1d(rng.normal(size=shape).astype(np.float32), sigma, axis=1, mode="wrap")
    return errors.contour_mm * noise * np.sqrt(2 * np.sqrt(np.pi) * sigma)


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


def _calibration_error(errors: SweepErrors, rng: np.random.Generator, probe: Probe) -> RigidTransform:
    """What calibration gets wrong: a shift and a turn about the middle of the image, in the image frame."""
    shift, axis = (_unit(rng.normal(size=3), "draw") for _ in range(2))  # any direction
    turn = Rotation.from_rotvec(np.radians(errors.calibration_deg) * axis).as_matrix()
    middle = np.array([probe.aperture_mm / 2, probe.depth_mm / 2, 0.0])
    return RigidTransform(turn, middle - turn @ middle + errors.calibration_mm * shift)


def simulate_latency_run(
    latency_s: float,
    rng: np.random.Generator,
    *,
    amplitude_mm: float = 10.0,
    period_s: float = 2.0,
    duration_s: float = 20.0,
    noise_px: float = 1.0,
    probe: Probe | None = None,
) -> tuple[Floats, Floats, Floats, Floats]:
    """The recording that temporal calibration needs: the probe over a landmark, up and down (sec. II-B).

    Returns:
        depths (f,) pixels and stamps (f,) s of the images, unevenly spaced; heights (p,) mm and stamps (p,) s of
        the robot.
    """
    probe = probe or Probe()
    phase = rng.uniform(0, 2 * np.pi)

    def height(t: Floats) -> Floats:
        return amplitude_mm * np.sin(2 * np.pi * t / period_s + phase)

    robot_times = np.arange(0.0, duration_s, 1 / probe.poses_per_s)
    taken = np.arange(0.0, duration_s, 1 / probe.frames_per_s)
    taken = np.sort(taken + rng.uniform(-0.01, 0.01, len(taken)))
    depths = (20.0 + height(taken)) / probe.pixel_mm + noise_px * rng.normal(size=len(taken))
    return depths, taken + latency_s, height(robot_times), robot_times


def simulate_calibration_views(
    rng: np.random.Generator,
    *,
    n_views: int = 60,
    tilt_deg: float = 40.0,
    noise_px: float = 0.5,
    probe: Probe | None = None,
) -> tuple[Floats, Floats]:
    """The recording that spatial calibration needs: one fixed point all over the image, the probe tilted and turned.

    Returns:
        pixels (n, 2), column and row of the point in each view; poses (n, 4, 4) ``T_base_probe``, mm.
    """
    probe = probe or Probe()
    rows, columns = probe.shape
    pixels = rng.uniform([0.0, 0.1 * rows], [columns - 1.0, rows - 1.0], (n_views, 2))
    angles = rng.uniform(-tilt_deg, tilt_deg, (n_views, 3)) * [1.0, 1.0, 3.0] + [180.0, 0.0, 0.0]
    rotation = Rotation.from_euler("xyz", angles, degrees=True)
    seen = probe.T_probe_image.apply(np.column_stack([pixels * probe.pixel_mm, np.zeros(n_views)]))
    poses = np.tile(np.eye(4), (n_views, 1, 1))
    poses[:, :3, :3] = rotation.as_matrix()
    poses[:, :3, 3] = np.array([500.0, -200.0, 80.0]) - rotation.apply(seen)
    return pixels + noise_px * rng.normal(size=pixels.shape), poses
