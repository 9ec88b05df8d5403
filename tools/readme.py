"""Write the numbers of README.md, docs/evidence.md and results/TABLES.md from results/reference: ``write | check``."""

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
    in_short,
    metric_table,
    reading,
    small_table,
)

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
EVIDENCE = ROOT / "docs" / "evidence.md"
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


def sections() -> dict[str, str]:
    """The generated part of the README, and of the page on the evidence."""
    runs = {name: Run(REFERENCE / name) for name in reported()}
    known = next(name for name, run in runs.items() if run.has_truth)
    real = next(name for name, run in runs.items() if not run.has_truth)
    note = (
        "Means over pairs with 95 % intervals over people. Every data set, more people and what speaks against it: "
        "[docs/evidence.md](docs/evidence.md).\n"
    )
    told = reading(runs)  # checks what `in_short` says
    more = more_people(Evidence(KEPT)).replace("](notebooks/", "](../notebooks/")
    intervals_note = (
        "Means over pairs with 95 % intervals over people. All methods, data sets and measures, with the paper's own "
        "numbers: [results/TABLES.md](../results/TABLES.md). Each claim of the paper with ours beside it: "
        "[results/claims.md](../results/claims.md).\n"
    )
    return {
        "results": "\n".join([in_short(runs, known), small_table(runs[known]) + "\n", note]),
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
    try:
        made = sections()
    except NotBorneOut as error:
        raise SystemExit(f"README.md: {error}") from error
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
