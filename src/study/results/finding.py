"""The finding in sentences and its tables, made from the numbers of runs; README.md and the report say the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from study.errors import StudyError
from study.evaluation.intervals import difference_intervals, interval_text, mean_intervals
from study.evaluation.metrics import METRICS
from study.evaluation.pair import TRUTH, in_order
from study.methods import BEST_METHOD
from study.results.run import Run
from study.results.tables import paper_hd_table, paper_waypoints

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
SMALL = {  # column of the one small table: metric
    "Hausdorff distance": "hd",
    "waypoints, protocol": "waypoint_error",
    "protocol, in plane": "waypoint_error_inplane",
    "true": "true_waypoint_error",
    "true, in plane": "true_waypoint_error_inplane",
}
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
HD, PROTOCOL, TRUE = "hd", "waypoint_error", "true_waypoint_error"


class NotBorneOut(StudyError):
    """Runs whose numbers do not say what the sentences would."""


def intervals(run: Run, metric: str) -> pd.DataFrame | None:
    """Means of every method with intervals over people; None where the run has no such metric."""
    per_pair = run.per_pair
    return mean_intervals(_of(run, metric)) if metric in per_pair.index.get_level_values("metric") else None


def _of(run: Run, metric: str) -> pd.DataFrame:
    """Means over each pair's values of one metric: index source, target; a column a method."""
    per_pair = run.per_pair
    return per_pair[per_pair.index.get_level_values("metric") == metric].droplevel("metric")


def _lead(run: Run, metric: str, of: str, rival: str) -> pd.Series[Any]:
    """``of`` minus ``rival`` with its interval."""
    found = difference_intervals(_of(run, metric), of, METRICS[metric].mean_tolerance)
    return found.T[rival]


def metric_table(metric: str, runs: Mapping[str, Run]) -> str:
    """Methods by data sets with intervals as Markdown, the paper's own numbers last; a column's smallest mean bold."""
    paper = {HD: paper_hd_table, PROTOCOL: paper_waypoints}.get(metric)
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
        columns["paper, other data"] = {str(m): f"{row['mean']} ± {row['sd']}" for m, row in paper().iterrows()}
    methods = in_order(method for column in columns.values() for method in column)
    table = pd.DataFrame(columns, index=pd.Index(methods)).fillna("–")
    table.index = pd.Index([f"`{name}`" for name in methods], name="method")
    return str(table.to_markdown(disable_numparse=True))


def small_table(run: Run) -> str:
    """What the finding rests on, on one data set, as Markdown; only what was run."""
    columns = {}
    for title, metric in SMALL.items():
        found = intervals(run, metric)
        if found is not None:
            columns[title] = {label: interval_text(found.T[m], 1) for m, label in ROWS.items() if m in found.index}
    return str(
        pd.DataFrame(columns).rename_axis(f"`{run.dataset}`, mean [95 %], mm").to_markdown(disable_numparse=True)
    )


@dataclass(frozen=True)
class _Leads:
    """How far the graph leads its rivals on several runs, and how to say it."""

    runs: Mapping[str, Run]

    @property
    def known(self) -> _Leads:
        return _Leads({name: run for name, run in self.runs.items() if run.has_truth})

    def lead(self, metric: str, rival: str) -> pd.DataFrame:
        """The graph minus a rival, data sets down."""
        return pd.DataFrame({name: _lead(run, metric, GRAPH, rival) for name, run in self.runs.items()}).T

    def own(self, metric: str, method: str) -> pd.DataFrame:
        """A method's means, data sets down."""
        return pd.DataFrame({name: mean_intervals(_of(run, metric)).T[method] for name, run in self.runs.items()}).T

    @property
    def names(self) -> str:
        return ", ".join(f"`{name}`" for name in self.runs)


def _listed(found: pd.DataFrame, sign: int = 1) -> str:
    """``1.2 [0.3, 2.0], 0.9 [...]`` in the order of the data sets; rival minus graph at -1."""
    turned = found if sign == 1 else found.assign(value=-found["value"], low=-found["high"], high=-found["low"])
    return ", ".join(interval_text(row, 1) for _, row in turned.iterrows())


def _ties(found: pd.DataFrame) -> str:
    """Which of them are ties, as the end of a clause."""
    tied = [f"`{name}`" for name in found.index if found.loc[name, "is_tie"]]
    return "" if not tied else " (ties)" if len(tied) == len(found) else f" (a tie on {' and '.join(tied)})"


def _need(held: bool, said: str) -> None:
    if not held:
        raise NotBorneOut(f"the finding says that {said}; the numbers no longer bear that out: rewrite it")


def _is_below(found: pd.DataFrame) -> bool:
    """Whether the graph is ahead on every data set, beyond a tie."""
    return bool((found["value"] < 0).all() and not found["is_tie"].any())


def reading(runs: Mapping[str, Run]) -> str:
    """The finding as Markdown, in sentences that stand only as long as the numbers bear them out.

    Args:
        runs: by data set, all of them with every method of the sentences.

    Raises:
        NotBorneOut: a method that was not run, or numbers that say something else.
    """
    needed = [GRAPH, *BASELINES, "cpd_tuned_whole", "cpd_tuned", "bcpd", BEST_METHOD]
    missing = [method for method in needed if any(method not in run.methods for run in runs.values())]
    if missing or not any(run.has_truth for run in runs.values()):
        told = ", ".join(missing) or "a data set whose truth is known"
        raise NotBorneOut(f"the finding is of every method on data sets that are reported, expected also {told}")
    every = _Leads(runs)
    known = every.known
    return _by_the_paper(every) + _by_parameters(every) + _by_the_truth(every, known)


def _by_the_paper(every: _Leads) -> str:
    ahead = {(metric, rival): every.lead(metric, rival) for metric in (HD, PROTOCOL) for rival in BASELINES}
    equal = [
        f"`{rival}` on `{name}`" for rival in BASELINES for name in every.runs if ahead[HD, rival].loc[name, "is_tie"]
    ]
    for metric in (HD, PROTOCOL):
        _need(
            all((ahead[metric, rival]["value"] <= 0).all() for rival in BASELINES), f"{metric} is smallest everywhere"
        )
        _need(_is_below(ahead[metric, "cpd"]), f"CPD as shipped is behind by {metric} on every data set")
    return (
        "1. **As published, and by the paper's own measures, the skeleton graph comes first of the paper's four "
        "methods, as in the paper**: its Hausdorff distance is smaller than that of CPD as shipped by "
        f"{_listed(ahead[HD, 'cpd'], -1)} mm on {every.names}"
        f"{'; a tie with ' + ' and '.join(equal) if equal else ''}.\n"
    )


def _by_parameters(every: _Leads) -> str:
    for metric in (HD, PROTOCOL):
        shipped, fair = every.lead(metric, "cpd"), every.lead(metric, "cpd_tuned_whole")
        _need(bool((fair["value"] > shipped["value"] / 2).all()), "parameters are most of the lead")
    modern = every.lead(HD, "bcpd")
    _need(bool((modern["value"] > 0).all()), "Bayesian CPD as shipped has the smaller Hausdorff distance everywhere")
    whole, path = every.lead(HD, "cpd_tuned_whole"), every.lead(PROTOCOL, "cpd_tuned_whole")
    return (
        "2. **Most of that lead over CPD is CPD's parameters.** Tuned on the same whole tube, CPD is behind by "
        f"{_listed(whole, -1)} mm{_ties(whole)}, and in the waypoint error by {_listed(path, -1)} mm{_ties(path)}. "
        f"Bayesian CPD as shipped, a later rival, leads the graph's Hausdorff distance by {_listed(modern)} mm"
        f"{_ties(modern)}.\n"
    )


def _by_the_truth(every: _Leads, known: _Leads) -> str:
    for rival in ("cpd_tuned", BEST_METHOD):
        behind = known.lead(TRUE, rival)
        _need(bool((behind["low"] > 0).all()), f"the truth reverses the order of the graph and {rival}")
    scores = [_of(run, PROTOCOL).mean() for run in known.runs.values()]
    _need(all(score[TRUTH] > score[GRAPH] for score in scores), "the protocol prefers the graph to the truth")
    own, best, perfect = known.own(TRUE, GRAPH), known.own(TRUE, BEST_METHOD), known.own(PROTOCOL, TRUTH)
    return (
        f"3. **By the truth the order turns round**: the graph's waypoints end {_listed(own)} mm off on {known.names}, "
        f"farther than those of CPD tuned on the visible surface by {_listed(known.lead(TRUE, 'cpd_tuned'))} mm. The "
        f"known deformation itself scores {_listed(perfect)} mm by the paper's protocol, more than the graph: the "
        f"measures reward carrying the whole tube onto the visible sheet. This study's own `{BEST_METHOD}`, which does "
        f"not, ends {_listed(best)} mm off.\n"
    )


def in_short(runs: Mapping[str, Run], name: str) -> str:
    """The same in three short sentences with the numbers of one data set; `reading` checks that they bear it out."""
    run = runs[name]
    ties = [
        f"`{rival}` on `{one}`"
        for rival in BASELINES
        for one, each in runs.items()
        if _lead(each, HD, GRAPH, rival)["is_tie"]
    ]

    def mean(metric: str, method: str) -> float:
        return float(_of(run, metric)[method].mean())

    shipped, fair = (mean(HD, rival) - mean(HD, GRAPH) for rival in ("cpd", "cpd_tuned_whole"))
    true = {method: f"{mean(TRUE, method):.1f}" for method in (GRAPH, "cpd_tuned", BEST_METHOD)}
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


def one_line(runs: Mapping[str, Run]) -> str:
    """What came out, or why no finding can be stated, for a terminal."""
    try:
        reading(runs)
    except NotBorneOut as error:
        return f"none is stated: {error}"
    name, run = next((name, run) for name, run in runs.items() if run.has_truth)
    hd, true = ({method: float(_of(run, metric)[method].mean()) for method in run.methods} for metric in (HD, TRUE))
    return (
        f"by the paper's own measures the skeleton graph comes first of its four methods on {len(runs)} data sets "
        f"(Hausdorff distance on {name} {hd[GRAPH]:.1f} mm, CPD {hd['cpd']:.1f}); by the truth it is "
        f"{true[GRAPH]:.1f} mm off, CPD tuned {true['cpd_tuned']:.1f}, {BEST_METHOD} {true[BEST_METHOD]:.1f}"
    )


def between_real_people(run: Run) -> str:
    """What the protocol says of the graph and tuned CPD where no truth is known, and what is left of it in plane."""
    whole, plane = (_lead(run, metric, "cpd_tuned", GRAPH) for metric in (PROTOCOL, "waypoint_error_inplane"))
    return (
        f"Between real people (`{run.dataset}`), where the truth is not known, the graph leads CPD tuned on the "
        f"visible surface by {interval_text(whole)} mm of the protocol's waypoint error; in the feature plane, which a "
        f"probe that rests on the skin needs, by {interval_text(plane)} mm{', a tie' * bool(plane['is_tie'])}.\n"
    )
