"""Every picture of the study: arrays, nouns and tables in, a figure out.

Nothing here runs a method or touches a disk; a notebook shows a figure that a cell returns, `png` gives its bytes.
"""

from study.figures.anatomy import anatomy_overview, ct_slice, mesh_and_cloud
from study.figures.clouds import cloud_errors, pose_gallery
from study.figures.registration import (
    CoarseView,
    coarse_overlay,
    coarse_steps,
    graph_triptych,
    one_way,
    registration_grid,
    skeleton_graph,
    som_progress,
    transferred_path,
)
from study.figures.statistics import (
    error_budget,
    error_views,
    hd_bars,
    paired_differences,
    sensitivity,
    waypoint_boxes,
)
from study.figures.style import (
    METHOD_STYLE,
    PART_COLOUR,
    SIMULATED,
    T_RAS_CHEST,
    MethodStyle,
    StudyFigure,
    in_order,
    method_style,
    png,
)
from study.figures.ultrasound import frame_with_mask, latency_fit, sweep_in_space

__all__ = [
    "METHOD_STYLE",
    "PART_COLOUR",
    "SIMULATED",
    "T_RAS_CHEST",
    "CoarseView",
    "MethodStyle",
    "StudyFigure",
    "anatomy_overview",
    "cloud_errors",
    "coarse_overlay",
    "coarse_steps",
    "ct_slice",
    "error_budget",
    "error_views",
    "frame_with_mask",
    "graph_triptych",
    "hd_bars",
    "in_order",
    "latency_fit",
    "mesh_and_cloud",
    "method_style",
    "one_way",
    "paired_differences",
    "png",
    "pose_gallery",
    "registration_grid",
    "sensitivity",
    "skeleton_graph",
    "som_progress",
    "sweep_in_space",
    "transferred_path",
    "waypoint_boxes",
]
