"""``metrics.csv`` and ``timings.csv``: one row is one number of one case.

A case that failed is one row with its reason. Files appear whole or not at all, and the same rows give the same bytes.
In the files the CT's column is called ``subject``, as since the first reference results; in memory a CT is ``source``.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.files.atomic import write_text

KEY = ("dataset", "source", "target", "method", "seed", "metric", "index")
COLUMNS = (*KEY, "value", "unit", "status")
TIMING_COLUMNS = ("dataset", "source", "target", "method", "seed", "stage", "seconds")

OK, NOT_CONVERGED, FAILED = "ok", "not converged", "failed: "
CASE = "case"  # the metric of a failed case's one row

Row = dict[str, Any]

_IN_FILE = {"source": "subject"}


@dataclass(frozen=True)
class Case:
    """One CT, one patient, one method, one seed: what a row of ``metrics.csv`` is about."""

    dataset: str
    source: str
    target: str
    method: str
    seed: int

    @property
    def key(self) -> Row:
        """Its columns."""
        return dict(zip(KEY[:5], astuple(self), strict=True))


def metric_rows(case: Case, values: Mapping[str, ArrayLike], *, converged: bool = True) -> list[Row]:
    """Rows of one case: a scalar has index 0, a sequence one row an entry, from 0.

    Raises:
        StudyError: a metric that is not in ``METRICS``, or a value that is not finite.
    """
    rows = []
    for metric, value in values.items():
        if metric not in METRICS:
            raise StudyError(
                f"expected a metric among {', '.join(METRICS)}, got {metric!r}; add it to study.evaluation.metrics"
            )
        numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
        if numbers.ndim != 1 or not np.isfinite(numbers).all():
            raise StudyError(
                f"{case.source}/{case.method}: expected finite {metric}, got {value!r}; write a failed row instead"
            )
        rows += [
            {
                **case.key,
                "metric": metric,
                "index": index,
                "value": float(number),
                "unit": str(METRICS[metric].unit),
                "status": OK if converged else NOT_CONVERGED,
            }
            for index, number in enumerate(numbers)
        ]
    return rows


def failed_row(case: Case, reason: str) -> Row:
    """The one row of a case that failed; of the reason, whatever cannot stand in a line of text is left out."""
    told = " ".join("".join(c if c.isprintable() else " " for c in reason).split())
    rest = {"metric": CASE, "index": 0, "value": float("nan"), "unit": "", "status": FAILED + told}
    return {**case.key, **rest}


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


def _header(columns: Sequence[str]) -> list[str]:
    """The columns as the file calls them."""
    return [_IN_FILE.get(name, name) for name in columns]


def _csv_text(header: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(_header(header))
    writer.writerows(lines)
    return buffer.getvalue()


def _parse_metrics(text: str, path: Path) -> pd.DataFrame:
    try:
        table = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
    except (pd.errors.EmptyDataError, pd.errors.ParserError) as error:
        raise StudyError(f"{path}: expected a table with columns {', '.join(_header(COLUMNS))}, got {error}") from error
    if list(table.columns) != _header(COLUMNS):
        raise StudyError(
            f"{path}: expected columns {', '.join(_header(COLUMNS))}, got {', '.join(table.columns)}; "
            "was it written by another version?"
        )
    table.columns = pd.Index(COLUMNS)
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
        "the metric's unit": failed
        | (table["unit"] == table["metric"].map({name: str(metric.unit) for name, metric in METRICS.items()})),
        "one row per " + ", ".join(_header(KEY)): ~table.duplicated(list(KEY)),
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


def read_timings(path: Path) -> pd.DataFrame:
    """Read ``timings.csv``; columns as `TIMING_COLUMNS`.

    Raises:
        StudyError: missing, or of another schema.
    """
    try:
        table = pd.read_csv(path, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise StudyError(f"expected {path}, got: {' '.join(str(error).split())}") from error
    if list(table.columns) != _header(TIMING_COLUMNS):
        raise StudyError(f"{path}: expected columns {', '.join(_header(TIMING_COLUMNS))}; was another version at work?")
    table.columns = pd.Index(TIMING_COLUMNS)
    return table
