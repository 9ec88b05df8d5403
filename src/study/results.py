"""Results on disk and as tables: ``metrics.csv``, ``provenance.json``, Table I, waypoints, and comparing runs.

One row of ``metrics.csv`` is one number of one case; a case that failed is one row with its reason. Files appear whole
or not at all, and the same rows give the same bytes.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from datetime import datetime
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from study.errors import StudyError
from study.methods import METHODS
from study.metrics import METRICS, TRUTH, population_sd

KEY = ("dataset", "subject", "target", "method", "seed", "metric", "index")
COLUMNS = (*KEY, "value", "unit", "status")
TIMING_COLUMNS = ("dataset", "subject", "target", "method", "seed", "stage", "seconds")

OK, NOT_CONVERGED, FAILED = "ok", "not converged", "failed: "
CASE = "case"  # the metric of a failed case's one row

ROOT = Path(__file__).parents[2]  # of a checkout
PAPER = ROOT / "results" / "paper"
RUNS = ROOT / "results" / "runs"
TRIALS = ROOT / "results" / "trials"
REFERENCE = ROOT / "results" / "reference"
CODE = ("src", "annotations", "data_manifest.yaml", "environment.lock")  # what decides a run's numbers
PAPER_DATA = "paper (other data)"

Row = dict[str, Any]


# ------------------------------------------------------------------------------------------------------------ files


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 with LF; see `write_bytes`."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file, a picture for one, through a temporary file: a killed run leaves the old file or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def metric_rows(
    dataset: str,
    subject: str,
    target: str,
    method: str,
    seed: int,
    values: Mapping[str, ArrayLike],
    *,
    converged: bool = True,
) -> list[Row]:
    """Rows of one case: a scalar has index 0, a sequence one row an entry, from 0.

    Raises:
        StudyError: a metric that is not in ``METRICS``, or a value that is not finite.
    """
    case = dict(zip(KEY[:5], (dataset, subject, target, method, int(seed)), strict=True))
    rows = []
    for metric, value in values.items():
        if metric not in METRICS:
            raise StudyError(f"expected a metric among {', '.join(METRICS)}, got {metric!r}; add it to study.metrics")
        numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
        if numbers.ndim != 1 or not np.isfinite(numbers).all():
            raise StudyError(f"{subject}/{method}: expected finite {metric}, got {value!r}; write a failed row instead")
        rows += [
            {
                **case,
                "metric": metric,
                "index": index,
                "value": float(number),
                "unit": METRICS[metric].unit,
                "status": OK if converged else NOT_CONVERGED,
            }
            for index, number in enumerate(numbers)
        ]
    return rows


def failed_row(dataset: str, subject: str, target: str, method: str, seed: int, reason: str) -> Row:
    """The one row of a case that failed."""
    case = dict(zip(KEY[:5], (dataset, subject, target, method, int(seed)), strict=True))
    rest = {"metric": CASE, "index": 0, "value": float("nan"), "unit": "", "status": FAILED + " ".join(reason.split())}
    return {**case, **rest}


def write_metrics(rows: Iterable[Row], path: Path) -> None:
    """Write ``metrics.csv``: sorted, full precision, LF.

    Raises:
        StudyError: no row, two rows of one key, or a row that is not of the schema.
    """
    rows = sorted(rows, key=lambda row: tuple(row[name] for name in KEY))
    lines = [[repr(v) if isinstance(v := row[name], float) and v == v else v for name in COLUMNS] for row in rows]
    lines = [["" if isinstance(v, float) else v for v in line] for line in lines]  # NaN of a failed case
    text = _csv_text(COLUMNS, lines)
    _parse_metrics(text, path)  # what cannot be read must not be written
    write_text(path, text)


def read_metrics(path: Path) -> pd.DataFrame:
    """Read ``metrics.csv``; columns as `COLUMNS`, NaN where a case failed.

    Raises:
        StudyError: missing, empty, unreadable, or of another schema.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise StudyError(f"expected {path}, got no such file; run `study run` or check the folder") from error
    except (OSError, UnicodeDecodeError) as error:
        raise StudyError(f"expected a readable UTF-8 file at {path}, got {error}") from error
    return _parse_metrics(text, path)


def _csv_text(header: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(lines)
    return buffer.getvalue()


def _parse_metrics(text: str, path: Path) -> pd.DataFrame:
    try:
        table = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
    except (pd.errors.EmptyDataError, pd.errors.ParserError) as error:
        raise StudyError(f"{path}: expected a table with columns {', '.join(COLUMNS)}, got {error}") from error
    if tuple(table.columns) != COLUMNS:
        raise StudyError(
            f"{path}: expected columns {', '.join(COLUMNS)}, got {', '.join(table.columns)}; "
            "was it written by another version?"
        )
    if table.empty:
        raise StudyError(f"{path}: expected at least one row, got only a header; did the run end early?")
    failed = table["status"].str.startswith(FAILED)
    try:
        table = table.astype({"seed": np.int64, "index": np.int64})
        table["value"] = [float(value) if value else np.nan for value in table["value"]]
    except ValueError as error:
        raise StudyError(f"{path}: expected numbers in seed, index and value, got {error}") from error
    checks = {
        "a known metric": table["metric"].isin([*METRICS, CASE]),
        "a status of ok, not converged or failed: reason": failed | table["status"].isin([OK, NOT_CONVERGED]),
        "a finite value exactly where the case did not fail": np.isfinite(table["value"]) != failed,
        "metric 'case' exactly where the case failed": (table["metric"] == CASE) == failed,
        "the metric's unit": failed | (table["unit"] == table["metric"].map({m: METRICS[m].unit for m in METRICS})),
        "one row per " + ", ".join(KEY): ~table.duplicated(list(KEY)),
    }
    for expected, holds in checks.items():
        if not holds.all():
            first = int(np.flatnonzero(~holds.to_numpy())[0])
            got = ",".join(str(value) for value in table.iloc[first])
            raise StudyError(f"{path}, line {first + 2}: expected {expected}, got {got}")
    return table


def write_timings(rows: Iterable[Row], path: Path) -> None:
    """Write ``timings.csv``; apart from the metrics, since times differ from run to run."""
    rows = sorted(rows, key=lambda row: tuple(row[name] for name in TIMING_COLUMNS[:-1]))
    write_text(path, _csv_text(TIMING_COLUMNS, [[row[name] for name in TIMING_COLUMNS] for row in rows]))


def provenance(
    parameters: Mapping[str, Any],
    seed: int,
    inputs: Mapping[str, str],
    started: datetime,
    finished: datetime,
    root: Path = ROOT,
) -> dict[str, Any]:
    """Where a run's numbers come from.

    Args:
        parameters: every parameter of the run; dataclasses are taken apart.
        seed: the run's seed.
        inputs: SHA-256 of each input file by name.
        started, finished: wall-clock times with a time zone.
        root: the checkout, for its commit and lock file.
    """
    lock = root / "environment.lock"
    return {
        "commit": _git(root, "rev-parse", "HEAD"),
        # Results are written inside the checkout and say nothing about the code.
        "uncommitted_changes": _git(root, "status", "--porcelain", "--", ".", ":!results", ":!notebooks"),
        "code_sha256": code_sha256(root),
        "lock_sha256": sha256_of(lock) if lock.is_file() else None,
        "inputs_sha256": dict(inputs),
        "parameters": dict(parameters),
        "seed": seed,
        "versions": _versions(),
        "machine": {
            "platform": platform.platform(),
            "architecture": platform.machine(),
            "processor": _processor(),
            "cores": os.cpu_count(),
        },
        "started": started.isoformat(timespec="seconds"),
        "finished": finished.isoformat(timespec="seconds"),
        "seconds": (finished - started).total_seconds(),
    }


def code_sha256(root: Path = ROOT) -> str:
    """One SHA-256 of every file that decides a run's numbers: package, annotations, manifest and lock."""
    found = [path for name in CODE for path in (root / name, *(root / name).rglob("*")) if path.is_file()]
    files = sorted(path.relative_to(root).as_posix() for path in found if "__pycache__" not in path.parts)
    lines = [f"{sha256_of(root / name)}  {name}\n" for name in files]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def run_folder(dataset: str, profile: str, seed: int) -> Path:
    """Where the run of a dataset is kept; what is not the whole study at seed 0 stays apart from it."""
    return RUNS / dataset if (profile, seed) == ("full", 0) else TRIALS / f"{dataset}-{profile}-seed{seed}"


def why_stale(folder: Path, parameters: Mapping[str, Any], seed: int, root: Path = ROOT) -> str | None:
    """Why the run in a folder cannot stand for a run made now; None when it can.

    Args:
        folder: with ``metrics.csv`` and ``provenance.json``.
        parameters: as given to `provenance`.
        seed: the run's seed.
        root: the checkout whose code would run.
    """
    if not (folder / "metrics.csv").is_file():
        return "there is no run yet"
    try:
        before = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        return f"its provenance.json cannot be read: {error}"
    now = {"code_sha256": code_sha256(root), "seed": seed, "parameters": json.loads(_json(parameters))}
    words = {"code_sha256": "the code", "seed": "the seed", "parameters": "a parameter or the list of methods"}
    changed = [words[name] for name, value in now.items() if before.get(name) != value]
    return f"since it was made, {' and '.join(changed)} changed" if changed else None


def _json(content: Mapping[str, Any]) -> str:
    return json.dumps(content, indent=2, sort_keys=True, allow_nan=False, default=_plain) + "\n"


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write JSON with sorted keys; numpy values, paths and dataclasses are taken apart."""
    write_text(path, _json(content))


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, Path):
        return value.as_posix()
    raise TypeError(f"cannot write {type(value).__name__} as JSON")


def _git(root: Path, *arguments: str) -> str | None:
    """Output of git, or None outside a checkout."""
    try:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _versions() -> dict[str, str]:
    """Python and the installed versions of the package and what it requires."""
    try:
        lines = [line for line in requires("study") or () if "extra ==" not in line]
        required = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in lines]
    except PackageNotFoundError:
        required = []
    found = {"python": platform.python_version()}
    for name in ("study", *required):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # of another platform
            continue
    return found


def _processor() -> str:
    try:
        names = re.findall(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except OSError:
        names = []
    return names[0] if names else platform.processor()


# ----------------------------------------------------------------------------------------------------------- tables


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key that puts ct2 before ct10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _in_order(methods: Iterable[str]) -> list[str]:
    """Each method once, as ``METHODS`` lists them, those it does not know last."""
    known = list(METHODS)
    return sorted(dict.fromkeys(methods), key=lambda name: known.index(name) if name in known else len(known))


def _one_dataset(metrics: pd.DataFrame) -> None:
    datasets = sorted(metrics["dataset"].unique())
    if len(datasets) != 1:
        raise StudyError(f"expected rows of one dataset for a table, got {datasets}; select one")


def hd_table(metrics: pd.DataFrame, metric: str = "hd") -> pd.DataFrame:
    """A metric of each method on each subject, in the shape of the paper's Table I; full precision.

    Args:
        metrics: rows of one dataset, as `read_metrics` gives them.
        metric: also any other of ``METRICS``; several values of a subject (waypoints, seeds, targets) are averaged.

    Returns:
        index method, in the order of ``METHODS``; a column per subject, NaN where it failed, then ``mean``, ``sd``
        (population, over subjects), ``n`` (subjects with a value), ``n_failed`` and ``n_not_converged`` (cases).

    Raises:
        StudyError: several datasets, or no row of that metric.
    """
    _one_dataset(metrics)
    chosen = metrics[metrics["metric"] == metric]
    failed = metrics[metrics["metric"] == CASE]
    if chosen.empty and failed.empty:
        raise StudyError(f"expected rows of metric {metric!r}, got {sorted(metrics['metric'].unique())}")
    cases = pd.concat([chosen, failed])
    methods = _in_order(cases["method"])
    subjects = sorted(cases["subject"].unique(), key=_natural)
    table = chosen.pivot_table(index="method", columns="subject", values="value", aggfunc="mean")
    table = table.reindex(index=methods, columns=subjects).rename_axis(columns=None)
    values = table.to_numpy()
    some = [row[np.isfinite(row)] for row in values]
    table["mean"] = [row.mean() if row.size else np.nan for row in some]
    table["sd"] = [population_sd(row) if row.size else np.nan for row in some]
    table["n"] = [row.size for row in some]
    stuck = chosen[chosen["status"] == NOT_CONVERGED].drop_duplicates(list(KEY[:5]))
    for name, rows in (("n_failed", failed), ("n_not_converged", stuck)):
        table[name] = rows.groupby("method").size().reindex(methods, fill_value=0).astype(np.int64)
    return table


def paper_hd_table(path: Path = PAPER / "table1.csv") -> pd.DataFrame:
    """The paper's Table I as printed: index method, columns ``CT 1`` to ``CT 5``, ``mean``, ``sd``, ``n``, notes."""
    return _paper(path)


def paper_waypoints(path: Path = PAPER / "waypoints.csv") -> pd.DataFrame:
    """The paper's waypoint errors as printed (sec. IV-B): index method, columns ``mean``, ``sd``, ``n``, ``notes``."""
    return _paper(path)


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
    subjects = list(table.columns[: table.columns.get_loc("mean")])
    theirs = [name for name in paper.columns if name.startswith("CT ")]
    columns = [f"CT {k + 1}" for k in range(max(len(subjects), len(theirs)))]
    rows = []
    for method, row in table.iterrows():
        empty = "failed" if row["n_failed"] else "–"
        cells = [_mm(row[name], empty) for name in subjects]
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
    names = ", ".join(f"CT {k + 1} = {name}" for k, name in enumerate(subjects))
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


def write_hd_table(metrics: pd.DataFrame, stem: Path, metric: str = "hd", caption: str | None = None) -> pd.DataFrame:
    """Write ``stem.csv`` (full precision), ``stem.md`` and ``stem.tex`` with the paper's rows; return the text table.

    The paper's rows are only there for the metric that the paper reports in Table I, the Hausdorff distance.
    """
    table = hd_table(metrics, metric)
    paper = paper_hd_table() if metric == "hd" else paper_hd_table().iloc[:0]
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


def waypoint_summary(metrics: pd.DataFrame) -> pd.DataFrame:
    """Waypoint errors of each method over all subjects and waypoints (sec. IV-B), full precision.

    Returns:
        a row per metric and method: ``metric``, ``method``, ``mean``, ``sd`` (population), ``median``, ``max``,
        ``n_waypoints``, ``n_cases``, ``n_failed``, and where the paper reports it ``paper_mean``, ``paper_sd``
        (other data).

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
    kinds, methods = chosen["metric"].unique(), _in_order(metrics["method"])
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
    return pd.DataFrame(rows)


# -------------------------------------------------------------------------------------------------------- comparing


@dataclass(frozen=True)
class Comparison:
    """A run against a reference.

    Attributes:
        n_files: pairs of ``metrics.csv`` compared.
        n_compared: rows found in both.
        missing: keys of rows that only the reference has.
        extra: keys of rows that only the candidate has.
        differences: rows in both that differ by more than their tolerance or in status, largest multiple first;
            columns as `KEY`, then ``reference``, ``candidate``, ``difference``, ``tolerance``, ``times_tolerance``.
        largest: the largest difference of all compared rows as a multiple of its tolerance.
    """

    n_files: int
    n_compared: int
    missing: pd.DataFrame
    extra: pd.DataFrame
    differences: pd.DataFrame
    largest: float

    @property
    def agrees(self) -> bool:
        """Same rows, and every value within its tolerance."""
        return not (len(self.missing) or len(self.extra) or len(self.differences))

    @property
    def exit_code(self) -> int:
        """0 agrees, 1 differs; what cannot be compared raised a StudyError, which the command line makes 2."""
        return 0 if self.agrees else 1

    def report(self, n_largest: int = 10) -> str:
        """What was compared, then what differs, the largest differences first."""
        lines = [f"compared {self.n_compared} rows of {self.n_files} file(s)"]
        for title, rows in (("only in the reference", self.missing), ("only in the candidate", self.extra)):
            if len(rows):
                lines += [f"{len(rows)} row(s) {title}:", *_listed(rows, n_largest)]
        if len(self.differences):
            lines += [f"{len(self.differences)} value(s) beyond tolerance:", *_listed(self.differences, n_largest)]
        used = f"largest difference {self.largest:.3g} of its tolerance"
        return "\n".join([*lines, f"agrees; {used}" if self.agrees else "differs"])


def _listed(rows: pd.DataFrame, n: int) -> list[str]:
    shown = rows.head(n).to_string(index=False).splitlines()
    return [f"  {line}" for line in shown] + ([f"  ... and {len(rows) - n} more"] if len(rows) > n else [])


def compare(reference: Path, candidate: Path) -> Comparison:
    """Compare a run with a reference: the same rows, then each value within its metric's tolerance.

    Args:
        reference: a folder with ``metrics.csv``, or with one such folder per dataset.
        candidate: the same layout.

    Raises:
        StudyError: what cannot be compared: a file that is missing, empty, unreadable or of another schema, in the
            reference or the candidate.
    """
    names = _metrics_files(reference)
    if not names:
        raise StudyError(f"expected metrics.csv in {reference} or in its folders, got none; check the path")
    found = _metrics_files(candidate)
    lacking, unknown = sorted(set(names) - set(found)), sorted(set(found) - set(names))
    if lacking or unknown:
        raise StudyError(
            f"expected the same metrics.csv files in both folders, got {_names(lacking)} only in {reference} and "
            f"{_names(unknown)} only in {candidate}; run the same datasets"
        )
    tables = [(read_metrics(reference / name), read_metrics(candidate / name)) for name in names]
    theirs, ours = (pd.concat(column, ignore_index=True) for column in zip(*tables, strict=True))
    return _compare(theirs, ours, len(names))


def _names(paths: list[Path]) -> str:
    return ", ".join(path.as_posix() for path in paths) or "nothing"


def _metrics_files(folder: Path) -> list[Path]:
    if (folder / "metrics.csv").is_file():
        return [Path("metrics.csv")]
    return sorted(path.relative_to(folder) for path in folder.glob("*/metrics.csv"))


def _compare(reference: pd.DataFrame, candidate: pd.DataFrame, n_files: int) -> Comparison:
    keys = list(KEY)
    both = reference.merge(candidate, on=keys, how="outer", suffixes=("_r", "_c"), indicator="where")
    shared = both[both["where"] == "both"]
    # A case that failed in both agrees, whatever the words of the reason; a case that failed in one lacks rows.
    shared = shared[shared["metric"] != CASE].copy()
    shared["tolerance"] = shared["metric"].map({name: metric.tolerance for name, metric in METRICS.items()})
    shared["difference"] = (shared["value_c"] - shared["value_r"]).abs()
    shared["times_tolerance"] = shared["difference"] / shared["tolerance"]
    changed = (shared["times_tolerance"] > 1) | (shared["status_r"] != shared["status_c"])
    differences = shared[changed].sort_values("times_tolerance", ascending=False, kind="stable")
    for side, name in (("r", "reference"), ("c", "candidate")):
        pairs = zip(differences[f"value_{side}"], differences[f"status_{side}"], strict=True)
        differences[name] = [f"{value!r}" + ("" if status == OK else f" ({status})") for value, status in pairs]
    return Comparison(
        n_files=n_files,
        n_compared=int((both["where"] == "both").sum()),
        missing=both.loc[both["where"] == "left_only", keys],
        extra=both.loc[both["where"] == "right_only", keys],
        differences=differences[[*keys, "reference", "candidate", "difference", "tolerance", "times_tolerance"]],
        largest=float(shared["times_tolerance"].max()) if len(shared) else 0.0,
    )
