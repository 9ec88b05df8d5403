"""The way from the paper's method to `study.BEST_METHOD`, one change at a time, and what each is worth by the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from study.errors import StudyError
from study.evaluation.judgement import Judgement
from study.evaluation.pair import Pair
from study.methods import BEST_METHOD, METHODS
from study.methods.gaussian_process import GaussianProcess
from study.methods.visible_surface import VisibleSurface
from study.pipeline import register_aligned
from study.registration import Method, Registration
from study.seeds import named_rng
from study.types import PointCloud

ON_THE_WAY, LEFT_OUT = "on the way", "left out"


@dataclass(frozen=True)
class BySphere:
    """A method whose field is forgotten: its waypoints follow the paper's sphere (sec. III-D)."""

    name: ClassVar[str] = "by_sphere"

    method: Method

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """What ``method`` returns, without what it knows beyond its points."""
        result = self.method.register(source, target, rng)
        return Registration(**{one.name: getattr(result, one.name) for one in fields(Registration)})


@dataclass(frozen=True)
class Step:
    """One change.

    Attributes:
        role: `ON_THE_WAY`: on top of all steps before it; `LEFT_OUT`: of the best method, one idea left out.
        change: in words.
        method: what then registers.
    """

    role: str
    change: str
    method: Method


def way_to_best() -> list[Step]:
    """From the published graph to the best method, step upon step; then each of its ideas left out of it alone."""
    best = METHODS[BEST_METHOD]
    assert isinstance(best, VisibleSurface)
    whole = best.method
    assert isinstance(whole, GaussianProcess)
    shape_only = replace(whole, breathing=None)
    no_ends = replace(shape_only, ends=None)
    no_parts = replace(no_ends, shares=replace(whole.shares, other_part=1.0))
    no_local = replace(no_parts, prior=replace(whole.prior, local_mm=0.0))
    way: list[tuple[str, Method]] = [
        ("the paper's method", METHODS["skeleton_graph"]),
        ("what a probe can see, in place of the whole tube", METHODS["skeleton_graph_visible"]),
        ("the graph's parameters tuned", METHODS["skeleton_graph_tuned"]),
        ("a Gaussian process fitted one way, in place of the graph", VisibleSurface(BySphere(no_local))),
        ("each cartilage may bend on its own", VisibleSurface(BySphere(no_parts))),
        ("other parts count a tenth", VisibleSurface(BySphere(no_ends))),
        ("the cartilages' ends", VisibleSurface(BySphere(shape_only))),
        ("waypoints follow the field, in place of a sphere", VisibleSurface(shape_only)),
        ("breathing, by the times of the frames", best),
    ]
    without: list[tuple[str, Method]] = [
        ("the visible surface", whole),
        ("each cartilage's own bend", replace(whole, prior=replace(whole.prior, local_mm=0.0))),
        ("parts", replace(whole, shares=replace(whole.shares, other_part=1.0))),
        ("ends", replace(whole, ends=None)),
        ("the field for waypoints", BySphere(whole)),
        ("breathing", shape_only),
        ("nothing", whole),
    ]
    return [
        *(Step(ON_THE_WAY, change, method) for change, method in way),
        *(
            Step(LEFT_OUT, idea, method if idea == "the visible surface" else VisibleSurface(method))
            for idea, method in without
        ),
    ]


def walk(pairs: Sequence[Pair], steps: Sequence[Step], seed: int) -> pd.DataFrame:
    """True waypoint errors of every step on every pair.

    Args:
        pairs: whose deformation is known.
        steps: as `way_to_best` lists them.
        seed: of the draws.

    Returns:
        a row for each step and pair: ``role``, ``change``, ``case``, ``true``, ``in_plane`` and, where the sweep's
        constant shift is known, ``registered``: means over the waypoints, mm.

    Raises:
        StudyError: no pair or no step, a pair of two real people, or a method that fails.
    """
    if not (pairs and steps):
        raise StudyError(f"expected a pair and a step or more, got {len(pairs)} and {len(steps)}; list some")
    rows: list[dict[str, Any]] = []
    for step in steps:
        for pair in pairs:
            judged = Judgement(pair, register_aligned(pair.alignment, step.method, named_rng(seed, pair.name)))
            row: dict[str, Any] = {"role": step.role, "change": step.change, "case": f"{pair.source} to {pair.target}"}
            row["true"] = float(judged.true_waypoint_errors_mm().mean())
            row["in_plane"] = float(judged.true_waypoint_errors_mm(in_plane=True).mean())
            if pair.shift_mm is not None:
                row["registered"] = float(judged.registered_waypoint_errors_mm().mean())
            rows.append(row)
    return pd.DataFrame(rows)
