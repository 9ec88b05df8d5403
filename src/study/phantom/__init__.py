"""People whose anatomy and deformation are known exactly, and deformations planted into real people."""

from study.phantom.clouds import anterior_cloud, reference_cloud
from study.phantom.deformation import Affine, Bumps, Deformation, Ramp, Roll
from study.phantom.planted import breathing, planted_deformation, residual_mm, rib_bending
from study.phantom.scan import CARTILAGE_ID, LEFT_RIB_ID, RIGHT_RIB_ID, STERNUM_ID, ct_volume
from study.phantom.subject import POPULATION, SUBJECTS, SyntheticSubject, draw_subject
from study.phantom.truth import measures, truth_map, waypoints

__all__ = [
    "CARTILAGE_ID",
    "LEFT_RIB_ID",
    "POPULATION",
    "RIGHT_RIB_ID",
    "STERNUM_ID",
    "SUBJECTS",
    "Affine",
    "Bumps",
    "Deformation",
    "Ramp",
    "Roll",
    "SyntheticSubject",
    "anterior_cloud",
    "breathing",
    "ct_volume",
    "draw_subject",
    "measures",
    "planted_deformation",
    "reference_cloud",
    "residual_mm",
    "rib_bending",
    "truth_map",
    "waypoints",
]
