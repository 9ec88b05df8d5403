"""Write the results table of README.md from results/reference, or check that it is up to date: ``write | check``."""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd

from study.datasets import reported
from study.evaluation.pair import TRUTH
from study.evaluation.statistics import population_sd
from study.files.atomic import write_text
from study.methods import METHODS
from study.results import REFERENCE, Run, paper_hd_table, paper_waypoints

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
BEGIN, END = "<!-- results:begin -->\n", "<!-- results:end -->"
MEASURES = {
    "hd": "Hausdorff distance (Eq. 5), over pairs",
    "waypoint_error": "Waypoint error by the paper's protocol, over waypoints",
    "true_waypoint_error": "True waypoint error, over waypoints; between real people it is not known",
}
PUBLISHED = ("icp", "nonrigid_icp", "cpd", "skeleton_graph")


def pooled(values: pd.Series) -> tuple[float, float]:
    """Mean and population SD."""
    return float(values.mean()), population_sd(values)


def one_table(measure: str, runs: dict[str, pd.DataFrame]) -> str:
    """Methods by datasets, the paper's own numbers last, the best method of each dataset bold."""
    paper = {"hd": paper_hd_table, "waypoint_error": paper_waypoints}.get(measure)
    columns: dict[str, dict[str, str]] = {}
    for name, metrics in runs.items():
        chosen = metrics[metrics["metric"] == measure]
        numbers = {method: pooled(rows["value"]) for method, rows in chosen.groupby("method")}
        if not numbers:
            continue
        best = min((method for method in numbers if method != TRUTH), key=lambda method: numbers[method][0])
        n_pairs = len(chosen.drop_duplicates(["source", "target"]))
        columns[f"{name} (n = {n_pairs} pairs)"] = {
            method: f"**{mean:.2f} ± {sd:.2f}**" if method == best else f"{mean:.2f} ± {sd:.2f}"
            for method, (mean, sd) in numbers.items()
        }
    if paper is not None:
        theirs = paper()
        columns["paper, other data"] = {method: f"{row['mean']} ± {row['sd']}" for method, row in theirs.iterrows()}
    methods = [*METHODS, TRUTH] if any(TRUTH in column for column in columns.values()) else list(METHODS)
    table = pd.DataFrame(columns, index=methods).fillna("–")
    table.index = pd.Index([f"`{name}`" for name in methods], name=MEASURES[measure])
    return table.to_markdown(disable_numparse=True)


def reading(runs: dict[str, pd.DataFrame]) -> str:
    """What the tables say, in sentences made from the same numbers."""

    def mean(name: str, measure: str, method: str) -> float:
        rows = runs[name]
        return float(rows.loc[(rows["metric"] == measure) & (rows["method"] == method), "value"].mean())

    names = {"hd": "Hausdorff distance", "waypoint_error": "waypoint error by the protocol"}
    first = []
    for measure, title in names.items():
        won = [n for n in runs if min(PUBLISHED, key=lambda m, n=n: mean(n, measure, m)) == "skeleton_graph"]
        first.append(f"by {title} on {len(won)} of {len(runs)} datasets")
    truths = [name for name in runs if TRUTH in set(runs[name]["method"])]
    by_truth = "; ".join(
        f"on `{name}` {mean(name, 'true_waypoint_error', 'skeleton_graph'):.2f} mm, where "
        f"`{(best := min(METHODS, key=lambda m, n=name: mean(n, 'true_waypoint_error', m)))}` has "
        f"{mean(name, 'true_waypoint_error', best):.2f} mm"
        for name in truths
    )
    # The sentences below are words, not numbers: they may stand only as long as the numbers bear them out.
    for name in truths:
        if not mean(name, "true_waypoint_error", "skeleton_graph") > mean(name, "waypoint_error", "skeleton_graph"):
            raise SystemExit(f"{name}: the README's reading says that the truth is worse than the protocol; rewrite it")
        for measure in names:
            if not mean(name, measure, TRUTH) > mean(name, measure, "skeleton_graph"):
                raise SystemExit(f"{name}: the README's reading says that {measure} rewards the published; rewrite it")
    return (
        f"Among the four methods as published, the skeleton graph comes first {' and '.join(first)}. "
        f"By the truth its waypoints are farther off: {by_truth}. The row `{TRUTH}` says how both can be: a perfect "
        "registration, scored by the same rules, does not score zero. The paper maps whole tubes onto the visible "
        "sheet, and its measures reward that.\n"
    )


def section() -> str:
    """The part of the README between the markers."""
    runs = {name: Run(REFERENCE / name).metrics for name in reported()}
    note = (
        "Mean ± population SD, mm; bold: the smallest of a column. `phantom`: synthetic CTs to one synthetic patient; "
        "`planted`: a real CT to itself under known deformations; `open`: ordered pairs of real people. Every patient "
        "is a virtual sweep with its errors. The paper's columns are other data, its five CTs and its volunteer: "
        "compare orders, not numbers. `_tuned` methods have parameters from development subjects and register only the "
        "surface that ultrasound can see.\n"
    )
    return "\n".join([reading(runs), *[one_table(measure, runs) + "\n" for measure in MEASURES], note])


def main() -> int:
    """Rewrite or compare the part between the markers."""
    text = README.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    new = before + BEGIN + section() + END + rest.split(END, 1)[1]
    if sys.argv[1:] == ["write"]:
        write_text(README, new)
        return 0
    if sys.argv[1:] != ["check"]:
        print("expected write or check", file=sys.stderr)
        return 2
    if new != text:
        print("README.md: its results table is not that of results/reference; run 'make reference'")
        return 1
    print("README.md: results table is up to date")
    return 0


if __name__ == "__main__":
    sys.exit(main())
