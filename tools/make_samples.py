"""Write samples/: a small CT cloud, the cloud of a simulated sweep, waypoints, and where those truly belong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd

from study.datasets import find_dataset
from study.files.atomic import write_text
from study.files.clouds import write_ply
from study.params import find_profile
from study.types import Floats

SAMPLES = Path(__file__).resolve().parents[1] / "samples"


def write_places(points: Floats, labels: tuple[str, ...], path: Path) -> None:
    """Waypoints as CSV, micrometres."""
    table = pd.DataFrame(points, columns=["x", "y", "z"]).assign(label=labels)
    write_text(path, table.to_csv(index=False, float_format="%.3f", lineterminator="\n"))


def main() -> None:
    """Make the files from the study's own data set `phantom`."""
    settings = replace(find_profile("quick"), ct_points=6000, us_spacing_mm=1.5)
    data = find_dataset("phantom", settings, 0)
    source, target = data.pairs()[0]
    anatomy, patient = data.anatomy(source), data.patient(target)
    pair = data.pair(anatomy, patient)
    assert pair.true_waypoints is not None
    write_ply(replace(anatomy.cloud, parts=None), SAMPLES / "ct.ply")
    write_ply(replace(patient.cloud, parts=None), SAMPLES / "us.ply")
    write_places(anatomy.waypoints.points, anatomy.waypoints.labels, SAMPLES / "waypoints.csv")
    write_places(pair.true_waypoints, anatomy.waypoints.labels, SAMPLES / "waypoints_true.csv")
    print(f"{source} to {target}: {len(anatomy.cloud)} and {len(patient.cloud)} points")


if __name__ == "__main__":
    main()
