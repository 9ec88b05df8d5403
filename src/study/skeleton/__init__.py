"""The skeleton graph (sec. III-B, C): template, self-organising map (Eq. 2), local transforms and blend (Eqs. 3, 4)."""

from study.skeleton.graph import SkeletonGraph
from study.skeleton.som import MAX_FALL, SomParams, fit_som, late_fall, neighbourhood, quantisation_error_mm
from study.skeleton.template import N_NODES, template_graph
from study.skeleton.warp import blend, local_transforms

__all__ = [
    "MAX_FALL",
    "N_NODES",
    "SkeletonGraph",
    "SomParams",
    "blend",
    "fit_som",
    "late_fall",
    "local_transforms",
    "neighbourhood",
    "quantisation_error_mm",
    "template_graph",
]
