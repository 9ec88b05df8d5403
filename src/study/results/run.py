"""A results folder as an object: metrics, timings, provenance, failures, tables, whether it is of now."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd

from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.evaluation.pair import TRUTH, in_order
from study.files.atomic import json_text, write_bytes, write_json
from study.files.places import CHECKOUT
from study.results.compare import Comparison, compare
from study.results.metrics_csv import (
    CASE,
    FAILED,
    Row,
    read_metrics,
    read_timings,
    write_metrics,
    write_timings,
)
from study.results.provenance import code_sha256, provenance
from study.results.tables import hd_table, mean_sd_table, waypoint_summary, write_tables

REFERENCE = CHECKOUT / "results" / "reference"
PAIR = ["source", "target"]


def run_folder(
    dataset: str, profile: str, seed: int, methods: Sequence[str] | None = None, root: Path | None = None
) -> Path:
    """Where the run of a data set is kept; only the whole study at seed 0 goes where the reference is made from.

    Args:
        dataset: its name.
        profile: ``"full"`` or another one.
        seed: of the run.
        methods: those run; all when None.
        root: the folder that holds ``results``; the checkout when None.
    """
    results = (CHECKOUT if root is None else root) / "results"
    if (profile, seed, methods) == ("full", 0, None):
        return results / "runs" / dataset
    those = "" if methods is None else f"-{'+'.join(methods)}"
    return results / "trials" / f"{dataset}-{profile}-seed{seed}{those}"


@dataclass(frozen=True)
class Run:
    """One data set, run and judged, as its folder holds it.

    Attributes:
        folder: with ``metrics.csv``, ``timings.csv``, ``provenance.json``, tables and figures.
        origin: a sentence that says whether it was loaded or made now, and why.
    """

    folder: Path
    origin: str = "loaded"

    @cached_property
    def metrics(self) -> pd.DataFrame:
        """Every row of ``metrics.csv``, see `read_metrics`.

        Raises:
            StudyError: a file that is missing, or not one of this version's.
        """
        return read_metrics(self.folder / "metrics.csv")

    @cached_property
    def timings(self) -> pd.DataFrame:
        """Seconds of every step, see `read_timings`."""
        return read_timings(self.folder / "timings.csv")

    @cached_property
    def provenance(self) -> Mapping[str, Any]:
        """What made it: code, inputs, parameters, versions, machine, times.

        Raises:
            StudyError: no such file, or not JSON.
        """
        path = self.folder / "provenance.json"
        try:
            return dict(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise StudyError(f"expected {path}, got: {' '.join(str(error).split())}; run the data set again") from error

    @property
    def dataset(self) -> str:
        """Name of the data set.

        Raises:
            StudyError: rows of several.
        """
        names = sorted(self.metrics["dataset"].unique())
        if len(names) != 1:
            raise StudyError(f"{self.folder}: expected rows of one dataset, got {', '.join(names)}")
        return str(names[0])

    @property
    def values(self) -> pd.DataFrame:
        """The rows of `metrics` that are numbers: without the cases that failed."""
        return self.metrics[self.metrics["metric"] != CASE]

    @property
    def failures(self) -> pd.DataFrame:
        """A row for each case that failed: source, target, method and the reason."""
        rows = self.metrics[self.metrics["metric"] == CASE]
        rows = rows.assign(reason=rows["status"].str.removeprefix(FAILED))
        return rows[[*PAIR, "method", "reason"]].reset_index(drop=True)

    @property
    def methods(self) -> list[str]:
        """Methods run, in the order of ``METHODS``; `TRUTH` last where the truth is known."""
        return in_order(self.metrics["method"])

    @property
    def has_truth(self) -> bool:
        """Whether the deformation between its people is known."""
        return TRUTH in set(self.metrics["method"])

    @property
    def n_pairs(self) -> int:
        """Pairs of a CT and a patient."""
        return len(self.metrics.drop_duplicates(PAIR))

    @property
    def per_pair(self) -> pd.DataFrame:
        """Each metric's mean over a pair's values: index metric, source, target; a column a method."""
        means = self.values.groupby(["metric", *PAIR, "method"])["value"].mean().unstack("method")
        return means[in_order(means.columns)]

    def by_column(self) -> pd.DataFrame:
        """`metrics` with what Table I has as columns in ``source``: the CTs, or the patients of a single CT."""
        one_ct = self.metrics["source"].nunique() == 1
        return self.metrics.assign(source=self.metrics["target"]) if one_ct else self.metrics

    def hd_table(self, metric: str = "hd") -> pd.DataFrame:
        """A metric in the shape of Table I, see `study.results.tables.hd_table`."""
        return hd_table(self.by_column(), metric)

    def waypoint_summary(self) -> pd.DataFrame:
        """Waypoint errors of each method, see `study.results.tables.waypoint_summary`."""
        return waypoint_summary(self.metrics)

    def summary(self) -> pd.DataFrame:
        """Every metric of every method as text, mean ± population SD over the pairs (n)."""
        return mean_sd_table(self.per_pair)

    def overview(self) -> pd.Series:
        """What it is, in a few lines for a reader."""
        cases = self.metrics.drop_duplicates([*PAIR, "method"])
        folder = self.folder.relative_to(CHECKOUT) if self.folder.is_relative_to(CHECKOUT) else self.folder
        lines = {
            "from": self.origin,
            "folder": folder.as_posix(),
            "commit": str(self.provenance["commit"] or "none")[:10],
            "finished": self.provenance["finished"],
            "seconds": round(self.provenance["seconds"]),
            "CTs": self.metrics["source"].nunique(),
            "patients": self.metrics["target"].nunique(),
            "pairs": self.n_pairs,
            "methods": ", ".join(self.methods),
            "cases": len(cases),
            "cases that failed": len(self.failures),
            "rows": len(self.metrics),
        }
        return pd.Series(lines, name=self.dataset)

    def why_stale(self, parameters: Mapping[str, Any], seed: int, root: Path | None = None) -> str | None:
        """Why this run cannot stand for one made now; None when it can.

        Args:
            parameters: as given to `write_run`.
            seed: of the run.
            root: the checkout whose code would run; the running code's when None.
        """
        if not (self.folder / "metrics.csv").is_file():
            return "there is no run yet"
        try:
            before = self.provenance
        except StudyError as error:
            return f"its provenance.json cannot be read: {error}"
        now = {"code_sha256": code_sha256(root), "seed": seed, "parameters": json.loads(json_text(parameters))}
        words = {"code_sha256": "the code", "seed": "the seed", "parameters": "a parameter or the list of methods"}
        changed = [words[name] for name, value in now.items() if before.get(name) != value]
        return f"since it was made, {' and '.join(changed)} changed" if changed else None

    def compare(self, candidate: Run) -> Comparison:
        """Another run against this one as the reference, see `study.results.compare.compare`."""
        return compare(self.folder, candidate.folder)

    def tables(self) -> list[Path]:
        """The Markdown tables beside the metrics."""
        return sorted(self.folder.glob("hd_table*.md"))

    def keep_figures(self, pictures: Mapping[str, bytes]) -> list[str]:
        """Write PNG pictures beside the metrics; their file names."""
        return keep_pictures(self.folder, pictures)

    def _repr_html_(self) -> str:
        """A few lines and one small picture, for a notebook."""
        means = self.per_pair.groupby(level="metric").mean()
        table = means.loc[["hd", "waypoint_error"]].T.rename_axis(index=None, columns="mean over pairs, mm")
        table.columns = pd.Index([METRICS["hd"].title, METRICS["waypoint_error"].title])
        picture = self.folder / "waypoints.png"
        image = ""
        if picture.is_file():
            data = b64encode(picture.read_bytes()).decode()
            image = (
                f'<img alt="waypoint errors of {escape(self.dataset)}" width="420" src="data:image/png;base64,{data}">'
            )
        return (
            f"<p><b>{escape(self.dataset)}</b>: {self.n_pairs} pairs, {len(self.methods)} methods, "
            f"{len(self.failures)} cases failed; {escape(self.origin)}</p>"
            f"{table.round(2).to_html()}{image}"
        )


def write_run(
    folder: Path,
    rows: Sequence[Row],
    timings: Sequence[Row],
    parameters: Mapping[str, Any],
    seed: int,
    inputs: Mapping[str, str],
    started: datetime,
) -> Run:
    """Write metrics, timings, provenance and tables of a run that has just ended.

    Args:
        folder: where to.
        rows: of ``metrics.csv``.
        timings: of ``timings.csv``.
        parameters: everything that decides the numbers but seed and code.
        seed: of the run.
        inputs: SHA-256 of each input file by name.
        started: wall-clock time with a time zone.

    Raises:
        StudyError: rows that are not of the schema, or no case that succeeded; the rows with the reasons are written.
    """
    write_metrics(rows, folder / "metrics.csv")
    write_timings(timings, folder / "timings.csv")
    write_json(provenance(parameters, seed, inputs, started, datetime.now(UTC)), folder / "provenance.json")
    run = Run(folder)
    write_tables(run.metrics, folder)
    if run.values.empty:
        raise StudyError(f"{run.dataset}: every case failed: {' | '.join(sorted(set(run.failures['reason'])))}")
    return run


def find_runs(folder: Path) -> list[Run]:
    """Every run below a folder, by path.

    Raises:
        StudyError: none.
    """
    found = sorted(path.parent for path in folder.rglob("metrics.csv"))
    if not found:
        raise StudyError(f"{folder}: expected runs with a metrics.csv below it, got none; run `study run` first")
    return [Run(path) for path in found]


def newest(dataset: str, profile: str, seed: int) -> Run | None:
    """The run of a data set, or the committed reference (full profile at seed 0 only), or None."""
    places = [run_folder(dataset, profile, seed)]
    places += [REFERENCE / dataset] if (profile, seed) == ("full", 0) else []
    found = [place for place in places if (place / "metrics.csv").is_file()]
    return Run(found[0]) if found else None


def keep_pictures(folder: Path, pictures: Mapping[str, bytes]) -> list[str]:
    """Write PNG pictures into a folder; their file names."""
    for name, content in pictures.items():
        write_bytes(folder / f"{name}.png", content)
    return [f"{name}.png" for name in pictures]


def against_reference(run: Run, *, comparable: bool) -> str:
    """What `study compare` says of a run and the committed reference, in words.

    Args:
        run: of a reported data set.
        comparable: whether it is of the full profile and seed 0, as the reference is.
    """
    if run.folder == REFERENCE / run.dataset:
        return "this is the reference: no run of its own to compare"
    if not comparable:
        return "the reference is of the full profile and seed 0: not comparable"
    try:
        return Run(REFERENCE / run.dataset).compare(run).report()
    except StudyError as error:
        return f"no comparison: {error}".replace(f"{CHECKOUT.as_posix()}/", "")
