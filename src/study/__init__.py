"""Thoracic cartilage ultrasound-CT registration with a dense skeleton graph, as a reproducible study."""

from importlib import import_module
from typing import Any

from study.offline import is_offline, watch_connections

__version__ = "0.3.0"

# Found on first use: importing the methods costs seconds, which `study data list` need not pay.
_HOMES = {
    "BEST_METHOD": "study.methods",
    "METHODS": "study.methods",
    "PointCloud": "study.types",
    "Registration": "study.registration",
    "StudyError": "study.errors",
    "read_plus": "study.files.plus",
    "register_pair": "study.pipeline",
    "sweep_cloud": "study.ultrasound.cloud",
    "transfer": "study.registration",
}

if is_offline():
    watch_connections()

__all__ = [
    "BEST_METHOD",
    "METHODS",
    "PointCloud",
    "Registration",
    "StudyError",
    "__version__",
    "read_plus",
    "register_pair",
    "sweep_cloud",
    "transfer",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'study' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
