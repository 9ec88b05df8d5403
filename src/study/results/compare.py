"""A run against a reference: the same rows, values and means within tolerance, the methods in the same order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from study.errors import StudyError
from study.evaluation.claims import CLAIMS
from study.evaluation.metrics import METRICS
from study.results.metrics_csv import CASE, KEY, OK, read_metrics

ORDERED = ("hd", "waypoint_error", "true_waypoint_error")  # by which the methods are told to be in an order


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
        shifts: methods whose mean of a metric differs by more than the tolerance for means, over the rows in both;
            columns dataset, method, metric, reference, candidate, shift, tolerance, times_tolerance.
        upsets: a sentence for each order of methods and each claim's outcome that the candidate turns.
        largest: the largest difference of all compared rows as a multiple of its tolerance.
    """

    n_files: int
    n_compared: int
    missing: pd.DataFrame
    extra: pd.DataFrame
    differences: pd.DataFrame
    shifts: pd.DataFrame
    upsets: tuple[str, ...]
    largest: float

    @property
    def agrees(self) -> bool:
        """Same rows, every value and mean within its tolerance, the methods in the same order."""
        found = (self.missing, self.extra, self.differences, self.shifts, self.upsets)
        return not any(len(rows) for rows in found)

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
        if len(self.shifts):
            lines += [f"{len(self.shifts)} mean(s) beyond tolerance:", *_listed(self.shifts, n_largest)]
        if self.upsets:
            lines += [f"{len(self.upsets)} order(s) or claim(s) turned:", *(f"  {told}" for told in self.upsets)]
        used = f"largest difference {self.largest:.3g} of its tolerance"
        return "\n".join([*lines, f"agrees; {used}" if self.agrees else "differs"])


def _listed(rows: pd.DataFrame, n: int) -> list[str]:
    shown = rows.head(n).to_string(index=False).splitlines()
    return [f"  {line}" for line in shown] + ([f"  ... and {len(rows) - n} more"] if len(rows) > n else [])


def compare(reference: Path, candidate: Path) -> Comparison:
    """Compare a run with a reference: the same rows; each value and each method's mean within tolerance; their order.

    Args:
        reference: a folder with ``metrics.csv``, or with one such folder per dataset.
        candidate: the same layout.

    Raises:
        StudyError: what cannot be compared: a file that is missing, empty, unreadable or of another schema, in the
            reference or the candidate; runs of other data sets or seeds.
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
    expected, got = _about(theirs), _about(ours)
    if expected != got:
        raise StudyError(f"expected a run of {expected}, as {reference} is, got {got} in {candidate}")
    return _compare(theirs, ours, len(names))


def _names(paths: list[Path]) -> str:
    return ", ".join(path.as_posix() for path in paths) or "nothing"


def _about(metrics: pd.DataFrame) -> str:
    runs = metrics[["dataset", "seed"]].drop_duplicates().sort_values(["dataset", "seed"])
    return ", ".join(f"{name} at seed {seed}" for name, seed in runs.itertuples(index=False))


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
    shifts = _shifts(shared)
    return Comparison(
        n_files=n_files,
        n_compared=int((both["where"] == "both").sum()),
        missing=both.loc[both["where"] == "left_only", keys],
        extra=both.loc[both["where"] == "right_only", keys],
        differences=differences[[*keys, "reference", "candidate", "difference", "tolerance", "times_tolerance"]],
        shifts=shifts,
        upsets=tuple(_upsets(*(shared.rename(columns={f"value_{side}": "value"}) for side in ("r", "c")))),
        largest=float(shared["times_tolerance"].max()) if len(shared) else 0.0,
    )


def _shifts(shared: pd.DataFrame) -> pd.DataFrame:
    """Means of a method and metric that moved by more than the tolerance for means, the largest multiple first."""
    means = shared.groupby(["dataset", "method", "metric"])[["value_r", "value_c"]].mean().reset_index()
    means = means.rename(columns={"value_r": "reference", "value_c": "candidate"})
    means["shift"] = means["candidate"] - means["reference"]
    means["tolerance"] = means["metric"].map({name: metric.mean_tolerance for name, metric in METRICS.items()})
    means["times_tolerance"] = means["shift"].abs() / means["tolerance"]
    return means[means["times_tolerance"] > 1].sort_values("times_tolerance", ascending=False, kind="stable")


def _upsets(reference: pd.DataFrame, candidate: pd.DataFrame) -> Iterator[str]:
    """What a reader is told of the order of the methods, where the candidate tells it otherwise."""
    for name in reference["dataset"].unique():
        theirs, ours = (table[table["dataset"] == name] for table in (reference, candidate))
        for metric in ORDERED:
            before, after = (_order(table[table["metric"] == metric]) for table in (theirs, ours))
            if before != after:
                yield f"{name}, {metric}: by mean {' < '.join(before)}; now {' < '.join(after)}"
        for claim in CLAIMS:
            was, is_now = claim.outcome(theirs), claim.outcome(ours)
            if was != is_now:
                yield f"{name}, {claim.text}: {was}; now {is_now}"


def _order(rows: pd.DataFrame) -> list[str]:
    """Methods by their mean over the pairs, the smallest first."""
    pairs = rows.groupby(["method", "source", "target"])["value"].mean()
    return list(pairs.groupby("method").mean().sort_values(kind="stable").index)
