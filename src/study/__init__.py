"""Thoracic cartilage ultrasound-CT registration with a dense skeleton graph, as a reproducible study."""

from importlib import import_module
from typing import Any

__version__ = "0.2.0"

# Found on first use: importing the methods costs seconds, which `study data list` need not pay.
_HOMES = {"METHODS": "study.methods", "register_pair": "study.pipeline", "StudyError": "study.errors"}

__all__ = ["METHODS", "StudyError", "__version__", "register_pair"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'study' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
