"""What `make evidence` leaves: its folders as an object, and the small tables that stand for runs of many people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd

from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.evaluation.pair import in_order
from study.files.places import CHECKOUT
from study.results.metrics_csv import CASE
from study.results.run import PAIR, Run

ROBUSTNESS, SENSITIVITY, PEOPLE = "robustness", "sensitivity", "people"
KEPT = CHECKOUT / "results" / "evidence"  # committed; without the runs that PEOPLE was made from
CASES = ["dataset", *PAIR, "method"]


def evidence_folder(profile: str, root: Path | None = None) -> Path:
    """Where `make evidence` writes, ``results/runs/evidence`` for the full profile."""
    results = (CHECKOUT if root is None else root) / "results"
    return results / "runs" / "evidence" if profile == "full" else results / "trials" / f"evidence-{profile}"


@dataclass(frozen=True)
class Evidence:
    """Robustness, sensitivity and more people, as their folders hold them.

    Attributes:
        folder: with the folders `ROBUSTNESS`, `SENSITIVITY` and `PEOPLE`.
    """

    folder: Path

    def table(self, part: str, name: str = "summary") -> pd.DataFrame:
        """A table of a part.

        Raises:
            StudyError: no such file, or not a table.
        """
        path = self.folder / part / f"{name}.csv"
        try:
            return pd.read_csv(path, encoding="utf-8")
        except (OSError, ValueError) as error:
            raise StudyError(f"expected a table at {path}, got: {error}; run `make evidence`") from error

    @cached_property
    def pairs(self) -> pd.DataFrame:
        """`pairs_table` of the runs behind `PEOPLE`."""
        return self.table(PEOPLE, "pairs")

    @property
    def datasets(self) -> list[str]:
        """Names of the data sets in `pairs`, in order."""
        return list(dict.fromkeys(self.pairs["dataset"]))

    def per_pair(self, dataset: str) -> pd.DataFrame:
        """Each metric's mean over a pair's values, as `Run.per_pair`: index metric, source, target; methods across."""
        rows = self.pairs[self.pairs["dataset"] == dataset].drop(columns=["dataset", "reason"])
        long = rows.melt([*PAIR, "method"], var_name="metric").dropna(subset="value")
        means = long.pivot(index=["metric", *PAIR], columns="method", values="value")
        return means[in_order(means.columns)]

    def refused(self, dataset: str) -> pd.DataFrame:
        """Pairs that gave no method a value: source, target and the reason."""
        rows = self.pairs[self.pairs["dataset"] == dataset]
        answered = rows.loc[rows["reason"].isna(), PAIR].apply(tuple, axis=1)
        lost = rows[~rows[PAIR].apply(tuple, axis=1).isin(set(answered))]
        return lost[[*PAIR, "reason"]].drop_duplicates(PAIR, ignore_index=True)


def pairs_table(runs: Sequence[Run]) -> pd.DataFrame:
    """Means over each pair's values: what is kept of runs whose ``metrics.csv`` is too large for a repository.

    Args:
        runs: one a data set.

    Returns:
        a row a case: ``dataset``, ``source``, ``target``, ``method``, ``reason`` (of a case that failed, else empty),
        and a column a metric, NaN where it has none.
    """
    tables = []
    for run in runs:
        means = run.values.groupby([*CASES, "metric"])["value"].mean().unstack("metric")
        lost = run.metrics[run.metrics["metric"] == CASE].set_index(CASES).index
        means = means.reindex(means.index.append(lost))
        reasons = run.failures.assign(dataset=run.dataset).set_index(CASES)["reason"]
        means.insert(0, "reason", reasons.reindex(means.index))
        tables.append(means)
    table = pd.concat(tables)
    columns = [name for name in METRICS if name in table.columns]
    return table[["reason", *columns]].reset_index()


def find_evidence(profile: str = "full", root: Path | None = None) -> Evidence | None:
    """What `make evidence` left here, or what is committed (full profile only), or None."""
    places = [evidence_folder(profile, root), *([KEPT] if profile == "full" else [])]
    whole = [place for place in places if all((place / part).is_dir() for part in (ROBUSTNESS, SENSITIVITY, PEOPLE))]
    return Evidence(whole[0]) if whole else None
