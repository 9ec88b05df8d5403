"""Clouds from CT (sec. II-C.1): volume, parts, surface, cloud; cartilage growth; the front of the wall; sizes."""

from study.ct.agreement import Agreement, compare_parts
from study.ct.growth import landmarks_from_ribs, parts_from_landmarks, parts_from_ribs
from study.ct.landmarks import Landmarks
from study.ct.parts import on_grid, parts_from_labels
from study.ct.sizes import measure_anatomy
from study.ct.surface import points_for_spacing, sample_cloud, surface
from study.ct.tissue import Growth
from study.ct.wall import WallImage, anterior_wall_image

__all__ = [
    "Agreement",
    "Growth",
    "Landmarks",
    "WallImage",
    "anterior_wall_image",
    "compare_parts",
    "landmarks_from_ribs",
    "measure_anatomy",
    "on_grid",
    "parts_from_labels",
    "parts_from_landmarks",
    "parts_from_ribs",
    "points_for_spacing",
    "sample_cloud",
    "surface",
]
