"""A run against a reference: the same rows, values and means within tolerance, the methods in the same order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from study.errors import StudyError
from study.evaluation.claims import CLAIMS
from study.evaluation.metrics import METRICS
from study.evaluation.pair import in_order
from study.results.metrics_csv import CASE, KEY, OK, read_metrics

ORDERED = ("hd", "waypoint_error", "true_waypoint_error")  # by which the methods are told to be in an order


@dataclass(frozen=True)
class Comparison:
    """A run against a reference.

    Attributes:
        methods: of either run.
        n_compared: rows found in both.
        missing: keys of rows that only the reference has.
        extra: keys of rows that only the candidate has.
        differences: rows in both that differ by more than their tolerance or in status, largest multiple first;
            columns as `KEY`, then ``reference``, ``candidate``, ``reference_status``, ``candidate_status``,
            ``difference``, ``tolerance``, ``times_tolerance``.
        means: of each method and metric over the rows in both, the largest multiple of its tolerance first; columns
            dataset, method, metric, reference, candidate, shift, tolerance, times_tolerance.
        upsets: a sentence for each order of methods and each claim's outcome that the candidate turns.
        largest: the largest difference of all compared rows as a multiple of its tolerance.
    """

    methods: tuple[str, ...]
    n_compared: int
    missing: pd.DataFrame
    extra: pd.DataFrame
    differences: pd.DataFrame
    means: pd.DataFrame
    upsets: tuple[str, ...]
    largest: float

    @property
    def shifts(self) -> pd.DataFrame:
        """Those of `means` that moved by more than the tolerance for means."""
        return self.means[self.means["times_tolerance"] > 1]

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
        lines = [f"compared {self.n_compared} rows"]
        for title, rows in (("only in the reference", self.missing), ("only in the candidate", self.extra)):
            if len(rows):
                lines += [f"{len(rows)} row(s) {title}:", *_listed(rows, n_largest)]
        if len(self.differences):
            lines += [
                f"{len(self.differences)} value(s) beyond tolerance:",
                *_listed(with_status(self.differences), n_largest),
            ]
        if len(self.shifts):
            lines += [f"{len(self.shifts)} mean(s) beyond tolerance:", *_listed(self.shifts, n_largest)]
        if self.upsets:
            lines += [f"{len(self.upsets)} order(s) or claim(s) turned:", *(f"  {told}" for told in self.upsets)]
        used = f"largest difference {self.largest:.3g} of its tolerance"
        return "\n".join([*lines, f"agrees; {used}" if self.agrees else "differs"])


def with_status(differences: pd.DataFrame, digits: str = "r") -> pd.DataFrame:
    """Differences to be read: a value that is not ok with its status, both as text.

    Args:
        differences: see `Comparison`.
        digits: format of a number; ``"r"`` for all of them.
    """
    told = {
        side: [
            (f"{value!r}" if digits == "r" else f"{value:{digits}}") + ("" if status == OK else f" ({status})")
            for value, status in zip(differences[side], differences[f"{side}_status"], strict=True)
        ]
        for side in ("reference", "candidate")
    }
    return differences.assign(**told).drop(columns=["reference_status", "candidate_status"])


def _listed(rows: pd.DataFrame, n: int) -> list[str]:
    shown = rows.head(n).to_string(index=False).splitlines()
    return [f"  {line}" for line in shown] + ([f"  ... and {len(rows) - n} more"] if len(rows) > n else [])


def compare(reference: Path, candidate: Path) -> Comparison:
    """Compare a run with a reference: the same rows; each value and each method's mean within tolerance; their order.

    Args:
        reference: a folder with ``metrics.csv``.
        candidate: another one; see `study.results.comparisons.compare_all` for folders of such folders.

    Raises:
        StudyError: what cannot be compared: a file that is missing, empty, unreadable or of another schema, in the
            reference or the candidate; runs of other data sets or seeds.
    """
    theirs, ours = (read_metrics(folder / "metrics.csv") for folder in (reference, candidate))
    expected, got = _about(theirs), _about(ours)
    if expected != got:
        raise StudyError(f"expected a run of {expected}, as {reference} is, got {got} in {candidate}")
    return _compare(theirs, ours)


def _about(metrics: pd.DataFrame) -> str:
    runs = metrics[["dataset", "seed"]].drop_duplicates().sort_values(["dataset", "seed"])
    return ", ".join(f"{name} at seed {seed}" for name, seed in runs.itertuples(index=False))


def _compare(reference: pd.DataFrame, candidate: pd.DataFrame) -> Comparison:
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
    sides = {"value_r": "reference", "value_c": "candidate"}
    sides |= {"status_r": "reference_status", "status_c": "candidate_status"}
    differences = differences.rename(columns=sides)
    return Comparison(
        methods=tuple(in_order([*reference["method"], *candidate["method"]])),
        n_compared=int((both["where"] == "both").sum()),
        missing=both.loc[both["where"] == "left_only", keys],
        extra=both.loc[both["where"] == "right_only", keys],
        differences=differences[[*keys, *sides.values(), "difference", "tolerance", "times_tolerance"]],
        means=_means(shared),
        upsets=tuple(_upsets(*(shared.rename(columns={f"value_{side}": "value"}) for side in ("r", "c")))),
        largest=float(shared["times_tolerance"].max()) if len(shared) else 0.0,
    )


def _means(shared: pd.DataFrame) -> pd.DataFrame:
    """Means of a method and metric on both sides, the largest multiple of their tolerance first."""
    means = shared.groupby(["dataset", "method", "metric"])[["value_r", "value_c"]].mean().reset_index()
    means = means.rename(columns={"value_r": "reference", "value_c": "candidate"})
    means["shift"] = means["candidate"] - means["reference"]
    means["tolerance"] = means["metric"].map({name: metric.mean_tolerance for name, metric in METRICS.items()})
    means["times_tolerance"] = means["shift"].abs() / means["tolerance"]
    return means.sort_values("times_tolerance", ascending=False, kind="stable")


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
