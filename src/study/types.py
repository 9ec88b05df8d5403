"""The nouns every stage shares: parts, clouds, surfaces, rigid transforms, images, waypoints.

Arrays are float64, millimetres, frame RAS+ (x to the patient's right, y to the front, z to the head) unless a
cloud comes from a tracker, whose base frame is any rigid motion of that. They are read-only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from study import preview
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
            raise StudyError(f"expected side right|left and level 2-5, got {side!r} and {level!r}; use one of those")
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


def as_times(times: ArrayLike, n_points: int, name: str = "times") -> Floats:
    """Check and copy the time stamps of ``n_points`` points as a read-only (n_points,) float64 array, s.

    Raises:
        StudyError: no numbers, another shape, or a value that is not finite.
    """
    try:
        array = np.array(times, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise StudyError(f"{name}: expected a time in seconds per point, got no numbers: {error}") from error
    if array.shape != (n_points,):
        raise StudyError(
            f"{name}: expected one time per point {(n_points,)}, got {array.shape}; drop those of dropped points too"
        )
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise StudyError(
            f"{name}: expected finite times in seconds, got {bad.size} with NaN or infinity, the first {bad[0]}; "
            "drop those points, or all times"
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
        times: (n,) s, when each point was seen, on any one clock (a sweep has one); else None.

    Raises:
        StudyError: shape, NaN, fewer than 50 points, or an extent that cannot be a chest in millimetres.
    """

    points: Floats
    name: str = "cloud"
    parts: Ints | None = None
    front: Floats | None = None
    times: Floats | None = None

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
                raise StudyError(
                    f"{self.name}: expected one part per point {(len(points),)}, got {parts.shape}; "
                    "drop the labels of dropped points too"
                )
            parts.flags.writeable = False
            object.__setattr__(self, "parts", parts)
        if self.times is not None:
            object.__setattr__(self, "times", as_times(self.times, len(points), self.name))

    def __len__(self) -> int:
        return len(self.points)

    def only(self, *parts: Part) -> Floats:
        """The points of some parts, (k, 3) mm."""
        if self.parts is None:
            raise StudyError(
                f"{self.name}: expected labelled parts, got none; label it with study.alignment.find_chest first"
            )
        return self.points[np.isin(self.parts, [int(part) for part in parts])]

    def subset(self, rows: Ints | Bools) -> PointCloud:
        """The same cloud with only some of its points, by their rows (k,) or a mask (n,); parts and times follow."""
        return replace(
            self,
            points=self.points[rows],
            parts=None if self.parts is None else self.parts[rows],
            times=None if self.times is None else self.times[rows],
        )

    def moved(self, transform: RigidTransform) -> PointCloud:
        """The same cloud in another frame."""
        front = None if self.front is None else transform.rotation @ self.front
        return replace(self, points=transform.apply(self.points), front=front)

    def _repr_html_(self) -> str:
        """A few lines and a picture, coloured by part."""
        there = [] if self.parts is None else [part.name.lower() for part in Part if (self.parts == part).any()]
        lines = {
            "points": f"{len(self):,}",
            "parts": ", ".join(there) or "not labelled",
            "extent": " × ".join(f"{side:.0f}" for side in np.ptp(self.points, axis=0)) + " mm",
        }
        return preview.card(self.name, lines, preview.by_part(self.points, self.parts))


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
            raise StudyError(
                f"{self.name}: expected triangles of shape (f, 3), got {self.faces.shape}; split its polygons"
            )
        if self.parts.shape != (len(self.vertices),):
            raise StudyError(f"{self.name}: expected one part per vertex, got {self.parts.shape}; label each vertex")

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
                f"expected a (3, 3) rotation and (3,) translation, got {rotation.shape}, {translation.shape}; "
                "RigidTransform.from_matrix takes a (4, 4)"
            )
        proper = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0
        if not (proper and np.isfinite(translation).all()):
            raise StudyError(
                "expected a proper rotation (det +1) and a finite translation, "
                f"got {rotation.round(3).tolist()} and {translation.tolist()}; is there a scale or a reflection in it?"
            )
        rotation.flags.writeable = False
        translation.flags.writeable = False
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> RigidTransform:
        """From a (4, 4) homogeneous matrix."""
        array = np.asarray(matrix, dtype=np.float64)
        if array.shape != (4, 4):
            raise StudyError(f"expected a (4, 4) matrix, got {array.shape}; use RigidTransform(rotation, translation)")
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
            raise StudyError(f"{self.name}: expected values of shape {self.shape}, got {values.shape}; resample them")
        return replace(self, values=values)

    def crop(self, low: ArrayLike, high: ArrayLike) -> Volume:
        """The box of voxel indices ``low <= index < high``, clipped to the grid; a view, in the same frame."""
        start = np.clip(np.asarray(low, dtype=np.int64), 0, self.shape)
        stop = np.clip(np.asarray(high, dtype=np.int64), 0, self.shape)
        if (stop - start < 2).any():
            raise StudyError(
                f"{self.name}: expected a box of at least 2 voxels a side, got {start} to {stop}; widen the crop"
            )
        box = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
        moved = RigidTransform(self.T_ras_index.rotation, self.to_mm(start[None])[0])
        return replace(self, values=self.values[box], T_ras_index=moved)


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
            raise StudyError(
                f"expected one label per waypoint ({len(self.points)}), got {len(self.labels)}; name each row"
            )

    def __len__(self) -> int:
        return len(self.points)
