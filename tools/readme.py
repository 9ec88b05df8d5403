"""Write the numbers of README.md, docs/evidence.md and results/TABLES.md from results/reference: ``write | check``."""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd

from study.datasets import reported
from study.evaluation import METRICS, difference_intervals, interval_text, mean_intervals
from study.evaluation.pair import TRUTH, in_order
from study.files.atomic import write_text
from study.methods import BEST_METHOD
from study.results import REFERENCE, Evidence, Run, paper_hd_table, paper_waypoints
from study.results.evidence import KEPT

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
EVIDENCE = ROOT / "docs" / "evidence.md"
TABLES = ROOT / "results" / "TABLES.md"
MEASURES = (
    "hd",
    "waypoint_error",
    "waypoint_error_inplane",
    "waypoint_error_depth",
    "visible_hd",
    "visible_waypoint_error",
    "true_waypoint_error",
    "true_waypoint_error_inplane",
    "true_waypoint_error_depth",
    "registered_waypoint_error",
    "stretched_share",
)
SMALL = {  # column of the README's one table: metric
    "Hausdorff distance": "hd",
    "waypoints, protocol": "waypoint_error",
    "protocol, in plane": "waypoint_error_inplane",
    "true": "true_waypoint_error",
    "true, in plane": "true_waypoint_error_inplane",
}
RESOLUTION_MM = METRICS["true_waypoint_error"].mean_tolerance
GRAPH, BASELINES = "skeleton_graph", ("icp", "nonrigid_icp", "cpd")
ROWS = {
    GRAPH: "skeleton graph, as published",
    "cpd": "CPD, as shipped",
    "cpd_tuned_whole": "CPD, tuned, on the whole tube",
    "cpd_tuned": "CPD, tuned, on the visible surface",
    "skeleton_graph_repaired": "skeleton graph, repaired by this study",
    BEST_METHOD: "`gaussian_process`, by this study",
    TRUTH: "the known deformation itself",
}


def intervals(run: Run, metric: str) -> pd.DataFrame | None:
    """Means of every method with intervals over people; None where the run has no such metric."""
    per_pair = run.per_pair
    return mean_intervals(per_pair.loc[metric]) if metric in per_pair.index.get_level_values("metric") else None


def one_table(metric: str, runs: dict[str, Run]) -> str:
    """Methods by data sets with intervals, the paper's own numbers last, the smallest mean of a column bold."""
    paper = {"hd": paper_hd_table, "waypoint_error": paper_waypoints}.get(metric)
    columns: dict[str, dict[str, str]] = {}
    for name, run in runs.items():
        found = intervals(run, metric)
        if found is None:
            continue
        best = found["value"].drop(TRUTH, errors="ignore").idxmin()
        columns[f"{name} (n = {found['n_pairs'].max()} pairs)"] = {
            str(method): f"**{interval_text(row)}**" if method == best else interval_text(row)
            for method, row in found.iterrows()
        }
    if paper is not None:
        columns["paper, other data"] = {m: f"{row['mean']} ± {row['sd']}" for m, row in paper().iterrows()}
    methods = in_order(method for column in columns.values() for method in column)
    table = pd.DataFrame(columns, index=methods).fillna("–")
    table.index = pd.Index([f"`{name}`" for name in methods], name="method")
    return table.to_markdown(disable_numparse=True)


def tables_page(runs: dict[str, Run]) -> str:
    """Every method on every data set, one table a metric."""
    parts = [
        "# Tables\n",
        "Means over pairs with 95 % intervals over people; bold: the smallest mean of a column. "
        "Pairs share people, so people are drawn and not pairs: `phantom` has one patient and `planted` one person, so "
        "their intervals hold for other CTs of that patient and other deformations of that person; with four or five "
        "people every interval is rough. The paper's columns are other data, mean ± SD: compare orders, not numbers. "
        "`_visible`: shipped parameters on the visible surface; `_tuned`: tuned there; `_tuned_whole`: tuned on the "
        "whole tube; `truth`: the known deformation, judged as a method is.\n",
    ]
    for metric in MEASURES:
        about = METRICS[metric]
        unit = " (mm)" if about.unit == "mm" else ""
        parts.append(f"## {about.title}{unit}\n\n{one_table(metric, runs)}\n")
    return "\n".join(parts)


def small_table(run: Run) -> str:
    """The one table of the README: what the finding rests on, on one data set."""
    columns = {}
    for title, metric in SMALL.items():
        found = intervals(run, metric)
        assert found is not None
        columns[title] = {label: interval_text(found.loc[method], 1) for method, label in ROWS.items()}
    return pd.DataFrame(columns).rename_axis(f"`{run.dataset}`, mean [95 %], mm").to_markdown(disable_numparse=True)


def reading(runs: dict[str, Run]) -> str:
    """The finding in sentences made from the tables' numbers; they stand only as long as those bear them out."""
    known = {name: run for name, run in runs.items() if run.has_truth}
    hd, protocol, true = "hd", "waypoint_error", "true_waypoint_error"

    def lead(metric: str, rival: str, of: dict[str, Run] = runs) -> pd.DataFrame:
        """The graph minus a rival, data sets down."""
        return pd.DataFrame(
            {
                name: difference_intervals(run.per_pair.loc[metric], GRAPH, METRICS[metric].mean_tolerance).loc[rival]
                for name, run in of.items()
            }
        ).T

    def listed(found: pd.DataFrame, sign: int = 1) -> str:
        """``1.2 [0.3, 2.0], 0.9 [...]`` in the order of the data sets; rival minus graph at -1."""
        turned = found if sign == 1 else found.assign(value=-found["value"], low=-found["high"], high=-found["low"])
        return ", ".join(interval_text(row, 1) for _, row in turned.iterrows())

    def need(held: bool, said: str) -> None:
        if not held:
            raise SystemExit(f"the README's reading says that {said}; the numbers no longer bear that out: rewrite it")

    def is_below(found: pd.DataFrame) -> bool:
        """Whether the graph is ahead on every data set, beyond a tie."""
        return bool((found["value"] < 0).all() and not found["is_tie"].any())

    def ties(found: pd.DataFrame) -> str:
        """Which of them are ties, as the end of a clause."""
        tied = [f"`{name}`" for name in found.index if found.loc[name, "is_tie"]]
        return "" if not tied else " (ties)" if len(tied) == len(found) else f" (a tie on {' and '.join(tied)})"

    ahead = {(metric, rival): lead(metric, rival) for metric in (hd, protocol) for rival in BASELINES}
    equal = [f"`{rival}` on `{name}`" for rival in BASELINES for name in runs if ahead[hd, rival].loc[name, "is_tie"]]
    for metric in (hd, protocol):
        need(all((ahead[metric, rival]["value"] <= 0).all() for rival in BASELINES), f"{metric} is smallest everywhere")
        need(is_below(ahead[metric, "cpd"]), f"CPD as shipped is behind by {metric} on every data set")
        fair = lead(metric, "cpd_tuned_whole")
        need(bool((fair["value"] > ahead[metric, "cpd"]["value"] / 2).all()), "parameters are most of the lead")
    modern = lead(hd, "bcpd")
    need(bool((modern["value"] > 0).all()), "Bayesian CPD as shipped has the smaller Hausdorff distance everywhere")
    for rival in ("cpd_tuned", BEST_METHOD):
        behind = lead(true, rival, known)
        need(bool((behind["low"] > 0).all()), f"the truth reverses the order of the graph and {rival}")
    perfect = pd.DataFrame({name: intervals(run, protocol).loc[TRUTH] for name, run in known.items()}).T
    own = pd.DataFrame({name: intervals(run, true).loc[GRAPH] for name, run in known.items()}).T
    best = pd.DataFrame({name: intervals(run, true).loc[BEST_METHOD] for name, run in known.items()}).T
    scores = [run.per_pair.loc[protocol].mean() for run in known.values()]
    need(all(score[TRUTH] > score[GRAPH] for score in scores), "the protocol prefers the graph to the truth")
    names, truths = (", ".join(f"`{name}`" for name in those) for those in (runs, known))
    whole, path = lead(hd, "cpd_tuned_whole"), lead(protocol, "cpd_tuned_whole")
    visible = listed(lead(true, "cpd_tuned", known))
    return (
        "1. **As published, and by the paper's own measures, the skeleton graph comes first of the paper's four "
        "methods, as in the paper**: its Hausdorff distance is smaller than that of CPD as shipped by "
        f"{listed(ahead[hd, 'cpd'], -1)} mm on {names}{'; a tie with ' + ' and '.join(equal) if equal else ''}.\n"
        "2. **Most of that lead over CPD is CPD's parameters.** Tuned on the same whole tube, CPD is behind by "
        f"{listed(whole, -1)} mm{ties(whole)}, and in the waypoint error by {listed(path, -1)} mm{ties(path)}. "
        f"Bayesian CPD as shipped, a later rival, leads the graph's Hausdorff distance by {listed(modern)} mm"
        f"{ties(modern)}.\n"
        f"3. **By the truth the order turns round**: the graph's waypoints end {listed(own)} mm off on {truths}, "
        f"farther than those of CPD tuned on the visible surface by {visible} mm. The known deformation itself scores "
        f"{listed(perfect)} mm by the paper's protocol, more than the graph: the measures reward carrying the whole "
        f"tube onto the visible sheet. This study's own `{BEST_METHOD}`, which does not, ends {listed(best)} mm off.\n"
    )


def finding(runs: dict[str, Run], name: str) -> str:
    """The same in three sentences with the numbers of one data set; `reading` checks that they bear it out."""
    per_pair = runs[name].per_pair
    ties = [
        f"`{rival}` on `{one}`"
        for rival in BASELINES
        for one, run in runs.items()
        if difference_intervals(run.per_pair.loc["hd"], GRAPH, METRICS["hd"].mean_tolerance).loc[rival, "is_tie"]
    ]

    def mean(metric: str, method: str) -> float:
        return float(per_pair.loc[metric][method].mean())

    shipped, fair = (mean("hd", rival) - mean("hd", GRAPH) for rival in ("cpd", "cpd_tuned_whole"))
    true = {method: f"{mean('true_waypoint_error', method):.1f}" for method in (GRAPH, "cpd_tuned", BEST_METHOD)}
    return (
        "1. **By the paper's own measures its skeleton graph, as published, comes first of its four methods**, as in "
        f"the paper, on all {len(runs)} data sets{'; a tie with ' + ' and '.join(ties) if ties else ''}.\n"
        "2. **Most of that lead over CPD is CPD's parameters.** As shipped, CPD is behind by "
        f"{shipped:.1f} mm of Hausdorff distance; tuned on the same tube, by {fair:.1f} mm (`{name}`).\n"
        "3. **By the truth, which the paper could not know, the order turns round.** Waypoints end "
        f"{true[GRAPH]} mm off with the graph, {true['cpd_tuned']} mm with CPD tuned on the visible surface and "
        f"{true[BEST_METHOD]} mm with this study's `{BEST_METHOD}`: the measures reward carrying the whole tube onto "
        "the visible sheet.\n"
    )


def between_real_people(run: Run) -> str:
    """What the protocol says of the graph and tuned CPD where no truth is known, and what is left of it in plane."""
    whole, plane = (
        difference_intervals(run.per_pair.loc[metric], "cpd_tuned", METRICS[metric].mean_tolerance).loc[GRAPH]
        for metric in ("waypoint_error", "waypoint_error_inplane")
    )
    return (
        f"Between real people (`{run.dataset}`), where the truth is not known, the graph leads CPD tuned on the "
        f"visible surface by {interval_text(whole)} mm of the protocol's waypoint error; in the feature plane, which a "
        f"probe that rests on the skin needs, by {interval_text(plane)} mm{', a tie' * bool(plane['is_tie'])}.\n"
    )


def more_people(kept: Evidence, name: str = "population") -> str:
    """The same question put to more people."""
    per_pair, refused = kept.per_pair(name), kept.refused(name)
    true, registered = (mean_intervals(per_pair.loc[f"{what}_waypoint_error"]) for what in ("true", "registered"))
    shown = (GRAPH, "cpd_tuned", "bcpd_tuned", "skeleton_graph_repaired", BEST_METHOD)
    listed = ", ".join(f"`{method}` {interval_text(true.loc[method])}" for method in shown)
    of_best = difference_intervals(per_pair.loc["true_waypoint_error"], BEST_METHOD, RESOLUTION_MM)
    against = ", ".join(
        f"{interval_text(row)} mm against `{rival}`{' (a tie)' * bool(row['is_tie'])}"
        for rival, row in of_best.loc[["skeleton_graph_repaired", "bcpd_tuned"]].iterrows()
    )
    n_people = per_pair.index.get_level_values("source").nunique()
    as_registered = [interval_text(registered.loc[method]) for method in (BEST_METHOD, "skeleton_graph_repaired")]
    return (
        f"On {n_people} more synthetic people (`{name}`, {true['n_pairs'].max()} pairs of people in two sweeps each, "
        f"{len(refused) or 'none'} refused) the true waypoint error is: {listed} mm. `{BEST_METHOD}` minus the next "
        f"best: {against}; without the shift that no method can see it has {as_registered[0]} mm, the repaired graph "
        f"{as_registered[1]}. Worse clouds, other choices and more sweeps: "
        "[notebooks/66_evidence.ipynb](notebooks/66_evidence.ipynb).\n"
    )


def sections() -> dict[str, str]:
    """The generated part of the README, and of the page on the evidence."""
    runs = {name: Run(REFERENCE / name) for name in reported()}
    known = next(name for name, run in runs.items() if run.has_truth)
    real = next(name for name, run in runs.items() if not run.has_truth)
    note = (
        "Means over pairs with 95 % intervals over people. Every data set, more people and what speaks against it: "
        "[docs/evidence.md](docs/evidence.md).\n"
    )
    told = reading(runs)  # checks what `finding` says in short
    more = more_people(Evidence(KEPT)).replace("](notebooks/", "](../notebooks/")
    intervals_note = (
        "Means over pairs with 95 % intervals over people. All methods, data sets and measures, with the paper's own "
        "numbers: [results/TABLES.md](../results/TABLES.md). Each claim of the paper with ours beside it: "
        "[results/claims.md](../results/claims.md).\n"
    )
    return {
        "results": "\n".join([finding(runs, known), small_table(runs[known]) + "\n", note]),
        "evidence": "\n".join([told, between_real_people(runs[real]), more, intervals_note]),
    }


def renewed(text: str, name: str, section: str) -> str:
    """A page with the part between its markers replaced."""
    begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->"
    before, rest = text.split(begin)
    return before + begin + section + end + rest.split(end, 1)[1]


def main() -> int:
    """Rewrite or compare the parts between the markers."""
    if sys.argv[1:] not in (["write"], ["check"]):
        print("expected write or check", file=sys.stderr)
        return 2
    made = sections()
    pages = {
        path: renewed(path.read_text(encoding="utf-8"), name, made[name])
        for path, name in ((README, "results"), (EVIDENCE, "evidence"))
    }
    pages[TABLES] = tables_page({name: Run(REFERENCE / name) for name in reported()})
    if sys.argv[1:] == ["write"]:
        for path, text in pages.items():
            write_text(path, text)
        return 0
    old = [path for path, text in pages.items() if not path.is_file() or path.read_text(encoding="utf-8") != text]
    if old:
        names = ", ".join(path.relative_to(ROOT).as_posix() for path in old)
        print(f"{names}: not those of results/reference; run 'make reference'")
        return 1
    print("README.md, docs/evidence.md: the numbers are up to date")
    return 0


if __name__ == "__main__":
    sys.exit(main())
