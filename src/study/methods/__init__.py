"""Registration methods behind one verb (sec. IV)."""

from collections.abc import Mapping
from types import MappingProxyType

from study.methods.coarse_only import CoarseOnly
from study.methods.cpd import Cpd
from study.methods.icp import Icp
from study.methods.nonrigid_icp import NonrigidIcp
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.methods.visible_surface import VisibleSurface
from study.types import Method

# As published or as the library ships it; then tuned, with parameters found on development subjects by
# tools/tune.py. On those subjects the visible half of the tubes gave every method the smaller waypoint error.
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
    }
)
