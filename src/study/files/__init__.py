"""Every format read and written, and the one atomic writer."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from study.files.calibration import read_calibration, write_calibration
    from study.files.clouds import read_ply, read_timed_ply, write_ply
    from study.files.landmarks import read_landmarks
    from study.files.plus import read_plus
    from study.files.plus_write import write_plus
    from study.files.registered import write_registration
    from study.files.sweep_folder import read_folder, write_folder
    from study.files.volumes import read_labels, read_masks, read_volume, write_volume
    from study.files.waypoints import read_waypoints

__all__ = [
    "read_calibration",
    "read_folder",
    "read_labels",
    "read_landmarks",
    "read_masks",
    "read_plus",
    "read_ply",
    "read_timed_ply",
    "read_volume",
    "read_waypoints",
    "write_calibration",
    "write_folder",
    "write_plus",
    "write_ply",
    "write_registration",
    "write_volume",
]

_HOMES = {
    "read_calibration": "calibration",
    "read_folder": "sweep_folder",
    "read_labels": "volumes",
    "read_landmarks": "landmarks",
    "read_masks": "volumes",
    "read_plus": "plus",
    "read_ply": "clouds",
    "read_timed_ply": "clouds",
    "read_volume": "volumes",
    "read_waypoints": "waypoints",
    "write_calibration": "calibration",
    "write_folder": "sweep_folder",
    "write_plus": "plus_write",
    "write_ply": "clouds",
    "write_registration": "registered",
    "write_volume": "volumes",
}


def __getattr__(name: str) -> Any:
    """Import a reader's module when it is first asked for: who only writes a text does not wait for SimpleITK."""
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
