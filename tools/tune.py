"""Tune every method on development subjects: every grid row on every pair, one table a method and surface.

    python tools/tune.py [icp icp_whole nonrigid_icp ... visible_surface] [--out results/tuning]

The development subjects are phantoms of cohort seeds that the study does not report. They take the study's own road:
CT volume, labels, surface and cloud of the atlas; a virtual sweep with all errors on of the patient; coarse alignment.
Each row is run on the surface that ultrasound can see (``icp.csv``) and on the whole tube (``icp_whole.csv``). The best
row of a table has the smallest mean true waypoint error. `Icp.tuned()`, `Icp.tuned_whole()` and their like hold that
row, and a test holds them to the table. The last grid runs each winner of the visible surface on the whole tube, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from study.data.manifest import load_manifest
from study.datasets.people import make_patient
from study.datasets.phantoms import PhantomDataset
from study.errors import StudyError
from study.evaluation.metrics import judge
from study.evaluation.pair import Pair
from study.methods.cpd import Cpd
from study.methods.icp import Icp
from study.methods.nonrigid_icp import NonrigidIcp, Stage
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.methods.skeleton_graph_repaired import SkeletonGraphRepaired
from study.methods.visible_surface import VisibleSurface
from study.params import find_profile
from study.pipeline import register_aligned
from study.registration import Method
from study.seeds import named_rng
from study.skeleton.batch_som import BatchSomParams
from study.skeleton.som import SomParams
from study.skeleton.spline import NodeSpline

# Source subject and cohort seed; the target is its "patient".
PAIRS = (("ct1", 101), ("ct2", 102), ("ct3", 103), ("ct4", 104), ("ct5", 105), ("ct1", 106))
# Six people do not tell settings 0.1 mm apart; the later grids have four more.
MORE_PAIRS = (*PAIRS, ("ct2", 201), ("ct3", 202), ("ct4", 203), ("ct5", 204))
WHOLE = "_whole"  # ends the tables of the whole tube
GRIDS = (
    *(name + surface for name in ("icp", "nonrigid_icp", "cpd", "skeleton_graph") for surface in ("", WHOLE)),
    "skeleton_graph_repaired",
    "visible_surface",
)
ON_MORE = ("skeleton_graph_repaired",)
MEASURES = {  # column of the tables: metric
    "waypoint_error_mm": "true_waypoint_error",
    "waypoint_error_inplane_mm": "true_waypoint_error_inplane",
    "true_error_mm": "true_error_mean",
    "hd_mm": "hd",
}


def development_pair(name: str, seed: int) -> Pair:
    """A pair of the phantoms of one cohort seed, its sweep drawn by that seed; its source is ``ct1@101``."""
    params = find_profile("full")
    people = PhantomDataset("phantom", params, 0, load_manifest(), cohort_seed=seed)
    patient = make_patient(people.anatomy("patient"), params, seed)
    return replace(people.pair(people.anatomy(name), patient), source=f"{name}@{seed}")


def scaled_steps(factor: float) -> tuple[Stage, ...]:
    """The library's own steps, stiffer by ``factor``."""
    return tuple((round(ws * factor, 6), wl, wn, n) for ws, wl, wn, n in NonrigidIcp().steps)


def falling_steps(stiffest: float) -> tuple[Stage, ...]:
    """Amberg's order, stiff first."""
    return tuple((round(stiffest / 3**k, 6), 0.0, 0.5 if k < 3 else 0.0, 10) for k in range(4))


def grid(name: str) -> Iterator[Method]:
    """The shipped setting first, then the grid; for the whole tube, too, and there what `wider` adds."""
    if name.endswith(WHOLE):
        yield from grid(name.removesuffix(WHOLE))
        yield from wider(name)
    elif name == "icp":
        yield Icp()
        for distance, plane in product((2.0, 3.0, 5.0, 7.0, 10.0, 20.0, 1000.0), (False, True)):
            yield Icp(max_distance_mm=distance, point_to_plane=plane, max_iterations=200)
    elif name == "nonrigid_icp":
        yield NonrigidIcp()
        schedules = (scaled_steps(0.1), scaled_steps(0.3), scaled_steps(1.0), scaled_steps(3.0), falling_steps(0.03))
        for steps, gamma in product(schedules, (1.0, 10.0, 30.0)):
            if NonrigidIcp(steps=steps, gamma=gamma) != NonrigidIcp():
                yield NonrigidIcp(steps=steps, gamma=gamma)
        yield NonrigidIcp(distance_threshold=0.05)
    elif name == "cpd":
        yield Cpd()
        for beta, alpha, share in product((20.0, 30.0, 50.0, 80.0, 120.0), (0.02, 0.2, 2.0), (0.0, 0.1)):
            yield Cpd(beta_mm=beta, alpha=alpha, outlier_share=share)
    elif name == "skeleton_graph":
        yield SkeletonGraphMethod()
        for radius, schedule in product((2.0, 3.0, 4.0, 5.0), ("constant", "linear")):
            som = SomParams(radius=radius, rate_schedule=schedule)
            yield SkeletonGraphMethod(ct_som=som, us_som=som)
        for winners, n_reg in product(("any", "own_part"), (2, 3)):
            som = SomParams(rate_schedule="linear", winners=winners)
            yield SkeletonGraphMethod(som, som, n_reg, "hops", blend_weights="inverse_distance")
    elif name == "skeleton_graph_repaired":
        yield SkeletonGraphRepaired()
        for end, smoothing in product((2.0, 3.0, 4.0), (1000.0, 3000.0, 10_000.0)):
            if SkeletonGraphRepaired(*radii(20.0, end), NodeSpline(smoothing=smoothing)) != SkeletonGraphRepaired():
                yield SkeletonGraphRepaired(*radii(20.0, end), NodeSpline(smoothing=smoothing))
        for start in (10.0, 40.0):
            yield SkeletonGraphRepaired(*radii(start, 3.0))
        for smoothing in (10.0, 30.0, 100.0):
            yield SkeletonGraphRepaired(spline=NodeSpline("linear", smoothing))
        # Each change to the paper's method taken back.
        for som in (BatchSomParams(lengths="hops"), BatchSomParams(winners="any")):
            yield SkeletonGraphRepaired(som, som)
        yield SkeletonGraphRepaired(smooth_every_epoch=False)
    elif name == "visible_surface":  # each tuned method on the whole tube and on its visible half
        for tuned in (Icp.tuned(), NonrigidIcp.tuned(), Cpd.tuned(), SkeletonGraphMethod.tuned()):
            yield tuned
            yield VisibleSurface(tuned)
    else:
        raise SystemExit(f"expected one of {', '.join(GRIDS)}, got {name!r}")


def radii(start_mm: float, end_mm: float) -> tuple[BatchSomParams, BatchSomParams]:
    """Both maps with these radii."""
    som = BatchSomParams(start_radius_mm=start_mm, end_radius_mm=end_mm)
    return som, som


def wider(name: str) -> Iterator[Method]:
    """A step beyond the edges at which the best rows of the whole tube lay: a shorter reach, fewer hops."""
    if name == "nonrigid_icp_whole":
        yield NonrigidIcp(distance_threshold=0.025)
        for reach, gamma in product((0.025, 0.05), (1.0, 10.0, 30.0)):
            yield NonrigidIcp(steps=scaled_steps(0.3), gamma=gamma, distance_threshold=reach)
    elif name == "skeleton_graph_whole":
        som = SomParams(rate_schedule="linear", winners="own_part")
        yield SkeletonGraphMethod(som, som, 1, "hops", blend_weights="inverse_distance")


def run_grid(methods: Iterable[Method], pairs: list[Pair], *, visible: bool) -> pd.DataFrame:
    """One row per setting and pair: parameters, true errors of waypoints and points, Hausdorff distance.

    Args:
        methods: the settings.
        pairs: the cases.
        visible: each method on the visible surface, not as it is.
    """
    rows: list[dict[str, Any]] = []
    for setting, method in enumerate(methods):
        runner = VisibleSurface(method) if visible else method
        for pair in pairs:
            row = {"setting": setting, "case": pair.source, "name": label(method), **asdict(method)}  # type: ignore[call-overload]
            try:
                result = register_aligned(pair.alignment, runner, named_rng(0, pair.source))
                values = judge(pair, result)
                row |= {measure: values[metric].mean() for measure, metric in MEASURES.items()}
                row |= {"converged": result.converged, "n_iterations": result.n_iterations, "status": "ok"}
                seconds = result.seconds
            except StudyError as failure:
                row["status"], seconds = str(failure), float("nan")
            rows.append(row)
            error = row.get("waypoint_error_mm", "failed")
            print(f"{method.name} {setting:3d} {pair.source:9s} {error} {seconds:.1f} s", flush=True)
    return pd.DataFrame(rows)


def label(method: Method) -> str:
    """The method's name, and whether it sees the visible half only."""
    return f"{method.method.name}, visible surface" if isinstance(method, VisibleSurface) else method.name


def summarise(table: pd.DataFrame) -> pd.DataFrame:
    """Mean over the pairs, best setting first; a setting that failed on a case cannot be the best."""
    parameters = list(table.columns[2 : table.columns.get_loc("waypoint_error_mm")])
    summary = (
        table.assign(failed=table["status"] != "ok")
        .groupby("setting", as_index=False)
        .agg(
            {name: "first" for name in parameters} | dict.fromkeys([*MEASURES, "converged"], "mean") | {"failed": "sum"}
        )
    )
    return summary.sort_values(["failed", "waypoint_error_mm"], kind="stable")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("methods", nargs="*", default=list(GRIDS))
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "results" / "tuning")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    wanted = MORE_PAIRS if set(options.methods) & set(ON_MORE) else PAIRS
    everyone = [development_pair(name, seed) for name, seed in wanted]
    for name in options.methods:
        pairs = everyone if name in ON_MORE else everyone[: len(PAIRS)]
        visible = not name.endswith(WHOLE) and name != "visible_surface"
        summary = summarise(run_grid(grid(name), pairs, visible=visible))
        summary.to_csv(options.out / f"{name}.csv", index=False, lineterminator="\n")
        print(summary.head(8).to_string(index=False))


if __name__ == "__main__":
    main()
