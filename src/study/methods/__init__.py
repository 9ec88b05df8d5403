"""Registration methods behind one verb (sec. IV).

``METHODS`` holds them by name, as published or as the library ships them, then tuned, then with every choice of the
authors' code:

    >>> list(METHODS)
    ['coarse', 'icp', 'nonrigid_icp', 'cpd', 'skeleton_graph', \
'icp_tuned', 'nonrigid_icp_tuned', 'cpd_tuned', 'skeleton_graph_tuned', 'skeleton_graph_authors']

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

from study.methods.coarse_only import CoarseOnly
from study.methods.cpd import Cpd
from study.methods.icp import Icp
from study.methods.nonrigid_icp import NonrigidIcp
from study.methods.skeleton_graph import SkeletonGraphMethod, SkeletonRegistration
from study.methods.visible_surface import VisibleSurface
from study.registration import Method

__all__ = [
    "METHODS",
    "CoarseOnly",
    "Cpd",
    "Icp",
    "NonrigidIcp",
    "SkeletonGraphMethod",
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
    }
)
