"""What each error of a tracked sweep costs: the cloud, and the waypoints of every method (sec. II)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from study.alignment.chest import Chest, find_chest
from study.errors import StudyError
from study.evaluation.distances import directed_distances_mm, waypoint_errors_mm
from study.evaluation.pair import Pair
from study.geometry.rays import surface_distance_mm
from study.methods import METHODS
from study.methods.coarse_only import CoarseOnly
from study.pipeline import find_method, register_aligned
from study.seeds import named_rng
from study.types import Floats, Mesh, RigidTransform
from study.ultrasound.cloud import SweepCloud, contour_points, sweep_cloud
from study.ultrasound.sweep_errors import SweepErrors, budget_cases
from study.ultrasound.tracked import TrackedSweep
from study.ultrasound.visible import true_parts

SweepOf = Callable[[SweepErrors, int], TrackedSweep]  # errors and number of the sweep
NO_ERRORS = "none"
COVERED = 1.25  # a point of the cloud that many spacings away covers a place of the surface


@dataclass(frozen=True)
class Budget:
    """The error budget of one patient.

    Attributes:
        rows: ``error`` (its name), ``repeat``, ``metric``, ``method`` ("" for a cloud's own), ``value``; metrics are
            ``surface_distance`` (mm), ``covered`` (%), ``moved`` (mm), ``waypoint_error`` and
            ``waypoint_error_inplane`` (mm).
        refused: ``error``, ``sweep`` and ``reason`` of every sweep that the coarse alignment refused; it was started
            by hand.
    """

    rows: pd.DataFrame
    refused: pd.DataFrame

    @property
    def errors(self) -> list[str]:
        """What goes wrong, in the order of `budget_cases`."""
        return list(dict.fromkeys(self.rows["error"]))

    @property
    def methods(self) -> list[str]:
        """The methods, in the order they were given."""
        return [method for method in dict.fromkeys(self.rows["method"]) if method]

    def mean(self, metric: str) -> pd.DataFrame:
        """Means of one metric over the sweeps: a row an error, a column a method ("" for a cloud's own)."""
        chosen = self.rows[self.rows["metric"] == metric]
        means = chosen.pivot_table(index="error", columns="method", values="value", sort=False)
        return means.reindex(self.errors)

    def by_hand(self) -> pd.Series:
        """How many sweeps under each error the coarse alignment refused."""
        return self.refused.groupby("error").size().reindex(self.errors, fill_value=0)


@dataclass(frozen=True)
class Scanned:
    """A patient whose surface is known.

    Attributes:
        surface: all of it, RAS+ mm.
        visible: the part a probe can see.
        T_us_ras: RAS+ to the tracker's frame.
        waypoints: (k, 3) mm, where the path belongs, RAS+.
    """

    surface: Mesh
    visible: Mesh
    T_us_ras: RigidTransform
    waypoints: Floats

    def in_ras(self, points: Floats) -> Floats:
        """Points (n, 3) mm of the tracker's frame in that of the surface, RAS+."""
        return self.T_us_ras.inverse.apply(points)

    def distances_mm(self, points: Floats) -> Floats:
        """Distance (n,) mm of RAS+ points (n, 3) mm from what a probe can see of the surface."""
        return surface_distance_mm(points, self.visible)


def error_budget(
    pair: Pair,
    scanned: Scanned,
    sweep_of: SweepOf,
    *,
    seed: int,
    repeats: int,
    spacing_mm: float,
    radius_mm: float = 20.0,
    methods: Sequence[str] | None = None,
) -> Budget:
    """Switch on one source of error at a time and register each sweep with every method.

    Where the coarse alignment refuses a sweep, the methods start by hand: from the alignment of the sweep without
    errors, with the true parts as labels, so that the row still says what the error costs.

    Args:
        pair: the CT and the patient.
        scanned: the patient's true surface and path.
        sweep_of: a sweep over the patient under some errors; every case of one repeat shares its random draws.
        seed: of the methods' draws.
        repeats: sweeps of each case.
        spacing_mm: of the clouds.
        radius_mm: sphere of the path transfer.
        methods: names in ``METHODS``; when None all but the coarse alignment alone, which is where they start.

    Raises:
        StudyError: a sweep without errors that is refused, or a method that fails.
    """
    if methods is None:
        methods = [name for name, method in METHODS.items() if not isinstance(method, CoarseOnly)]
    rows: list[dict[str, Any]] = []
    refused: list[dict[str, Any]] = []
    for repeat in range(repeats):
        undisturbed, frames, *_ = contour_points(sweep_of(SweepErrors.none(), repeat))
        start: Chest | None = None
        for name, errors in budget_cases():
            sweep = sweep_of(errors, repeat)
            seen = sweep_cloud(sweep, spacing_mm=spacing_mm)
            values = _cloud_costs(seen, scanned, spacing_mm)
            contour, its_frames, *_ = contour_points(sweep)
            if np.array_equal(its_frames, frames):  # the same pixels: only then do points pair
                values["moved"] = float(np.linalg.norm(contour - undisturbed, axis=1).mean())
            chest, reason = _chest_or_by_hand(seen, start, scanned)
            if name == NO_ERRORS:
                start = chest
            if reason:
                refused.append({"error": name, "sweep": repeat, "reason": reason})
            what = {"error": name, "repeat": repeat}
            rows += [{**what, "metric": metric, "method": "", "value": value} for metric, value in values.items()]
            rows += [{**what, **cost} for cost in _path_costs(pair, chest, scanned, methods, repeat, seed, radius_mm)]
    return Budget(pd.DataFrame(rows), pd.DataFrame(refused, columns=["error", "sweep", "reason"]))


def _cloud_costs(seen: SweepCloud, scanned: Scanned, spacing_mm: float) -> dict[str, float]:
    """How far the cloud lies from the visible surface (mm), and how much of that it covers (%)."""
    points = scanned.in_ras(seen.cloud.points)
    near = directed_distances_mm(scanned.visible.vertices, points) < COVERED * spacing_mm
    return {
        "surface_distance": float(scanned.distances_mm(points).mean()),
        "covered": float(100 * near.mean()),
    }


def _chest_or_by_hand(seen: SweepCloud, start: Chest | None, scanned: Scanned) -> tuple[Chest, str]:
    """The chest that the coarse alignment finds; where it refuses, the undisturbed one's place, and why."""
    cloud = replace(seen.cloud, front=seen.front)
    try:
        return find_chest(cloud), ""
    except StudyError as error:
        if start is None:
            raise
        parts = true_parts(scanned.in_ras(cloud.points), scanned.surface)
        return replace(start, cloud=replace(cloud, parts=parts)), str(error)


def _path_costs(
    pair: Pair, chest: Chest, scanned: Scanned, methods: Sequence[str], repeat: int, seed: int, radius_mm: float
) -> list[dict[str, Any]]:
    """Mean true error (mm) of the carried waypoints, in space and in the feature plane, by method."""
    alignment = pair.with_target(chest).alignment
    normal = chest.T_cloud_chest.rotation[:, 2]
    goal = scanned.T_us_ras.apply(scanned.waypoints)
    costs = []
    for method in methods:
        result = register_aligned(alignment, find_method(method), named_rng(seed, f"us/{repeat}/{method}"))
        carried = result.transfer(pair.waypoints_ct, radius_mm)
        for metric, plane in (("waypoint_error", None), ("waypoint_error_inplane", normal)):
            error = float(waypoint_errors_mm(carried, goal, plane).mean())
            costs.append({"metric": metric, "method": method, "value": error})
    return costs
