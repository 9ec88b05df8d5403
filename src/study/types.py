"""The nouns every stage shares: clouds, parts, rigid transforms, graphs, waypoints, registrations.

Arrays are float64, millimetres, frame RAS+ (x to the patient's right, y to the front, z to the head) unless a
cloud comes from a tracker, whose base frame is any rigid motion of that. They are read-only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import shortest_path
from scipy.spatial.transform import Rotation

from study.errors import StudyError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

MIN_POINTS = 50
MIN_EXTENT_MM = 20.0
MAX_EXTENT_MM = 2000.0


class Part(IntEnum):
    """A labelled piece of the anterior chest wall; sides are the patient's."""

    UNKNOWN = -1
    STERNUM = 0
    RIGHT_2 = 1
    RIGHT_3 = 2
    RIGHT_4 = 3
    RIGHT_5 = 4
    LEFT_2 = 5
    LEFT_3 = 6
    LEFT_4 = 7
    LEFT_5 = 8

    @property
    def level(self) -> int:
        """Rib level 2-5 of a cartilage; 0 for the sternum and unknown points."""
        return 0 if self <= 0 else (self - 1) % 4 + 2

    @property
    def side(self) -> str:
        """``"right"``, ``"left"`` or ``""`` for the sternum and unknown points."""
        return "" if self <= 0 else ("right" if self <= 4 else "left")

    @classmethod
    def cartilage(cls, side: str, level: int) -> Part:
        """The cartilage of ``side`` (``"right"`` or ``"left"``) and ``level`` (2-5)."""
        if side not in ("right", "left") or level not in (2, 3, 4, 5):
            raise StudyError(f"expected side right|left and level 2-5, got {side!r} and {level!r}")
        return cls(level - 1 if side == "right" else level + 3)


CARTILAGES: tuple[Part, ...] = tuple(part for part in Part if part > 0)


def as_points(points: ArrayLike, name: str = "points", *, at_least: int = 1) -> Floats:
    """Check and copy ``points`` as a read-only (n, 3) float64 array.

    Raises:
        StudyError: wrong shape, fewer than ``at_least`` rows, or a value that is not finite.
    """
    try:
        array = np.array(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise StudyError(f"{name}: expected numbers of shape (n, 3), got {type(points).__name__}: {error}") from error
    if array.ndim != 2 or array.shape[1] != 3:
        raise StudyError(f"{name}: expected shape (n, 3), got {array.shape}; pass one x, y, z row per point")
    if len(array) < at_least:
        raise StudyError(f"{name}: expected at least {at_least} points, got {len(array)}; check the crop or the file")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        raise StudyError(
            f"{name}: expected finite numbers, got {bad.size} rows with NaN or infinity, the first {bad[0]}; drop them"
        )
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class PointCloud:
    """A cloud of surface points of sternum and cartilages.

    Attributes:
        points: (n, 3) mm.
        name: what the cloud is, for messages: ``"ct:lidc-0001"``.
        parts: (n,) int64 of `Part`, or None before labelling.
        front: (3,) unit vector towards the skin where the cloud knows it (a probe does), else None.

    Raises:
        StudyError: shape, NaN, fewer than 50 points, or an extent that cannot be a chest in millimetres.
    """

    points: Floats
    name: str = "cloud"
    parts: Ints | None = None
    front: Floats | None = None

    def __post_init__(self) -> None:
        points = as_points(self.points, self.name, at_least=MIN_POINTS)
        extent = float(np.linalg.norm(np.ptp(points, axis=0)))
        if not MIN_EXTENT_MM <= extent <= MAX_EXTENT_MM:
            hint = "; metres? multiply by 1000" if 0.02 <= extent < 2.0 else "; check the units"
            raise StudyError(
                f"{self.name}: expected a chest of {MIN_EXTENT_MM:g}-{MAX_EXTENT_MM:g} mm across, "
                f"got {extent:.3g} mm{hint}"
            )
        object.__setattr__(self, "points", points)
        if self.parts is not None:
            parts = np.array(self.parts, dtype=np.int64)
            if parts.shape != (len(points),):
                raise StudyError(f"{self.name}: expected one part per point {(len(points),)}, got {parts.shape}")
            parts.flags.writeable = False
            object.__setattr__(self, "parts", parts)

    def __len__(self) -> int:
        return len(self.points)

    def only(self, *parts: Part) -> Floats:
        """The points of some parts, (k, 3) mm."""
        if self.parts is None:
            raise StudyError(
                f"{self.name}: expected labelled parts, got none; label it with study.coarse.find_chest first"
            )
        return self.points[np.isin(self.parts, [int(part) for part in parts])]

    def moved(self, transform: RigidTransform) -> PointCloud:
        """The same cloud in another frame."""
        front = None if self.front is None else transform.rotation @ self.front
        return replace(self, points=transform.apply(self.points), front=front)


@dataclass(frozen=True)
class Mesh:
    """A triangle surface.

    Attributes:
        vertices: (v, 3) mm.
        faces: (f, 3) indices into ``vertices``, wound so that normals point outwards.
        parts: (v,) int64 of `Part`.
    """

    vertices: Floats
    faces: Ints
    parts: Ints
    name: str = "mesh"

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", as_points(self.vertices, self.name, at_least=4))
        for key in ("faces", "parts"):
            array = np.array(getattr(self, key), dtype=np.int64)
            array.flags.writeable = False
            object.__setattr__(self, key, array)
        if self.faces.ndim != 2 or self.faces.shape[1] != 3 or len(self.faces) == 0:
            raise StudyError(f"{self.name}: expected triangles of shape (f, 3), got {self.faces.shape}")
        if self.parts.shape != (len(self.vertices),):
            raise StudyError(f"{self.name}: expected one part per vertex, got {self.parts.shape}")

    def moved(self, transform: RigidTransform) -> Mesh:
        """The same surface in another frame."""
        return replace(self, vertices=transform.apply(self.vertices))


@dataclass(frozen=True)
class RigidTransform:
    """A proper rigid motion, ``T.apply(p) = R p + t``; ``T_a_b`` maps frame b to frame a.

    Attributes:
        rotation: (3, 3), determinant +1.
        translation: (3,) mm.
    """

    rotation: Floats = field(default_factory=lambda: np.eye(3))
    translation: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise StudyError(
                f"expected a (3, 3) rotation and (3,) translation, got {rotation.shape}, {translation.shape}"
            )
        proper = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0
        if not (proper and np.isfinite(translation).all()):
            raise StudyError("expected a proper rotation (det +1) and a finite translation, got something else")
        rotation.flags.writeable = False
        translation.flags.writeable = False
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> RigidTransform:
        """From a (4, 4) homogeneous matrix."""
        array = np.asarray(matrix, dtype=np.float64)
        if array.shape != (4, 4):
            raise StudyError(f"expected a (4, 4) matrix, got {array.shape}")
        return cls(array[:3, :3], array[:3, 3])

    @classmethod
    def random(cls, rng: np.random.Generator, shift_mm: float = 300.0) -> RigidTransform:
        """A uniform random rotation and a normal translation of ``shift_mm`` per axis."""
        return cls(Rotation.random(random_state=rng).as_matrix(), rng.normal(scale=shift_mm, size=3))

    @property
    def matrix(self) -> Floats:
        """(4, 4) homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix

    @property
    def inverse(self) -> RigidTransform:
        """The motion that undoes this one."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    @property
    def angle_deg(self) -> float:
        """Rotation angle, 0-180 degrees."""
        return float(np.degrees(Rotation.from_matrix(self.rotation).magnitude()))

    def apply(self, points: Floats) -> Floats:
        """Move (n, 3) points."""
        return np.asarray(points) @ self.rotation.T + self.translation

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        return RigidTransform(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)


@dataclass(frozen=True)
class ChestFrame:
    """Where the sternum lies in a cloud: the frame in which the template is drawn.

    Attributes:
        origin: (3,) mm, centre of the sternum.
        left, up, front: (3,) unit vectors, orthogonal; left is the patient's, so left × up = front.
        width_mm: sternum along ``left``.
        root_mm: height of each cartilage's root along ``up``, by part.
        reach_mm: how far each cartilage extends from the sternum's edge along ``left``, by part.
    """

    origin: Floats
    left: Floats
    up: Floats
    front: Floats
    width_mm: float
    root_mm: Mapping[Part, float]
    reach_mm: Mapping[Part, float]

    @property
    def T_cloud_chest(self) -> RigidTransform:
        """Chest coordinates (left, up, front) to the cloud's own frame."""
        return RigidTransform(np.column_stack([self.left, self.up, self.front]), self.origin)


@dataclass(frozen=True)
class Volume:
    """An image on a regular grid whose axes run closest to R, A and S.

    Attributes:
        values: (ni, nj, nk) read-only; Hounsfield units, label ids or `Part` values.
        spacing_mm: (3,) mm between voxel centres along i, j, k.
        T_ras_index: maps ``index * spacing_mm`` to RAS+ mm; its translation is the centre of voxel (0, 0, 0).
        name: what the image is, for messages: ``"ct:lidc-0001"``.

    Raises:
        StudyError: not three axes of at least two voxels, or a spacing that is not finite and positive.
    """

    values: NDArray[Any]
    spacing_mm: Floats
    T_ras_index: RigidTransform = field(default_factory=RigidTransform)
    name: str = "volume"

    def __post_init__(self) -> None:
        values = np.asarray(self.values).view()
        spacing = np.array(self.spacing_mm, dtype=np.float64)
        if values.ndim != 3 or min(values.shape) < 2:
            raise StudyError(f"{self.name}: expected a 3-D image, got an array of shape {values.shape}; give a series")
        if spacing.shape != (3,) or not np.isfinite(spacing).all() or (spacing <= 0).any():
            raise StudyError(f"{self.name}: expected three positive spacings in mm, got {spacing}; check the header")
        values.flags.writeable = False
        spacing.flags.writeable = False
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "spacing_mm", spacing)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along i, j, k."""
        ni, nj, nk = self.values.shape
        return ni, nj, nk

    @property
    def affine(self) -> Floats:
        """(4, 4) from voxel index to RAS+ mm."""
        return self.T_ras_index.matrix @ np.diag([*self.spacing_mm, 1.0])

    def to_mm(self, indices: ArrayLike) -> Floats:
        """RAS+ mm (n, 3) of voxel indices (n, 3), which may be fractional."""
        return self.T_ras_index.apply(np.asarray(indices, dtype=np.float64) * self.spacing_mm)

    def to_index(self, points: ArrayLike) -> Floats:
        """Fractional voxel indices (n, 3) of RAS+ points (n, 3) mm."""
        return self.T_ras_index.inverse.apply(np.asarray(points, dtype=np.float64)) / self.spacing_mm

    def with_values(self, values: NDArray[Any]) -> Volume:
        """Other values on the same grid."""
        if values.shape != self.values.shape:
            raise StudyError(f"{self.name}: expected values of shape {self.shape}, got {values.shape}")
        return replace(self, values=values)

    def crop(self, low: ArrayLike, high: ArrayLike) -> Volume:
        """The box of voxel indices ``low <= index < high``, clipped to the grid; a view, in the same frame."""
        start = np.clip(np.asarray(low, dtype=np.int64), 0, self.shape)
        stop = np.clip(np.asarray(high, dtype=np.int64), 0, self.shape)
        if (stop - start < 2).any():
            raise StudyError(f"{self.name}: expected a box of at least 2 voxels a side, got {start} to {stop}")
        box = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
        moved = RigidTransform(self.T_ras_index.rotation, self.to_mm(start[None])[0])
        return replace(self, values=self.values[box], T_ras_index=moved)


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


@dataclass(frozen=True)
class SkeletonGraph:
    """The numbered graph of sec. III-B.

    Attributes:
        nodes: (m, 3) mm.
        edges: (e, 2) directed edges ``from, to``; a bidirectional link is two rows.
        parts: (m,) int64 of `Part`.
    """

    nodes: Floats
    edges: Ints
    parts: Ints

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", as_points(self.nodes, "graph nodes"))

    def __len__(self) -> int:
        return len(self.nodes)

    def with_nodes(self, nodes: Floats) -> SkeletonGraph:
        """The same topology at other positions."""
        return replace(self, nodes=nodes)

    def hops(self, *, directed: bool) -> Ints:
        """(m, m) graph distance in edges from row to column node; unreachable pairs are ``len(self)``."""
        m = len(self)
        weights = csr_array((np.ones(len(self.edges)), (self.edges[:, 0], self.edges[:, 1])), shape=(m, m))
        lengths = shortest_path(weights, directed=directed, unweighted=True)
        return np.where(np.isinf(lengths), m, lengths).astype(np.int64)


@dataclass(frozen=True)
class Waypoints:
    """Waypoints of the scan path (sec. IV-B).

    Attributes:
        points: (k, 3) mm.
        labels: one per row, ``"R2-3.1"`` is the first (most medial) of the right side between levels 2 and 3.
    """

    points: Floats
    labels: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", as_points(self.points, "waypoints"))
        if len(self.labels) != len(self.points):
            raise StudyError(f"expected one label per waypoint ({len(self.points)}), got {len(self.labels)}")

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Registration:
    """What every method returns.

    Attributes:
        source: (n, 3) mm, the CT points as given.
        warped: (n, 3) mm, row i is ``source[i]`` in the target (US) frame.
        T_us_ct: the rigid part: the whole answer of a rigid method, the coarse alignment of a non-rigid one.
        converged: False when the iteration limit or the end of a schedule came before the method was at rest.
        n_iterations: iterations (epochs) run.
        stop_reason: why it stopped, in words.
        history: figures of progress, in order; what they are and how often depends on the method.
        seconds: wall time.
        method: name in ``METHODS`` from `register_pair`; the class's own name from `Method.register`.
        warnings: what a careful reader should know about this result.
    """

    source: Floats
    warped: Floats
    T_us_ct: RigidTransform
    converged: bool
    n_iterations: int
    stop_reason: str
    history: tuple[float, ...] = ()
    seconds: float = 0.0
    method: str = ""
    warnings: tuple[str, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=dict)

    def transfer(self, waypoints: ArrayLike, radius_mm: float = 20.0) -> Floats:
        """Waypoints (k, 3) mm from the CT frame into the US frame by local rigid fits (sec. III-D).

        Raises:
            StudyError: fewer than 3 cloud points within ``radius_mm`` of a waypoint.
        """
        from study.path import transfer_path  # the verb lives with its section; the noun offers it

        return transfer_path(self.source, self.warped, waypoints, radius_mm=radius_mm)


@runtime_checkable
class Method(Protocol):
    """A registration method: a frozen dataclass of its parameters plus one verb."""

    name: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, Any]]  # a frozen dataclass: asdict(method) is its provenance

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """Register labelled, coarsely aligned clouds: ``warped`` row i is source point i in the target frame."""
        ...
