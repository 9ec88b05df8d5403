"""The small tables that stand for runs of many people hold what the runs hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from study.errors import StudyError
from study.results.evidence import PEOPLE, Evidence, evidence_folder, find_evidence, pairs_table
from study.results.metrics_csv import Case, failed_row, metric_rows, write_metrics
from study.results.run import Run


@pytest.fixture
def run(tmp_path: Path) -> Run:
    rng = np.random.default_rng(3)
    rows = []
    for source, target in (("p01", "p02"), ("p02", "p01"), ("p02", "p03#1")):
        for method in ("icp", "coarse", "truth"):
            case = Case("population", source, target, method, 0)
            if target == "p03#1" or (source, method) == ("p02", "icp"):
                rows.append(failed_row(case, "expected four branches, got 3"))
            else:
                rows += metric_rows(case, {"hd": rng.uniform(5, 9), "waypoint_error": rng.uniform(1, 3, 20)})
    (tmp_path / "run").mkdir()
    write_metrics(rows, tmp_path / "run" / "metrics.csv")
    return Run(tmp_path / "run")


def test_means_of_pairs_and_reasons_come_back_from_the_small_table(run: Run, tmp_path: Path) -> None:
    table = pairs_table([run])
    assert len(table) == 9
    assert list(table)[:7] == ["dataset", "source", "target", "method", "reason", "hd", "waypoint_error"]
    (tmp_path / PEOPLE).mkdir()
    table.to_csv(tmp_path / PEOPLE / "pairs.csv", index=False, float_format="%.4f")
    kept = Evidence(tmp_path)
    assert kept.datasets == ["population"]
    means = kept.per_pair("population")
    assert list(means) == ["coarse", "icp", "truth"]
    pd.testing.assert_frame_equal(means, run.per_pair, atol=5e-5, check_names=False)
    lost = kept.refused("population")
    assert lost.to_dict("records") == [{"source": "p02", "target": "p03#1", "reason": "expected four branches, got 3"}]


def test_a_table_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"robustness/summary\.csv, got: .*run `make evidence`"):
        Evidence(tmp_path).table("robustness")


def test_what_was_run_here_goes_before_what_is_committed(tmp_path: Path) -> None:
    assert find_evidence("quick", tmp_path) is None
    for part in ("robustness", "sensitivity", PEOPLE):
        (evidence_folder("full", tmp_path) / part).mkdir(parents=True)
    found = find_evidence("full", tmp_path)
    assert found is not None
    assert found.folder == tmp_path / "results" / "runs" / "evidence"
