"""Spatial calibration: where the image lies on the probe, from views of a point or of wires (sec. II-B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from study.errors import StudyError
from study.types import Floats, RigidTransform


@dataclass(frozen=True)
class SpatialCalibration:
    """Where the image lies on the probe.

    Attributes:
        T_probe_image: image frame (mm) to probe frame.
        pixel_spacing_mm: (sx, sy) mm.
        residual_mm: root mean square distance of the observations from the phantom.
        sd_mm: standard error of the translation of ``T_probe_image``, largest axis.
        sd_deg: standard error of its rotation, largest axis.
        point: (3,) mm, the point phantom in the base frame; NaN for wires.
    """

    T_probe_image: RigidTransform
    pixel_spacing_mm: tuple[float, float]
    residual_mm: float
    sd_mm: float
    sd_deg: float
    point: Floats


def calibrate_spatial(
    pixels: ArrayLike,
    poses: ArrayLike,
    *,
    wires: ArrayLike | None = None,
    pixel_spacing_mm: tuple[float, float] | None = None,
    max_sd_mm: float = 1.0,
    max_sd_deg: float = 1.0,
) -> SpatialCalibration:
    """Spatial calibration by least squares from views of a point or of wires (sec. II-B).

    A point phantom never moves: every view must map its pixel to the same, unknown, base point. A wire phantom
    has known wires: every view must map its pixel onto its wire. A closed-form linear solution starts a
    non-linear one in which the image axes are orthogonal.

    Args:
        pixels: (n, 2) column and row of the phantom in each view.
        poses: (n, 4, 4) ``T_base_probe`` of each view, mm.
        wires: (n, 2, 3) mm, two points, in the base frame, of the wire seen in each view; None for one fixed point.
        pixel_spacing_mm: (sx, sy) when known from the machine; None to estimate it too.
        max_sd_mm: refuse a calibration whose translation is known no better.
        max_sd_deg: refuse a calibration whose rotation is known no better.

    Returns:
        The calibration with its residual and standard errors.

    Raises:
        StudyError: shapes, too few views, or views too much alike to fix every parameter as well as asked.
    """
    views = _check_views(pixels, poses, wires)
    start = _solve_linear(views, pixel_spacing_mm)
    fit = least_squares(_misfit, start.vector, x_scale="jac", args=(views, start))
    sd_mm, sd_deg = _standard_errors(views, fit)
    if not (sd_mm <= max_sd_mm and sd_deg <= max_sd_deg):
        raise StudyError(
            f"expected a calibration known to {max_sd_mm:g} mm and {max_sd_deg:g} deg, got standard errors of"
            f" {sd_mm:.2f} mm and {sd_deg:.2f} deg; add views, tilt the probe more, check the pixels"
        )
    rotation, translation, spacing, point = start.moved(fit.x)
    return SpatialCalibration(
        T_probe_image=RigidTransform(rotation.as_matrix(), translation),
        pixel_spacing_mm=(float(spacing[0]), float(spacing[1])),
        residual_mm=float(np.sqrt(2 * fit.cost / len(views.uv))),
        sd_mm=sd_mm,
        sd_deg=sd_deg,
        point=np.full(3, np.nan) if views.on_wire is not None else point,
    )


@dataclass(frozen=True)
class _Views:
    """Views of a phantom.

    Attributes:
        uv: (n, 2) pixels, column and row.
        R: (n, 3, 3) rotation of the probe.
        t: (n, 3) mm, its position.
        across: (n, 3, 3) what of a misfit counts: all of it for a point, what is across a wire for a wire.
        on_wire: (n, 3) mm, a point of the wire seen; None for a point phantom, whose place is unknown.
    """

    uv: Floats
    R: Floats
    t: Floats
    across: Floats
    on_wire: Floats | None

    @property
    def too_alike(self) -> StudyError:
        """The refusal of views that leave a parameter free."""
        return StudyError(
            f"expected views that differ enough to fix the calibration, got {len(self.uv)} too much alike; tilt the"
            " probe about two axes, turn it, and show the phantom all over the image"
        )


def _check_views(pixels: ArrayLike, poses: ArrayLike, wires: ArrayLike | None) -> _Views:
    uv, T = np.asarray(pixels, dtype=np.float64), np.asarray(poses, dtype=np.float64)
    n = len(uv)
    if uv.shape != (n, 2) or T.shape != (n, 4, 4) or not (np.isfinite(uv).all() and np.isfinite(T).all()):
        raise StudyError(f"expected finite pixels (n, 2) and poses (n, 4, 4), got {uv.shape} and {T.shape}")
    if n < 10:
        raise StudyError(f"expected at least 10 views of the phantom, got {n}; record more, each tilted differently")
    R, t = T[:, :3, :3], T[:, :3, 3]
    if wires is None:
        return _Views(uv, R, t, np.broadcast_to(np.eye(3), (n, 3, 3)), None)
    ends = np.asarray(wires, dtype=np.float64)
    if ends.shape != (n, 2, 3) or not (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 1e-6).all():
        raise StudyError(f"expected two different points of a wire per view ({n}, 2, 3), got {ends.shape}")
    along = ends[:, 1] - ends[:, 0]
    along = along / np.linalg.norm(along, axis=1)[:, None]
    return _Views(uv, R, t, np.eye(3) - along[:, :, None] * along[:, None, :], ends[:, 0])


@dataclass(frozen=True)
class _Start:
    """Where the non-linear search starts, and what its unknowns mean.

    Attributes:
        rotation: image to probe.
        translation: (3,) mm.
        spacing: (2,) mm.
        free_spacing: whether the spacing is an unknown.
        point: (3,) mm, the point phantom; (0,) for wires.
    """

    rotation: Rotation
    translation: Floats
    spacing: Floats
    free_spacing: bool
    point: Floats

    @property
    def vector(self) -> Floats:
        """The unknowns: a turn, the translation, logarithms of the spacing's change where it is free, the point."""
        return np.concatenate([np.zeros(3), self.translation, np.zeros(2 * self.free_spacing), self.point])

    def moved(self, v: Floats) -> tuple[Rotation, Floats, Floats, Floats]:
        """Rotation, translation, spacing and point (no point for wires: anything) of the unknowns."""
        spacing = self.spacing * np.exp(v[6:8]) if self.free_spacing else self.spacing
        return self.rotation * Rotation.from_rotvec(v[:3]), v[3:6], spacing, v[-3:]


def _solve_linear(views: _Views, pixel_spacing_mm: tuple[float, float] | None) -> _Start:
    """R (u cx + v cy + t_image) + t - p = 0 in the unknowns cx, cy, t_image and, for a point, p."""
    n = len(views.uv)
    blocks = [views.R * views.uv[:, :1, None], views.R * views.uv[:, 1:, None], views.R]
    if views.on_wire is None:
        blocks.append(np.broadcast_to(-np.eye(3), (n, 3, 3)))
    rows = (views.across @ np.concatenate(blocks, axis=2)).reshape(3 * n, -1)
    on_wire = np.zeros((n, 3)) if views.on_wire is None else views.on_wire
    right = np.einsum("nij,nj->ni", views.across, on_wire - views.t).reshape(-1)
    scale = np.linalg.norm(rows, axis=0)
    solution, _, rank, singular = np.linalg.lstsq(rows / scale, right, rcond=None)
    if rank < rows.shape[1] or singular[-1] < 1e-4 * singular[0]:
        raise views.too_alike
    solution = solution / scale
    x, y = solution[0:3], solution[3:6]
    rotation = Rotation.align_vectors(
        [x / np.linalg.norm(x), y / np.linalg.norm(y)], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    )[0]
    spacing = np.array(pixel_spacing_mm or (np.linalg.norm(x), np.linalg.norm(y)), dtype=np.float64)
    return _Start(rotation, solution[6:9], spacing, pixel_spacing_mm is None, solution[9:12])


def _misfit(v: Floats, views: _Views, start: _Start) -> Floats:
    """Distances (3 n,) mm of the views' pixels from the phantom, along the base frame's axes."""
    rotation, translation, spacing, point = start.moved(v)
    image = np.column_stack([views.uv * spacing, np.zeros(len(views.uv))])
    base = np.einsum("nij,nj->ni", views.R, rotation.apply(image) + translation) + views.t
    off = base - (point if views.on_wire is None else views.on_wire)
    misfit: Floats = np.einsum("nij,nj->ni", views.across, off).reshape(-1)
    return misfit


def _standard_errors(views: _Views, fit: OptimizeResult) -> tuple[float, float]:
    """Standard errors of translation (mm) and rotation (degrees), largest axis, from the scatter about the fit."""
    n_equations = (3 if views.on_wire is None else 2) * len(views.uv)
    normal = fit.jac.T @ fit.jac
    if np.linalg.matrix_rank(normal, hermitian=True) < len(normal):
        raise views.too_alike
    variance = 2 * fit.cost / max(n_equations - len(fit.x), 1)
    sd = np.sqrt(np.diag(np.linalg.inv(normal)) * variance)
    return float(sd[3:6].max()), float(np.degrees(sd[:3]).max())
