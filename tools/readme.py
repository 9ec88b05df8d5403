"""Write the results table of README.md from results/reference, or check that it is up to date: ``write | check``."""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd

from study.metrics import population_sd
from study.results import paper_hd_table, paper_waypoints, read_metrics, write_text

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
BEGIN, END = "<!-- results:begin -->\n", "<!-- results:end -->"
SHOWN = {
    "hd": "Hausdorff",
    "waypoint_error": "waypoints, paper's protocol",
    "true_waypoint_error": "waypoints, truth",
}


def pooled(metrics: pd.DataFrame, metric: str, method: str) -> str:
    """Mean ± population SD: of pairs for distances, of all waypoints for waypoint errors, as the paper."""
    values = metrics.loc[(metrics["metric"] == metric) & (metrics["method"] == method), "value"].to_numpy()
    return f"{values.mean():.2f} ± {population_sd(values):.2f}" if values.size else "–"


def table() -> str:
    """The table in Markdown, with what its columns are."""
    runs = {name: read_metrics(ROOT / "results" / "reference" / name / "metrics.csv") for name in ("phantom", "open")}
    hd, waypoints = paper_hd_table(), paper_waypoints()
    rows = []
    for method in dict.fromkeys(runs["phantom"]["method"]):
        row = {"Method": f"`{method}`"}
        for name, metrics in runs.items():
            for metric, title in SHOWN.items():
                if metric in set(metrics["metric"]):
                    row[f"{name}: {title}"] = pooled(metrics, metric, method)
        known = method in hd.index
        row["paper: Hausdorff"] = f"{hd.loc[method, 'mean']} ± {hd.loc[method, 'sd']}" if known else "–"
        row["paper: waypoints"] = f"{waypoints.loc[method, 'mean']} ± {waypoints.loc[method, 'sd']}" if known else "–"
        rows.append(row)
    pairs = {name: len(m.drop_duplicates(["subject", "target"])) for name, m in runs.items()}
    note = (
        f"\nMean ± population SD, mm. Phantom: {pairs['phantom']} synthetic CTs to one synthetic patient; open: "
        f"{pairs['open']} ordered pairs of real people, the target under a virtual sweep. The paper's columns are "
        "other data: its five CTs and its volunteer. `_tuned` methods have parameters from development subjects and "
        "register only the surface that ultrasound can see.\n"
    )
    return pd.DataFrame(rows).to_markdown(index=False, disable_numparse=True) + "\n" + note


def main() -> int:
    """Rewrite or compare the part between the markers."""
    text = README.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    new = before + BEGIN + table() + END + rest.split(END, 1)[1]
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
