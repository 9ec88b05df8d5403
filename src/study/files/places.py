"""Where the package's own files are: beside the sources in a checkout, inside the package once installed."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).parents[1]
CHECKOUT = Path(__file__).parents[3]  # of a checkout; meaningless once installed


def is_checkout() -> bool:
    """Whether the package runs from a checkout of the repository."""
    return (CHECKOUT / "data_manifest.yaml").is_file() and (CHECKOUT / "src" / "study") == PACKAGE


def shipped(name: str) -> Path:
    """A file or folder that the package needs at run time, by its path in the repository.

    The wheel carries ``data_manifest.yaml``, ``annotations`` and ``results/paper`` below ``study/shipped``.
    """
    return CHECKOUT / name if is_checkout() else PACKAGE / "shipped" / name
