"""Sizes of cartilages 2-5 and the sternum, and how dense cartilage is: what published tables lack."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy import ndimage
from scipy.spatial import KDTree

from study.errors import StudyError
from study.types import CARTILAGES, Floats, Part, Volume

CALCIFIED_HU = 187.5  # calcification starts near this
MIN_VOXELS = 100
SLICE_MM = 2.0  # along a cartilage, for cross-sections
FIT_DEGREE = 3  # of the middle line: an S at most; higher degrees follow the ends' corners
ELLIPSE = 4.0  # diameter of a uniform ellipse over its standard deviation
RECTANGLE = float(np.sqrt(12.0))  # side of a uniform rectangle over its standard deviation


def measure_anatomy(ct: Volume, mask: Volume, subject: str) -> pd.DataFrame:
    """Measure every part of one subject.

    Lengths follow the middle line from end to end. Width (in the chest wall) and thickness (through it) are those
    of the ellipse, for the sternum of the rectangle, with the cross-section's spread: the median over the middle
    80 % of the length. Curvature is the mean of the middle line's, the bend the angle between its ends' directions.
    The sternum's length is that of the region of interest, from the 2nd to the 5th cartilages. The wall's curvature is
    that of the front across: of the parabola through all cartilages, from side to side.

    Args:
        ct: Hounsfield units.
        mask: `Part` values, on any grid.
        subject: first column.

    Returns:
        rows ``subject, part, quantity, value, unit``; ``part`` is ``cartilages`` for all eight together.

    Raises:
        StudyError: a part missing from the mask, or no uncalcified cartilage in it.
    """
    points = {part: mask.to_mm(np.argwhere(mask.values == part)) for part in Part if part > Part.UNKNOWN}
    absent = [part.name.lower() for part, voxels in points.items() if len(voxels) < MIN_VOXELS]
    if absent:
        raise StudyError(f"{subject}: expected a mask of all nine parts, got hardly any voxels of {', '.join(absent)}")
    front = _front(np.vstack([points[part] for part in CARTILAGES]))
    rows: list[tuple[str, str, str, float, str]] = []
    voxel_mm3 = float(np.prod(mask.spacing_mm))
    for part, voxels in points.items():
        shape = _tube_sizes(voxels, front, RECTANGLE if part is Part.STERNUM else ELLIPSE)
        name = part.name.lower()
        rows += [(subject, name, quantity, value, unit) for quantity, (value, unit) in shape.items()]
        rows.append((subject, name, "volume", len(voxels) * voxel_mm3, "mm3"))
        if part is not Part.STERNUM:
            rows += [(subject, name, *row) for row in _densities(ct, mask, [part], subject)]
    rows += [(subject, "cartilages", *row) for row in _densities(ct, mask, list(CARTILAGES), subject)]
    cartilages = np.vstack([points[part] for part in CARTILAGES])
    curvature = _wall_curvature(cartilages, points[Part.STERNUM].mean(axis=0))
    rows.append((subject, "cartilages", "wall_curvature", curvature, "1/m"))
    return pd.DataFrame(rows, columns=["subject", "part", "quantity", "value", "unit"])


def _front(points: Floats) -> Floats:
    """Unit normal (3,) of the sheet the cartilages lie in, to the front."""
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    forward: Floats = normal * np.sign(normal[1])
    return forward


def _wall_curvature(points: Floats, middle: Floats) -> float:
    """Curvature (1/m) across the chest of points (n, 3) mm, RAS+, about the middle of the sternum (3,)."""
    x, y, z = (points - middle).T
    fit = np.linalg.lstsq(np.column_stack([np.ones_like(x), x, z, x * x]), y, rcond=None)[0]
    return float(-2000.0 * fit[3])


def _tube_sizes(points: Floats, front: Floats, diameter_per_sd: float) -> dict[str, tuple[float, str]]:
    """Length, width, thickness, curvature and bend of a tube of points (n, 3) mm."""
    centre = points.mean(axis=0)
    axis = np.linalg.svd(points - centre, full_matrices=False)[2][0]
    along = (points - centre) @ axis
    for _ in range(3):  # a line by position along the axis, then by position along that line
        low, high = np.percentile(along, [0.5, 99.5])
        t = (along - low) / (high - low) * 2 - 1
        inner = np.abs(t) < 0.9  # oblique ends would curl it
        fits = [np.polynomial.Chebyshev.fit(t[inner], points[inner, i], FIT_DEGREE, domain=[-1, 1]) for i in range(3)]
        line = np.stack([fit(np.linspace(-1, 1, 400)) for fit in fits], axis=1)
        steps = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
        tangent = np.gradient(line, steps, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        at = KDTree(line).query(points)[1]
        along = steps[at] + np.einsum("ij,ij->i", points - line[at], tangent[at])
    length = float(np.diff(np.percentile(along, [0.5, 99.5]))[0] / 0.99)  # a stray voxel is no end
    across = np.cross(tangent, front)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    outwards = np.cross(across, tangent)
    offset = points - line[at]
    widths, depths = np.einsum("ij,ij->i", offset, across[at]), np.einsum("ij,ij->i", offset, outwards[at])
    middle = (along > 0.1 * steps[-1]) & (along < 0.9 * steps[-1])
    slices = pd.DataFrame({"slice": along[middle] // SLICE_MM, "w": widths[middle], "d": depths[middle]})
    spread = slices.groupby("slice").std(ddof=0).median()
    curvature = np.linalg.norm(np.gradient(tangent, steps, axis=0), axis=1)[20:-20]  # a polynomial's ends are loose
    bend = np.degrees(np.arccos(np.clip(tangent[20] @ tangent[-21], -1.0, 1.0)))
    return {
        "length": (length, "mm"),
        "width": (float(diameter_per_sd * spread["w"]), "mm"),
        "thickness": (float(diameter_per_sd * spread["d"]), "mm"),
        "curvature": (float(curvature.mean() * 1000.0), "1/m"),
        "bend": (float(bend), "deg"),
    }


def _densities(ct: Volume, mask: Volume, parts: list[Part], subject: str) -> list[tuple[str, float, str]]:
    """Density of the inside of some cartilages: its outermost millimetre or voxel mixes with its surroundings."""
    inside = np.isin(mask.values, [int(part) for part in parts])
    depth = ndimage.distance_transform_edt(np.pad(inside, 1), sampling=mask.spacing_mm)[1:-1, 1:-1, 1:-1]
    index = ct.to_index(mask.to_mm(np.argwhere(depth > 2.0)))
    values = ndimage.map_coordinates(ct.values, index.T, order=1, mode="nearest", output=np.float64)
    soft = values[values <= CALCIFIED_HU]
    if len(soft) < MIN_VOXELS:
        names = ", ".join(part.name.lower() for part in parts)
        raise StudyError(
            f"{subject}: expected uncalcified cartilage in {names}, got {len(soft)} voxels; check the mask"
        )
    return [
        ("density_mean", float(soft.mean()), "HU"),
        ("density_sd", float(soft.std()), "HU"),
        ("calcified_share", float((values > CALCIFIED_HU).mean()), "1"),
    ]
