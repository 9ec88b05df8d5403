"""The skeleton graph (sec. III-B, C): template, self-organising map (Eq. 2), local transforms and blend (Eqs. 3, 4).

And what mends it: a map of all points at a time, and a spline through the nodes.
"""

from study.skeleton.batch_som import BatchSomParams, fit_batch_som
from study.skeleton.graph import SkeletonGraph
from study.skeleton.som import MAX_FALL, SomParams, fit_som, late_fall, neighbourhood, quantisation_error_mm
from study.skeleton.spline import NodeSpline
from study.skeleton.template import N_NODES, template_graph
from study.skeleton.warp import blend, local_transforms

__all__ = [
    "MAX_FALL",
    "N_NODES",
    "BatchSomParams",
    "NodeSpline",
    "SkeletonGraph",
    "SomParams",
    "blend",
    "fit_batch_som",
    "fit_som",
    "late_fall",
    "local_transforms",
    "neighbourhood",
    "quantisation_error_mm",
    "template_graph",
]
