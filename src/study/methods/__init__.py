"""Registration methods behind one verb (sec. IV).

``METHODS`` holds them by name. A method has two sets of parameters, as published (or as its library ships them) and
tuned, and two surfaces of the CT to register, all of it and the half that a probe can see. A plain name is published
and whole, the paper's comparison; ``_tuned`` is tuned and visible; the names of the other two say it all:

    >>> [name for name in METHODS if name.startswith("icp")]
    ['icp', 'icp_tuned', 'icp_visible', 'icp_tuned_whole']

The coarse alignment has neither, and the skeleton graph two rows more: every choice of its authors' code, and the same
idea with its weak steps mended. This study's own method, ``BEST_METHOD``, was never published: it has one row, on the
visible surface.

    >>> [name for name in METHODS if name.startswith(("coarse", "skeleton"))]
    ['coarse', 'skeleton_graph', 'skeleton_graph_tuned', 'skeleton_graph_authors', 'skeleton_graph_visible', \
'skeleton_graph_tuned_whole', 'skeleton_graph_repaired']

A method is a frozen dataclass of its parameters, and another setting is another value:

    >>> from dataclasses import asdict, replace
    >>> asdict(METHODS["icp"])["max_distance_mm"]
    1000.0
    >>> near = replace(METHODS["icp"], max_distance_mm=5.0)
    >>> near.max_distance_mm
    5.0
"""

from collections.abc import Mapping
from types import MappingProxyType

from study.methods.bcpd import Bcpd
from study.methods.coarse_only import CoarseOnly
from study.methods.cpd import Cpd
from study.methods.gaussian_process import GaussianProcess, GaussianProcessRegistration
from study.methods.icp import Icp
from study.methods.nonrigid_icp import NonrigidIcp
from study.methods.skeleton_graph import SkeletonGraphMethod, SkeletonRegistration
from study.methods.skeleton_graph_repaired import RepairedRegistration, SkeletonGraphRepaired
from study.methods.visible_surface import VisibleSurface
from study.registration import FieldRegistration, Method

__all__ = [
    "BEST_METHOD",
    "METHODS",
    "Bcpd",
    "CoarseOnly",
    "Cpd",
    "FieldRegistration",
    "GaussianProcess",
    "GaussianProcessRegistration",
    "Icp",
    "NonrigidIcp",
    "RepairedRegistration",
    "SkeletonGraphMethod",
    "SkeletonGraphRepaired",
    "SkeletonRegistration",
    "VisibleSurface",
]

# The tuned parameters were found on development subjects by tools/tune.py, for each surface by its own grid.
METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "coarse": CoarseOnly(),
        "icp": Icp(),
        "nonrigid_icp": NonrigidIcp(),
        "cpd": Cpd(),
        "skeleton_graph": SkeletonGraphMethod(),
        "icp_tuned": VisibleSurface(Icp.tuned()),
        "nonrigid_icp_tuned": VisibleSurface(NonrigidIcp.tuned()),
        "cpd_tuned": VisibleSurface(Cpd.tuned()),
        "skeleton_graph_tuned": VisibleSurface(SkeletonGraphMethod.tuned()),
        "skeleton_graph_authors": SkeletonGraphMethod.as_authors(),
        "icp_visible": VisibleSurface(Icp()),
        "nonrigid_icp_visible": VisibleSurface(NonrigidIcp()),
        "cpd_visible": VisibleSurface(Cpd()),
        "skeleton_graph_visible": VisibleSurface(SkeletonGraphMethod()),
        "icp_tuned_whole": Icp.tuned_whole(),
        "nonrigid_icp_tuned_whole": NonrigidIcp.tuned_whole(),
        "cpd_tuned_whole": Cpd.tuned_whole(),
        "skeleton_graph_tuned_whole": SkeletonGraphMethod.tuned_whole(),
        "skeleton_graph_repaired": VisibleSurface(SkeletonGraphRepaired.tuned()),
        "bcpd": Bcpd(),
        "bcpd_tuned": VisibleSurface(Bcpd.tuned()),
        "gaussian_process": VisibleSurface(GaussianProcess()),
    }
)

BEST_METHOD = "gaussian_process"  # the smallest true error on development people; README says by how much
