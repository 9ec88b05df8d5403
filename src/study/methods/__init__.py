"""Registration methods behind one verb (sec. IV)."""

from collections.abc import Mapping
from types import MappingProxyType

from study.methods.skeleton_graph import SkeletonGraphMethod
from study.types import Method

METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "skeleton_graph": SkeletonGraphMethod(),
    }
)
