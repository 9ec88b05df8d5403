"""Tune every method on development subjects: every grid row on every pair, one table a method and surface.

    python tools/tune.py [icp icp_whole nonrigid_icp ... visible_surface] [--out results/tuning]

The development subjects are people that the study does not report, of three kinds: phantoms, phantoms over the whole
published spread, and deformations planted into every real CT by a seed of its own. They take the study's own road: CT
volume, labels, surface and cloud of the atlas; a virtual sweep with all errors on of the patient; coarse alignment.
Each row is run on the surface that ultrasound can see (``icp.csv``) and on the whole tube (``icp_whole.csv``), on a
pair of each kind; the six best of them on all pairs. The best row of a table has the smallest mean true waypoint error.
`Icp.tuned()`, `Icp.tuned_whole()` and their like hold that row, and a test holds them to the table. The grid
``visible_surface`` runs each winner of the visible surface on the whole tube, too.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from functools import partial
from itertools import product, zip_longest
from pathlib import Path
from typing import Any

import pandas as pd

from study.data.manifest import load_manifest
from study.datasets.cohort import CohortDataset
from study.datasets.people import Anatomy, make_patient
from study.datasets.phantoms import PhantomDataset
from study.errors import StudyError
from study.evaluation.metrics import judge
from study.evaluation.pair import Pair, align_pair
from study.methods.bcpd import Bcpd
from study.methods.branch_ends import BranchEnds
from study.methods.cpd import Cpd
from study.methods.displacement_field import DisplacementPrior
from study.methods.gaussian_process import GaussianProcess
from study.methods.icp import Icp
from study.methods.nonrigid_icp import NonrigidIcp, Stage
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.methods.skeleton_graph_repaired import SkeletonGraphRepaired
from study.methods.visible_surface import VisibleSurface
from study.params import find_profile
from study.phantom.planted import planted_deformation
from study.phantom.sizes import MAX_SD
from study.pipeline import register_aligned
from study.registration import Method
from study.seeds import named_rng
from study.skeleton.batch_som import BatchSomParams
from study.skeleton.som import SomParams
from study.skeleton.spline import NodeSpline

# Source subject and cohort seed; the target is its "patient". Of planted deformations, the CT and the seed of
# deformation and sweep. tools/bounds.py has others of the same three kinds.
PHANTOMS = tuple((name, seed) for seed in (201, 202) for name in ("ct1", "ct2", "ct3"))
FULL_SPREAD = tuple((name, seed) for seed in (401, 402, 403) for name in ("ct1", "ct2"))
REAL = ("lidc-0001", "totalseg-example", "lung1", "lung2")
PLANTED = tuple((person, 401) for person in REAL)
# Half as many of each kind for all but `gaussian_process`, whose few rows are quick to run: the other grids are large.
FEWER = (
    (("ct1", 201), ("ct2", 201), ("ct3", 202)),
    (("ct1", 401), ("ct2", 402), ("ct1", 403)),
    (("lidc-0001", 401), ("lung2", 402)),
)
FIELD = "gaussian_process"
FIRST = 3  # pairs that every row of such a grid runs on, one of each kind
FINALISTS = 6  # rows that the others decide among
WHOLE = "_whole"  # ends the tables of the whole tube
GRIDS = (
    *(name + surface for name in ("icp", "nonrigid_icp", "cpd", "skeleton_graph") for surface in ("", WHOLE)),
    "bcpd",
    "skeleton_graph_repaired",
    "visible_surface",
    "gaussian_process",
)
MEASURES = {  # column of the tables: metric
    "waypoint_error_mm": "true_waypoint_error",
    "waypoint_error_inplane_mm": "true_waypoint_error_inplane",
    "true_error_mm": "true_error_mean",
    "hd_mm": "hd",
}


def development_pair(name: str, seed: int, max_sd: float = MAX_SD) -> Pair:
    """A pair of the phantoms of one cohort seed, its sweep drawn by that seed; its source is ``ct1@101``."""
    params = find_profile("full")
    people = PhantomDataset("phantom", params, 0, load_manifest(), cohort_seed=seed, max_sd=max_sd)
    patient = make_patient(people.anatomy("patient"), params, seed)
    return replace(people.pair(people.anatomy(name), patient), source=f"{name}@{seed}")


def planted_pair(person: str, seed: int) -> Pair:
    """A real CT, and a patient who is that person under a deformation of 5 to 9 mm; ``seed`` draws it and the sweep."""
    params = find_profile("full")
    source = CohortDataset("open", params, 0, load_manifest()).anatomy(person)
    deform = planted_deformation(source.mesh.vertices, 5.0 + seed % 5, named_rng(seed, f"planted/{person}"))
    name = f"{person}+dev{seed}"
    moved = Anatomy(
        name,
        replace(source.mesh, vertices=deform.apply(source.mesh.vertices), name=name),
        replace(source.cloud, points=deform.apply(source.cloud.points), name=f"ct:{name}"),
        replace(source.waypoints, points=deform.apply(source.waypoints.points)),
        planted=deform,
    )
    patient = make_patient(moved, params, seed)
    pair = align_pair(
        source.cloud, patient.cloud, source.waypoints.points, patient.labelled, names=(f"{person}@{seed}", name)
    )
    points, waypoints = (
        patient.T_us_ras.apply(deform.apply(places)) for places in (source.cloud.points, source.waypoints.points)
    )
    return replace(pair, true_points=points, true_waypoints=waypoints, shift_mm=patient.shift_mm)


def three_kinds(
    phantoms: Iterable[tuple[str, int]], full_spread: Iterable[tuple[str, int]], planted: Iterable[tuple[str, int]]
) -> list[Pair]:
    """Development pairs of three kinds; one that the coarse alignment refuses is left out, and told."""
    makers = [partial(development_pair, *one) for one in phantoms]
    makers += [partial(development_pair, *one, float("inf")) for one in full_spread]
    makers += [partial(planted_pair, *one) for one in planted]
    pairs = []
    for make in makers:
        try:
            pairs.append(make())
        except StudyError as refused:
            print(f"left out: {refused}", flush=True)
    return pairs


def people_for(name: str) -> list[Pair]:
    """The development pairs of a grid; of the large grids the first three are of three kinds."""
    if name == FIELD:
        return three_kinds(PHANTOMS, FULL_SPREAD, PLANTED)
    kinds = [three_kinds(*(people if k == kind else () for k, people in enumerate(FEWER))) for kind in range(3)]
    return [one for row in zip_longest(*kinds) for one in row if one is not None]


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
        for beta, alpha in product((20.0, 30.0, 50.0, 80.0, 120.0), (0.005, 0.02, 0.06, 0.2, 2.0)):
            yield Cpd(beta_mm=beta, alpha=alpha)
        # The best row, 120 mm and 0.005, lies at the edge by 0.003 mm; 180 mm gave 2.14, a weight of 0.001 gave 1.99.
        yield Cpd(beta_mm=30.0, alpha=0.2, outlier_share=0.1)  # an outlier term that is wrong for data in millimetres
    elif name == "bcpd":
        yield Bcpd()
        for beta, lam, share in product((0.6, 0.9, 1.2, 1.8, 2.5), (20.0, 60.0, 200.0), (0.0, 0.1)):
            yield Bcpd(beta=beta, lam=lam, outlier_share=share)
        # What its author advises for clouds that are roughly aligned: one scale for both, a narrower start.
        for beta, lam in product((0.9, 1.2, 1.8, 2.5, 3.5), (6.0, 20.0, 60.0, 200.0)):
            yield Bcpd(beta=beta, lam=lam, gamma=0.3, normalise="source")
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
        for end, smoothing in product((1.5, 2.0, 3.0, 4.0), (1000.0, 3000.0, 10_000.0)):
            if SkeletonGraphRepaired(*radii(20.0, end), NodeSpline(smoothing=smoothing)) != SkeletonGraphRepaired():
                yield SkeletonGraphRepaired(*radii(20.0, end), NodeSpline(smoothing=smoothing))
        for start in (10.0, 40.0):
            yield SkeletonGraphRepaired(*radii(start, BatchSomParams().end_radius_mm))
        for smoothing in (10.0, 30.0, 100.0):
            yield SkeletonGraphRepaired(spline=NodeSpline("linear", smoothing))
        # Each change to the paper's method taken back.
        for som in (BatchSomParams(lengths="hops"), BatchSomParams(winners="any")):
            yield SkeletonGraphRepaired(som, som)
        yield SkeletonGraphRepaired(smooth_every_epoch=False)
    elif name == "gaussian_process":
        smooths = ((6.5, 58.0), (10.0, 70.0), (14.0, 90.0))
        for (smooth, length), local, worth in product(smooths, (1.6, 2.4), (130.0, 200.0)):
            prior = DisplacementPrior(6.0, smooth_mm=smooth, smooth_length_mm=length, local_mm=local)
            yield GaussianProcess(prior=prior, independent_points=worth)
        middle = DisplacementPrior(6.0, smooth_mm=10.0, smooth_length_mm=70.0, local_mm=1.6)
        yield GaussianProcess(prior=middle, independent_points=200.0, ends=BranchEnds(1.5, 4.0))
        # Less left of pose and size, which the smooth bend can make up for.
        for affine, worth in ((3.0, 200.0), (3.0, 130.0), (1.5, 200.0)):
            yield GaussianProcess(prior=replace(middle, affine_mm=affine), independent_points=worth)
        wide = DisplacementPrior(3.0, smooth_mm=14.0, smooth_length_mm=90.0, local_mm=2.4)
        yield GaussianProcess(prior=wide, independent_points=130.0)
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


def run_grid(methods: Mapping[int, Method], pairs: list[Pair], *, visible: bool) -> pd.DataFrame:
    """Every setting on the first pairs, those that did best there on all of them.

    Args:
        methods: the settings, by number.
        pairs: the cases; the first ``FIRST`` are one of each kind.
        visible: each method on the visible surface, not as it is.
    """
    first = run_settings(methods, pairs[:FIRST], visible=visible)
    best = summarise(first)["setting"].head(FINALISTS)
    rest = run_settings({one: methods[one] for one in sorted(best)}, pairs[FIRST:], visible=visible)
    return pd.concat([first, rest], ignore_index=True)


def run_settings(methods: Mapping[int, Method], pairs: list[Pair], *, visible: bool) -> pd.DataFrame:
    """One row per setting and pair: parameters, true errors of waypoints and points, Hausdorff distance.

    Args:
        methods: the settings, by number.
        pairs: the cases.
        visible: each method on the visible surface, not as it is.
    """
    rows: list[dict[str, Any]] = []
    for setting, method in methods.items():
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
    """Mean over the pairs, best setting first; one that failed on a case, or left out early, cannot be the best."""
    parameters = list(table.columns[2 : table.columns.get_loc("waypoint_error_mm")])
    summary = (
        table.assign(failed=table["status"] != "ok")
        .groupby("setting", as_index=False)
        .agg(
            {name: "first" for name in parameters}
            | dict.fromkeys([*MEASURES, "converged"], "mean")
            | {"failed": "sum", "case": "count"}
        )
    )
    summary = summary.rename(columns={"case": "pairs"})
    return summary.sort_values(["pairs", "failed", "waypoint_error_mm"], ascending=[False, True, True], kind="stable")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("methods", nargs="*", default=list(GRIDS))
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "results" / "tuning")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.methods:
        pairs = people_for(name)
        visible = not name.endswith(WHOLE) and name != "visible_surface"
        settings = dict(enumerate(grid(name)))
        run = run_settings if name == FIELD else run_grid
        summary = summarise(run(settings, pairs, visible=visible))
        summary.to_csv(options.out / f"{name}.csv", index=False, lineterminator="\n")
        print(summary.head(8).to_string(index=False))


if __name__ == "__main__":
    main()
