"""``claims.csv``: the paper's claims against every run, each with the command that shows it and what that costs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from study.errors import StudyError
from study.evaluation.claim_questions import UNTESTABLE
from study.evaluation.claims import CLAIMS, UNKNOWN, claims_table, with_minutes
from study.files.atomic import json_text, write_text
from study.files.places import CHECKOUT
from study.methods import METHODS
from study.params import PROFILES
from study.results.run import Run

COSTS = ("command", "minutes", "memory_mb")
CLAIM_COLUMNS = ("claim", "paper", "dataset", "ours", "low", "high", "verdict", *COSTS)


def claim_rows(runs: Sequence[Run]) -> pd.DataFrame:
    """Every claim against every run that can tell of it.

    Args:
        runs: one a data set.

    Returns:
        columns `CLAIM_COLUMNS`: ``ours`` the claim's number on that data set, ``low`` and ``high`` its 95 % interval
        over people (NaN where nobody can be resampled), ``minutes`` the work of one process for the whole command,
        ``memory_mb`` the most that one process held. A claim that no run of any data set can test is one row of data
        set ``-``.

    Raises:
        StudyError: no run, or two of one data set.
    """
    evidence = _evidence(runs)
    costs = {run.dataset: _cost(run) for run in runs}
    rows: list[dict[str, Any]] = []
    for claim in CLAIMS:
        about = {"claim": claim.text, "paper": claim.paper}
        if claim.ask is None:
            rows.append({**about, "dataset": "-", "verdict": UNTESTABLE, "command": "-"})
        for name, values in evidence.items():
            found = claim.finding(values)
            if found is not None:
                of = found.interval
                numbers = {"ours": of.value, "low": of.low, "high": of.high, "verdict": found.verdict}
                rows.append({**about, "dataset": name, **numbers, **costs[name]})
    return pd.DataFrame(rows, columns=CLAIM_COLUMNS)


def _evidence(runs: Sequence[Run]) -> dict[str, pd.DataFrame]:
    names = [run.dataset for run in runs]
    if not runs or len(set(names)) < len(names):
        raise StudyError(f"expected one run a data set, got {', '.join(names) or 'none'}; name other folders")
    return {run.dataset: with_minutes(run.values, run.timings) for run in runs}


def _cost(run: Run) -> dict[str, Any]:
    """The command that makes a run, and what it took."""
    return {
        "command": command_of(run),
        "minutes": round(float(run.timings["seconds"].sum()) / 60, 1),
        "memory_mb": run.provenance.get("peak_memory_mb", np.nan),  # older runs did not measure it
    }


def command_of(run: Run) -> str:
    """The command that makes a run like this one; options at their defaults are left out."""
    command, parameters, seed = (
        f"study run --dataset {run.dataset}",
        run.provenance["parameters"],
        run.provenance["seed"],
    )
    profiles = [name for name, of in PROFILES.items() if json_text(asdict(of)) == json_text(parameters["study"])]
    if profiles and profiles[0] != "full":
        command += f" --profile {profiles[0]}"
    methods = [name for name in METHODS if name in parameters["methods"]]
    if len(methods) < len(METHODS):
        command += f" --methods {','.join(methods)}"
    return command + (f" --seed {seed}" if seed else "")


def claims_markdown(runs: Sequence[Run]) -> str:
    """The same as two tables to be read: claims by data sets, and what each data set's command costs."""
    table = claims_table(_evidence(runs)).rename(columns={"here": "over all"})
    costs = pd.DataFrame({run.dataset: _cost(run) for run in runs}).T.rename_axis("data set")
    costs["memory_mb"] = [UNKNOWN if pd.isna(value) else f"{value:.0f}" for value in costs["memory_mb"]]
    costs["command"] = [f"`{command}`" for command in costs["command"]]
    return (
        "# The paper's claims, one by one\n\n"
        "Ours: the number in the claim's brackets with its 95 % interval over people, or a count of pairs; then the "
        "verdict. A difference whose interval holds 0, or that is below what the metric can tell, is a tie. Numbers "
        "as printed belong to the paper's CTs and its volunteer: they stand beside ours and are not judged.\n\n"
        f"{table.to_markdown(disable_numparse=True)}\n\n"
        "Each data set's numbers come from one command; minutes: work of one process, all methods; memory: the most "
        "that one process held, MB.\n\n"
        f"{costs.to_markdown(disable_numparse=True)}\n"
    )


def write_claims(runs: Sequence[Run], out: Path, more: Path | None = None) -> tuple[Path, Path]:
    """Write ``claims.csv`` and ``claims.md`` into a folder; their paths.

    Args:
        runs: see `claim_rows`.
        out: the folder.
        more: a folder with the claims against other runs, whose rows ``claims.csv`` has, too, and whose page the page
            names; None, or one that is not there, for none.

    Raises:
        StudyError: see `claim_rows`.
    """
    table, page = out / "claims.csv", out / "claims.md"
    rows, text = claim_rows(runs), claims_markdown(runs)
    if more is not None and (more / table.name).is_file():
        rows = _joined(rows, pd.read_csv(more / table.name, encoding="utf-8"))
        where = Path(os.path.relpath(more / page.name, CHECKOUT / "results")).as_posix()
        text += f"\nThe same against more people, sweeps and planted deformations: [{where}]({where}).\n"
    write_text(table, rows.to_csv(index=False, lineterminator="\n"))
    write_text(page, text)
    return table, page


def _joined(rows: pd.DataFrame, others: pd.DataFrame) -> pd.DataFrame:
    """Rows of claims of several runs, claim by claim; what no run can test stays one row."""
    both = pd.concat([rows, others[others["dataset"] != "-"]], ignore_index=True)
    order = {claim.text: number for number, claim in enumerate(CLAIMS)}
    return both.iloc[both["claim"].map(order).argsort(kind="stable")]
