"""Write the results of README.md and results/TABLES.md from results/reference, or check them: ``write | check``."""

from __future__ import annotations

import sys
from pathlib import Path

from study.datasets import reported
from study.evaluation import METRICS, difference_intervals, interval_text, mean_intervals
from study.files.atomic import write_text
from study.methods import BEST_METHOD
from study.results import REFERENCE, Evidence, Run
from study.results.evidence import KEPT
from study.results.finding import (
    GRAPH,
    MEASURES,
    NotBorneOut,
    between_real_people,
    metric_table,
    reading,
    small_table,
)

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
BEGIN, END = "<!-- results:begin -->\n", "<!-- results:end -->"
TABLES = ROOT / "results" / "TABLES.md"
RESOLUTION_MM = METRICS["true_waypoint_error"].mean_tolerance


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
        parts.append(f"## {about.title}{unit}\n\n{metric_table(metric, runs)}\n")
    return "\n".join(parts)


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


def section() -> str:
    """The part of the README between the markers."""
    runs = {name: Run(REFERENCE / name) for name in reported()}
    known = next(name for name, run in runs.items() if run.has_truth)
    real = next(name for name, run in runs.items() if not run.has_truth)
    note = (
        "Means over pairs with 95 % intervals over people. All methods, data sets and measures, with the paper's own "
        "numbers: [results/TABLES.md](results/TABLES.md). Each claim of the paper with ours beside it: "
        "[results/claims.md](results/claims.md).\n"
    )
    parts = [reading(runs), small_table(runs[known]) + "\n", between_real_people(runs[real])]
    return "\n".join([*parts, more_people(Evidence(KEPT)), note])


def main() -> int:
    """Rewrite or compare the part between the markers."""
    text = README.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    try:
        new = before + BEGIN + section() + END + rest.split(END, 1)[1]
    except NotBorneOut as error:
        raise SystemExit(f"README.md: {error}") from error
    page = tables_page({name: Run(REFERENCE / name) for name in reported()})
    if sys.argv[1:] == ["write"]:
        write_text(README, new)
        write_text(TABLES, page)
        return 0
    if sys.argv[1:] != ["check"]:
        print("expected write or check", file=sys.stderr)
        return 2
    if new != text or not TABLES.is_file() or TABLES.read_text(encoding="utf-8") != page:
        print("README.md, results/TABLES.md: not those of results/reference; run 'make reference'")
        return 1
    print("README.md: results table is up to date")
    return 0


if __name__ == "__main__":
    sys.exit(main())
