"""Registration methods behind one verb (sec. IV)."""

from collections.abc import Mapping
from types import MappingProxyType

from study.methods.coarse_only import CoarseOnly
from study.methods.cpd import Cpd
from study.methods.icp import Icp
from study.methods.nonrigid_icp import NonrigidIcp
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.types import Method

# As published or as the library ships it.
METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "coarse": CoarseOnly(),
        "icp": Icp(),
        "nonrigid_icp": NonrigidIcp(),
        "cpd": Cpd(),
        "skeleton_graph": SkeletonGraphMethod(),
    }
)
