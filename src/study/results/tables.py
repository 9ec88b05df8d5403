"""Tables of a run: Table I and its companions, waypoint errors; full precision inside, rounded in the text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.evaluation.pair import TRUTH, in_order
from study.evaluation.statistics import population_sd
from study.files.atomic import write_text
from study.files.places import shipped
from study.naming import natural_key, split_sweep
from study.results.metrics_csv import CASE, KEY, NOT_CONVERGED

MOST_TABLES = 6  # of one patient each


def write_tables(metrics: pd.DataFrame, out: Path, *, with_paper: bool = True) -> None:
    """Write into a new folder the Hausdorff tables in the shape of the paper's Table I: one a patient, columns the CTs.

    One CT with several patients (the planted deformations) is turned: columns are the patients. Sweeps of a patient are
    averaged. More patients than tables of that shape can show share one, in which a CT is averaged over its patients.
    The paper's rows stand under the study's, but not where ``with_paper`` is false, as for people of one's own.
    """
    metrics = metrics.assign(target=[split_sweep(target)[0] for target in metrics["target"]])
    targets = sorted(metrics["target"].unique())
    dataset = metrics["dataset"].iloc[0]
    if metrics["source"].nunique() == 1:
        turned = metrics.assign(source=metrics["target"])
        caption = f"Hausdorff distance, {dataset}: {metrics['source'].iloc[0]} to each simulated patient"
        write_hd_table(turned, out / "hd_table", caption=caption, with_paper=with_paper)
        return
    if len(targets) > MOST_TABLES:
        caption = f"Hausdorff distance, {dataset}: each CT, mean over its simulated patients"
        write_hd_table(metrics, out / "hd_table", caption=caption, with_paper=with_paper)
        return
    for target in targets:
        stem = out / ("hd_table" if len(targets) == 1 else f"hd_table_{target}")
        who = "the simulated patient" if target == "patient" else f"the simulated patient {target}"
        caption = f"Hausdorff distance, {dataset}: each CT to {who}"
        write_hd_table(metrics[metrics["target"] == target], stem, caption=caption, with_paper=with_paper)
    if len(targets) > 1:
        pairs_named = metrics.assign(source=metrics["source"] + " to " + metrics["target"])
        caption = f"Hausdorff distance, {dataset}: all ordered pairs"
        write_hd_table(pairs_named, out / "hd_all_pairs", caption=caption, with_paper=with_paper)


PAPER_DATA = "paper (other data)"


def mean_sd_table(per_pair: pd.DataFrame) -> pd.DataFrame:
    """Every metric of every method as text, mean ± population SD over the pairs (n).

    Args:
        per_pair: index metric and pair, a column a method, as `study.results.Run.per_pair`.

    Returns:
        index the metrics' titles and units in the order of ``METRICS``; a column a method.
    """

    def cell(values: pd.Series) -> str:
        known = values.dropna()
        return f"{known.mean():.2f} ± {population_sd(known):.2f} (n={len(known)})" if len(known) else "–"

    text = per_pair.groupby(level="metric").agg(cell)
    present = [name for name in METRICS if name in text.index]
    return text.loc[present].rename(index={name: f"{METRICS[name].title} ({METRICS[name].unit})" for name in present})


def _one_dataset(metrics: pd.DataFrame) -> None:
    datasets = sorted(metrics["dataset"].unique())
    if len(datasets) != 1:
        raise StudyError(f"expected rows of one dataset for a table, got {datasets}; select one")


def hd_table(metrics: pd.DataFrame, metric: str = "hd") -> pd.DataFrame:
    """A metric of each method on each CT, in the shape of the paper's Table I; full precision.

    Args:
        metrics: rows of one dataset, as `read_metrics` gives them.
        metric: also any other of ``METRICS``; several values of a CT (waypoints, seeds, targets) are averaged.

    Returns:
        index method, in the order of ``METHODS``; a column per CT, NaN where it failed, then ``mean``, ``sd``
        (population, over the columns), ``n`` (columns with a value), ``n_failed`` and ``n_not_converged`` (cases).

    Raises:
        StudyError: several datasets, or no row of that metric.
    """
    _one_dataset(metrics)
    chosen = metrics[metrics["metric"] == metric]
    failed = metrics[metrics["metric"] == CASE]
    if chosen.empty and failed.empty:
        raise StudyError(f"expected rows of metric {metric!r}, got {sorted(metrics['metric'].unique())}")
    cases = pd.concat([chosen, failed])
    methods = in_order(cases["method"])
    sources = sorted(cases["source"].unique(), key=natural_key)
    table = chosen.pivot_table(index="method", columns="source", values="value", aggfunc="mean")
    table = table.reindex(index=methods, columns=sources).rename_axis(columns=None)
    values = table.to_numpy()
    some = [row[np.isfinite(row)] for row in values]
    table["mean"] = [row.mean() if row.size else np.nan for row in some]
    table["sd"] = [population_sd(row) if row.size else np.nan for row in some]
    table["n"] = [row.size for row in some]
    stuck = chosen[chosen["status"] == NOT_CONVERGED].drop_duplicates(list(KEY[:5]))
    for name, rows in (("n_failed", failed), ("n_not_converged", stuck)):
        table[name] = rows.groupby("method").size().reindex(methods, fill_value=0).astype(np.int64)
    return table


def paper_hd_table(path: Path | None = None) -> pd.DataFrame:
    """The paper's Table I as printed: index method, columns ``CT 1`` to ``CT 5``, ``mean``, ``sd``, ``n``, notes."""
    return _paper(path or shipped("results/paper") / "table1.csv")


def paper_waypoints(path: Path | None = None) -> pd.DataFrame:
    """The paper's waypoint errors as printed (sec. IV-B): index method, columns ``mean``, ``sd``, ``n``, ``notes``."""
    return _paper(path or shipped("results/paper") / "waypoints.csv")


def _paper(path: Path) -> pd.DataFrame:
    if not path.is_file():
        raise StudyError(f"expected the paper's numbers at {path}, got no such file; run from a checkout")
    return pd.read_csv(path, index_col="method", keep_default_na=False)


def beside_paper(table: pd.DataFrame, paper: pd.DataFrame | None = None) -> tuple[pd.DataFrame, str]:
    """`hd_table` rounded as Table I is, the paper's rows under it; and the note that belongs under the two.

    Returns:
        columns ``Data``, ``Method``, ``CT 1`` ..., ``Mean±SD``, ``n``, all text; and the note.
    """
    paper = paper_hd_table() if paper is None else paper
    sources = list(table.columns[: table.columns.get_loc("mean")])
    theirs = [name for name in paper.columns if name.startswith("CT ")]
    columns = [f"CT {k + 1}" for k in range(max(len(sources), len(theirs)))]
    rows = []
    for method, row in table.iterrows():
        empty = "failed" if row["n_failed"] else "–"
        cells = [_mm(row[name], empty) for name in sources]
        counts = {"failed": row["n_failed"], "not converged": row["n_not_converged"]}
        remarks = ", ".join(f"{int(count)} {what}" for what, count in counts.items() if count)
        done = f"{int(row['n'])}" + (f" ({remarks})" if remarks else "")
        rows.append(["this study", str(method), cells, _mean_sd(row["mean"], row["sd"], empty), done])
    for method, row in paper.iterrows():
        cells = [_mm(row[name], "–") for name in theirs]
        rows.append([PAPER_DATA, str(method), cells, _mean_sd(row["mean"], row["sd"], "–"), str(row["n"])])
    display = pd.DataFrame(
        [[data, method, *cells, *[""] * (len(columns) - len(cells)), mean, n] for data, method, cells, mean, n in rows],
        columns=["Data", "Method", *columns, "Mean±SD", "n"],
    )
    names = ", ".join(f"CT {k + 1} = {name}" for k, name in enumerate(sources))
    note = (
        f"Unit: mm; SD: population (ddof = 0), over the n subjects. This study: {names}. "
        "The paper's rows are its Table I as printed, five other CTs against one volunteer: "
        "compare the order of the methods, not the numbers."
    )
    if TRUTH in table.index:
        note += f" {TRUTH}: the known deformation itself, what a perfect registration would score."
    return display, note


def _mm(value: float, empty: str) -> str:
    return empty if pd.isna(value) else f"{value:.2f}"


def _mean_sd(mean: float, sd: float, empty: str) -> str:
    return empty if pd.isna(mean) else f"{mean:.2f}±{sd:.2f}"


def write_hd_table(
    metrics: pd.DataFrame, stem: Path, metric: str = "hd", caption: str | None = None, *, with_paper: bool = True
) -> pd.DataFrame:
    """Write ``stem.csv`` (full precision), ``stem.md`` and ``stem.tex`` with the paper's rows; return the text table.

    The paper's rows are only there for the metric that the paper reports in Table I, the Hausdorff distance.
    """
    table = hd_table(metrics, metric)
    paper = paper_hd_table() if metric == "hd" and with_paper else paper_hd_table().iloc[:0]
    display, note = beside_paper(table, paper)
    if paper.empty:
        display = display[[name for name in display if name != "Data" and not (display[name] == "").all()]]
        note = note.split(" The paper's rows")[0]
    caption = caption or f"{METRICS[metric].title} of the methods"
    full = table.assign(data="this study").set_index("data", append=True)
    if not paper.empty:
        full = pd.concat([full.convert_dtypes(), paper.assign(data=PAPER_DATA).set_index("data", append=True)])
    write_text(stem.with_suffix(".csv"), full.to_csv(lineterminator="\n"))
    write_markdown(display, stem.with_suffix(".md"), caption, note)
    write_latex(display, stem.with_suffix(".tex"), caption, note)
    return display


def write_markdown(display: pd.DataFrame, path: Path, caption: str, note: str) -> None:
    """Write a text table as Markdown, its caption above and its note below."""
    body = display.to_markdown(index=False, disable_numparse=True)
    write_text(path, f"**{caption}**\n\n{body}\n\n{note}\n")


def write_latex(display: pd.DataFrame, path: Path, caption: str, note: str) -> None:
    """Write a text table as a LaTeX ``table`` (needs booktabs), its caption above and its note below."""
    columns = "ll" + "c" * (len(display.columns) - 2)
    body = display.to_latex(index=False, escape=True, column_format=columns).replace("±", r"$\pm$").replace("–", "--")
    escaped = note.replace("_", r"\_").replace("%", r"\%").replace("&", r"\&")
    write_text(
        path,
        f"\\begin{{table}}\n\\centering\n\\caption{{{caption}}}\n{body}\\par\\footnotesize {escaped}\n\\end{{table}}\n",
    )


def waypoint_summary(metrics: pd.DataFrame, *, with_paper: bool = True) -> pd.DataFrame:
    """Waypoint errors of each method over all CTs and waypoints (sec. IV-B), full precision.

    Returns:
        a row per metric and method: ``metric``, ``method``, ``mean``, ``sd`` (population), ``median``, ``max``,
        ``n_waypoints``, ``n_cases``, ``n_failed``, and where the paper reports it ``paper_mean``, ``paper_sd``
        (other data); without these two where ``with_paper`` is false.

    Raises:
        StudyError: several datasets, or no waypoint error in the rows.
    """
    _one_dataset(metrics)
    chosen = metrics[metrics["metric"].str.contains("waypoint_error")]
    if chosen.empty:
        raise StudyError(f"expected rows of waypoint errors, got {sorted(metrics['metric'].unique())}")
    failed = metrics[metrics["metric"] == CASE].groupby("method").size()
    paper = paper_waypoints()
    rows = []
    kinds, methods = chosen["metric"].unique(), in_order(metrics["method"])
    for metric in sorted(kinds, key=list(METRICS).index):
        for method in methods:
            mine = chosen[(chosen["metric"] == metric) & (chosen["method"] == method)]
            values = mine["value"].to_numpy()
            reported = metric == "waypoint_error" and method in paper.index
            rows.append(
                {
                    "metric": metric,
                    "method": method,
                    "mean": values.mean() if values.size else np.nan,
                    "sd": population_sd(values) if values.size else np.nan,
                    "median": np.median(values) if values.size else np.nan,
                    "max": values.max() if values.size else np.nan,
                    "n_waypoints": values.size,
                    "n_cases": len(mine.drop_duplicates(list(KEY[:5]))),
                    "n_failed": int(failed.get(method, 0)),
                    "paper_mean": paper["mean"].get(method) if reported else np.nan,
                    "paper_sd": paper["sd"].get(method) if reported else np.nan,
                }
            )
    table = pd.DataFrame(rows)
    return table if with_paper else table.drop(columns=["paper_mean", "paper_sd"])
