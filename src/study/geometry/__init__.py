"""Geometry that several sections need: rigid fits, neighbours, pixels, cells; rays against a surface."""

from study.geometry.points import (
    close_gaps,
    farthest_points,
    fit_rigid,
    fit_rigid_batch,
    foremost_in_cells,
    largest_component,
    nearest,
    pixelise,
    principal_axes,
    sample_spacing_mm,
    unit,
)
from study.geometry.rays import first_hits, surface_distance_mm

__all__ = [
    "close_gaps",
    "farthest_points",
    "first_hits",
    "fit_rigid",
    "fit_rigid_batch",
    "foremost_in_cells",
    "largest_component",
    "nearest",
    "pixelise",
    "principal_axes",
    "sample_spacing_mm",
    "surface_distance_mm",
    "unit",
]
