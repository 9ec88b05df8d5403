"""Coarse alignment from any rigid pose (sec. III-A): sternum (Eq. 1), branches, the named chest and its frame."""

from study.alignment.branches import Branches
from study.alignment.chest import Alignment, Chest, ChestSearch, align, find_chest
from study.alignment.frame import ChestFrame, chest_frame
from study.alignment.roots import RootMeasures, measure_roots
from study.alignment.sternum import SternumFit, SternumParams, SternumScores, sternum_scores

__all__ = [
    "Alignment",
    "Branches",
    "Chest",
    "ChestFrame",
    "ChestSearch",
    "RootMeasures",
    "SternumFit",
    "SternumParams",
    "SternumScores",
    "align",
    "chest_frame",
    "find_chest",
    "measure_roots",
    "sternum_scores",
]
