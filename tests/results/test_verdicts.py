"""The claims' table from runs alone: what it holds, what it costs, and that a stale one is told."""

import importlib.util
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from result_rows import some_rows

from study.errors import StudyError
from study.evaluation.claim_questions import TIE, UNTESTABLE
from study.evaluation.claims import CLAIMS
from study.methods import METHODS
from study.params import PROFILES
from study.results.claim import claimed
from study.results.provenance import provenance
from study.results.run import REFERENCE, Run, write_run
from study.results.verdicts import CLAIM_COLUMNS, claim_rows, claims_markdown, command_of, write_claims

ROOT = Path(__file__).resolve().parents[2]
STARTED = datetime(2024, 1, 1, tzinfo=UTC)
CASE = {"source": "ct1", "target": "patient", "seed": 0, "stage": "register", "method": "icp"}


def made(folder, dataset="phantom", profile="full", seed=0, methods=tuple(METHODS), **more):
    parameters = {"study": asdict(PROFILES[profile]), "methods": {name: {} for name in methods}}
    record = {**provenance(dataset, parameters, seed, {}, STARTED, STARTED), **more}
    timings = [{**CASE, "dataset": dataset, "method": name, "seconds": 90.0} for name in ("icp", "cpd")]
    with claimed(folder) as claim:
        return write_run(claim, some_rows(dataset=dataset), timings, record)


def test_the_table_holds_a_row_a_claim_and_run_that_can_tell(tmp_path):
    runs = [made(tmp_path / "a", peak_memory_mb=512), made(tmp_path / "b", "open", seed=3)]
    table = claim_rows(runs)
    assert tuple(table.columns) == CLAIM_COLUMNS
    assert set(table["dataset"]) == {"phantom", "open", "-"}
    told = table[table["dataset"] == "phantom"].set_index("claim")
    difference = told.loc["waypoint error smaller than that of ICP (difference of means, mm)"]
    means = runs[0].per_pair.loc["waypoint_error"].mean()
    assert difference["ours"] == pytest.approx(means["skeleton_graph"] - means["icp"])
    assert difference["low"] < difference["ours"] < difference["high"]
    assert difference["high"] < 0
    assert difference["verdict"] == "reproduced"
    assert difference["paper"] == "-2.57"
    assert (difference["minutes"], difference["memory_mb"]) == (3.0, 512)
    assert np.isnan(table[table["dataset"] == "open"]["memory_mb"]).all()
    assert "waypoint error smaller than that of CPD (difference of means, mm)" not in told.index  # it was not run
    untested = table[table["dataset"] == "-"]
    assert untested["claim"].tolist() == [claim.text for claim in CLAIMS if claim.ask is None]
    assert set(untested["verdict"]) == {UNTESTABLE}


def test_commands_name_what_is_not_the_default(tmp_path):
    assert command_of(made(tmp_path / "a")) == "study run --dataset phantom"
    other = made(tmp_path / "b", "open", "quick", 3, ("icp", "coarse"))
    assert command_of(other) == "study run --dataset open --profile quick --methods coarse,icp --seed 3"


def test_two_runs_of_a_dataset_or_none_are_refused(tmp_path):
    run = made(tmp_path / "a")
    for runs, got in (([], "none"), ([run, replace(run)], "phantom, phantom")):
        with pytest.raises(StudyError, match=f"one run a data set, got {got}"):
            claim_rows(runs)
        with pytest.raises(StudyError, match=f"one run a data set, got {got}"):
            claims_markdown(runs)


def test_the_reference_alone_is_enough(tmp_path):
    runs = [Run(REFERENCE / name) for name in ("phantom", "open")]
    table, page = write_claims(runs, tmp_path)
    again = pd.read_csv(table)
    assert tuple(again.columns) == CLAIM_COLUMNS
    assert {"reproduced", "partly", "not", TIE, UNTESTABLE} <= set(again["verdict"])
    text = page.read_text(encoding="utf-8")
    assert all(claim.text in text for claim in CLAIMS)
    assert "| `study run --dataset open" in text


def test_the_tool_tells_a_stale_table(tmp_path, monkeypatch, capsys):
    spec = importlib.util.spec_from_file_location("tools_claims", ROOT / "tools" / "claims.py")
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    made(tmp_path / "runs" / "phantom")
    (tmp_path / "out").mkdir()
    options = [str(tmp_path / "runs"), "--out", str(tmp_path / "out")]

    def call(what):
        monkeypatch.setattr(tool.sys, "argv", ["claims.py", what, *options])
        return tool.main()

    assert call("check") == 1
    assert "claims.csv, claims.md: not of these runs" in capsys.readouterr().out
    assert call("write") == 0
    assert call("check") == 0
    page = tmp_path / "out" / "claims.md"
    page.write_text(page.read_text(encoding="utf-8") + "x", encoding="utf-8")
    assert call("check") == 1
    options[0] = str(tmp_path / "nothing")
    assert call("check") == 2
    assert "claims: " in capsys.readouterr().err
