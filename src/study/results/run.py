"""A results folder as an object: metrics, timings, provenance, failures, tables, whether it is of now."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd

from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.evaluation.pair import TRUTH, in_order
from study.files.atomic import json_text, sha256_of, write_bytes, write_json, write_text
from study.files.places import CHECKOUT
from study.naming import split_sweep
from study.results.claim import PROVENANCE, Claim, claimed
from study.results.clouds import CLOUDS, CaseName, Clouds, write_clouds
from study.results.compare import Comparison, compare
from study.results.crate import seal
from study.results.metrics_csv import (
    CASE,
    FAILED,
    Row,
    read_metrics,
    read_timings,
    write_metrics,
    write_timings,
)
from study.results.provenance import code_sha256
from study.results.tables import hd_table, mean_sd_table, waypoint_summary, write_tables

REFERENCE = CHECKOUT / "results" / "reference"
PAIR = ["source", "target"]
FAILURES_LOG = "failures.log"  # of a run with cases that failed in a way nobody foresaw: where in the code


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
    def own_manifest(self) -> bool:
        """Whether its people are of a manifest of one's own: the paper's numbers are not put beside them."""
        return bool(self.provenance.get("own_manifest", False))

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
        return waypoint_summary(self.metrics, with_paper=not self.own_manifest)

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
            "patients": self.metrics["target"].map(lambda name: split_sweep(name)[0]).nunique(),
            "pairs": self.n_pairs,
            "methods": ", ".join(self.methods),
            "cases": len(cases),
            "cases that failed": len(self.failures),
            "rows": len(self.metrics),
        }
        return pd.Series(lines, name=self.dataset)

    @property
    def altered(self) -> str | None:
        """What of the folder is not as the run left it, as the end of a sentence about it; None when all is.

        Raises:
            StudyError: no provenance that can be read.
        """
        files = self.provenance.get("files_sha256")
        if not isinstance(files, dict):
            return "was made by an older version, whose provenance does not hold the hashes of its files"
        paths = {self.folder / name: sha256 for name, sha256 in files.items()}
        missing = [path.name for path in paths if not path.is_file()]
        changed = [path.name for path, sha256 in paths.items() if path.is_file() and sha256_of(path) != sha256]
        told = [f"{what} {', '.join(names)}" for what, names in (("lost", missing), ("edited", changed)) if names]
        return f"has since been altered: {'; '.join(told)}" if told else None

    @property
    def condition(self) -> str | None:
        """`altered`, or why that can't be told, as the end of a sentence about the run; None when all is well."""
        try:
            return self.altered
        except StudyError as error:
            return f"cannot be told from an altered one: {error}"

    def why_stale(
        self,
        dataset: str,
        parameters: Mapping[str, Any],
        seed: int,
        inputs: Mapping[str, str] | None = None,
        root: Path | None = None,
    ) -> str | None:
        """Why this run cannot stand for one made now; None when it can.

        Args:
            dataset: its name.
            parameters: as given to `study.results.provenance.provenance`.
            seed: of the run.
            inputs: SHA-256 of the input files that are here, by name; the others are taken to be as they were.
            root: the checkout whose code would run; the running code's when None.
        """
        if not (self.folder / "metrics.csv").is_file():
            return "there is no run yet"
        try:
            before, altered = self.provenance, self.altered
        except StudyError as error:
            return f"its {PROVENANCE} cannot be read: {error}"
        if altered:
            return f"the run {altered}"
        now = {
            "dataset": dataset,
            "code_sha256": code_sha256(root),
            "seed": seed,
            "parameters": json.loads(json_text(parameters)),
            "inputs_sha256": {**before.get("inputs_sha256", {}), **(inputs or {})},
        }
        words = {
            "dataset": "the data set",
            "code_sha256": "the code",
            "seed": "the seed",
            "parameters": "a parameter or the list of methods",
            "inputs_sha256": "an input file",
        }
        changed = [words[name] for name, value in now.items() if before.get(name) != value]
        return f"since it was made, {' and '.join(changed)} changed" if changed else None

    def compare(self, candidate: Run) -> Comparison:
        """Another run against this one as the reference, see `study.results.compare.compare`."""
        return compare(self.folder, candidate.folder)

    def clouds(self) -> Clouds:
        """Where every case put its points, see `study.results.clouds`.

        Raises:
            StudyError: the run kept none, or they are not as it left them.
        """
        path = self.folder / CLOUDS
        if not path.is_file():
            raise StudyError(f"expected the clouds of a run at {path}, got none; run the data set again")
        if self.provenance.get("clouds_sha256") != sha256_of(path):
            raise StudyError(f"{path}: expected the file that the run wrote, got another one; run the data set again")
        return Clouds(path)

    def tables(self) -> list[Path]:
        """The Markdown tables beside the metrics."""
        return sorted(self.folder.glob("hd_table*.md"))

    def keep_figures(self, pictures: Mapping[str, bytes]) -> list[str]:
        """Write pictures of this run beside its metrics, and their hashes into its provenance; their file names.

        Args:
            pictures: by file name, as `study.figures.picture_files` gives them.

        Raises:
            StudyError: the folder holds another run by now, or one that was altered.
        """
        with claimed(self.folder, wait=True):
            there = Run(self.folder)
            if there.provenance["finished"] != self.provenance["finished"]:
                raise StudyError(f"{self.folder}: expected the run that the figures are of, got a later one; open it")
            if there.altered:
                raise StudyError(
                    f"{self.folder}: expected the run as it was made, but it {there.altered}; run it again"
                )
            names = keep_pictures(self.folder, pictures)
            seal(self.folder, [*there.provenance["files_sha256"], *names], there.provenance)
        return names

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
    claim: Claim,
    rows: Sequence[Row],
    timings: Sequence[Row],
    provenance: Mapping[str, Any],
    failures: str = "",
    copies: Mapping[str, Path] | None = None,
    clouds: Mapping[CaseName, str] | None = None,
) -> Run:
    """Write everything that tells of a run that has just ended, and describes it, all at once.

    Args:
        claim: on its folder.
        rows: of ``metrics.csv``.
        timings: of ``timings.csv``.
        provenance: see `study.results.provenance.provenance`; the hashes of the run's files are added.
        failures: tracebacks of cases that failed in a way nobody foresaw.
        copies: files that it was made with and that belong beside it, by the name they get.
        clouds: of each case, as `study.results.clouds.pack` gives them; none are kept where there are none. Their hash
            stands by itself in the provenance: a run whose clouds were left out of a copy is not an altered one.

    Raises:
        StudyError: rows that are not of the schema, or a file of somebody else's in the way; nothing is changed then.
    """
    new = claim.new()
    write_metrics(rows, new / "metrics.csv")
    write_timings(timings, new / "timings.csv")
    if failures:
        write_text(new / FAILURES_LOG, failures)
    write_tables(read_metrics(new / "metrics.csv"), new, with_paper=not provenance.get("own_manifest", False))
    write_json(provenance["parameters"], new / "parameters.json")
    for name, path in (copies or {}).items():
        write_bytes(new / name, path.read_bytes())
    names = [path.name for path in new.iterdir()]
    if clouds:
        write_clouds(clouds, new / CLOUDS)
        provenance = {**provenance, "clouds_sha256": sha256_of(new / CLOUDS)}
    seal(new, names, provenance)
    claim.swap_in()
    return Run(claim.folder)


def find_runs(folder: Path) -> list[Run]:
    """Every run below a folder, by path.

    Raises:
        StudyError: none.
    """
    found = [path.parent for path in visible(folder, "metrics.csv")]
    if not found:
        raise StudyError(f"{folder}: expected runs with a metrics.csv below it, got none; run `study run` first")
    return [Run(path) for path in found]


def visible(folder: Path, pattern: str) -> list[Path]:
    """Files below a folder, by path, without hidden folders: what is not finished is not shown."""
    found = folder.rglob(pattern)
    return sorted(path for path in found if not any(p.startswith(".") for p in path.relative_to(folder).parts))


def newest(dataset: str, profile: str, seed: int) -> Run | None:
    """The run of a data set, or the committed reference (full profile at seed 0 only), or None."""
    places = [run_folder(dataset, profile, seed)]
    places += [REFERENCE / dataset] if (profile, seed) == ("full", 0) else []
    found = [place for place in places if (place / "metrics.csv").is_file()]
    return Run(found[0]) if found else None


def keep_pictures(folder: Path, pictures: Mapping[str, bytes]) -> list[str]:
    """Write pictures, by file name, into a folder; their file names."""
    for name, content in pictures.items():
        write_bytes(folder / name, content)
    return list(pictures)


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
