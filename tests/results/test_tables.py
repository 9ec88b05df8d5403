from itertools import permutations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from result_rows import SOURCES, some_rows

from study.errors import StudyError
from study.results.metrics_csv import Case, failed_row, metric_rows, read_metrics
from study.results.tables import (
    PAPER_DATA,
    beside_paper,
    hd_table,
    paper_hd_table,
    paper_waypoints,
    waypoint_summary,
    write_hd_table,
    write_tables,
)


def test_hd_table_has_the_shape_of_table_1(run):
    metrics = read_metrics(run("a", some_rows(without=[("ct2", "icp")])) / "metrics.csv")
    table = hd_table(metrics)
    assert list(table.columns) == ["ct1", "ct2", "ct10", "mean", "sd", "n", "n_failed", "n_not_converged"]
    hd = metrics[metrics["metric"] == "hd"].set_index(["method", "source"])["value"]
    assert table.loc["icp", "ct10"] == hd["icp", "ct10"]
    assert table.loc["skeleton_graph", "sd"] == pytest.approx(hd["skeleton_graph"].std(ddof=0))
    assert list(table.loc["icp", ["n", "n_failed", "n_not_converged"]]) == [2, 1, 2]
    display, _ = beside_paper(table)
    ours = display[display["Data"] == "this study"].set_index("Method")["n"]
    assert dict(ours) == {"skeleton_graph": "3", "icp": "2 (1 failed, 2 not converged)"}
    assert np.isnan(table.loc["icp", "ct2"])
    errors = hd_table(metrics, "waypoint_error")
    every = metrics[(metrics["metric"] == "waypoint_error") & (metrics["method"] == "icp")]
    assert errors.loc["icp", "mean"] == pytest.approx(every["value"].mean())


def test_a_method_that_failed_everywhere_stays_in_the_table(run):
    everywhere = [(source, "icp") for source in SOURCES]
    table = hd_table(read_metrics(run("a", some_rows(without=everywhere)) / "metrics.csv"))
    assert list(table.loc["icp", ["n", "n_failed"]]) == [0, 3]
    display, _ = beside_paper(table)
    icp = display[(display["Data"] == "this study") & (display["Method"] == "icp")].iloc[0]
    assert list(icp[["CT 1", "Mean±SD", "n"]]) == ["failed", "failed", "0 (3 failed)"]


def test_the_papers_rows_are_its_own_and_marked(run):
    paper = paper_hd_table()
    values = paper[[f"CT {k}" for k in range(1, 6)]].to_numpy()
    assert np.round(values.mean(axis=1), 2) == pytest.approx(paper["mean"].to_numpy())
    assert np.round(values.std(axis=1), 2) == pytest.approx(paper["sd"].to_numpy())
    assert (paper_waypoints()["n"] == 100).all()
    display, note = beside_paper(hd_table(read_metrics(run("a", some_rows()) / "metrics.csv")))
    theirs = display[display["Data"] == PAPER_DATA].set_index("Method")
    assert theirs.loc["skeleton_graph", "Mean±SD"] == "9.48±0.27"
    assert theirs.loc["cpd", "CT 4"] == "10.56"
    assert (display["n"] != "").all()
    assert "CT 3 = ct10" in note
    assert "other CTs" in note


def test_tables_are_written_three_ways(run, tmp_path):
    metrics = read_metrics(run("a", some_rows(without=[("ct2", "icp")])) / "metrics.csv")
    write_hd_table(metrics, tmp_path / "hd_table")
    written = pd.read_csv(tmp_path / "hd_table.csv", index_col=["method", "data"])
    assert written.loc[("icp", "this study"), "ct1"] == hd_table(metrics).loc["icp", "ct1"]
    assert len(written) == 2 + 4
    markdown, latex = (tmp_path / f"hd_table.{kind}" for kind in ("md", "tex"))
    assert markdown.read_text(encoding="utf-8").count("\n| ") == 1 + 6
    assert "failed" in markdown.read_text(encoding="utf-8")
    text = latex.read_text(encoding="utf-8")
    assert text.count(r"$\pm$") == 1 + 6
    assert r"skeleton\_graph" in text
    assert text.isascii()
    write_hd_table(metrics, tmp_path / "errors", "waypoint_error")
    assert "paper" not in (tmp_path / "errors.md").read_text(encoding="utf-8")


def test_two_datasets_do_not_share_a_table(run):
    both = some_rows() + some_rows(dataset="open")
    metrics = read_metrics(run("a", both) / "metrics.csv")
    for make in (hd_table, waypoint_summary):
        with pytest.raises(StudyError, match="select one"):
            make(metrics)


def test_waypoint_summary_counts_waypoints_cases_and_failures(run):
    metrics = read_metrics(run("a", some_rows(without=[("ct2", "icp")])) / "metrics.csv")
    summary = waypoint_summary(metrics).set_index(["metric", "method"])
    values = metrics[(metrics["metric"] == "waypoint_error") & (metrics["method"] == "icp")]["value"]
    icp = summary.loc[("waypoint_error", "icp")]
    assert list(icp[["n_waypoints", "n_cases", "n_failed"]]) == [40, 2, 1]
    assert icp["mean"] == pytest.approx(values.mean())
    assert icp["sd"] == pytest.approx(values.std(ddof=0))
    assert list(icp[["paper_mean", "paper_sd"]]) == [4.78, 2.83]
    assert summary.loc[("waypoint_error_inplane", "icp")].isna()["paper_mean"]


def rows_of(cases: list[tuple[str, str]]) -> pd.DataFrame:
    rows = [row for source, target in cases for row in metric_rows(Case("d", source, target, "icp", 0), {"hd": 9.0})]
    return pd.DataFrame(rows)


def test_one_patient_gives_one_table_and_more_give_one_each_and_all_pairs(tmp_path: Path) -> None:
    for name in ("one", "more"):
        (tmp_path / name).mkdir()
    write_tables(rows_of([("a", "b"), ("b", "a"), ("c", "a")]), tmp_path / "more")
    assert {path.stem for path in (tmp_path / "more").glob("*.md")} == {"hd_table_a", "hd_table_b", "hd_all_pairs"}
    (tmp_path / "one" / "hd_mine.csv").write_text("mine")
    write_tables(rows_of([("a", "p"), ("b", "p")]), tmp_path / "one")
    assert {path.stem for path in (tmp_path / "one").glob("*.md")} == {"hd_table"}
    assert (tmp_path / "one" / "hd_mine.csv").read_text() == "mine"


def test_one_ct_with_several_patients_has_them_as_columns(tmp_path: Path) -> None:
    write_tables(rows_of([("a", "p1"), ("a", "p2")]), tmp_path)
    assert [path.stem for path in tmp_path.glob("*.md")] == ["hd_table"]
    assert {"p1", "p2"} <= set(pd.read_csv(tmp_path / "hd_table.csv").columns)


def test_sweeps_of_a_patient_share_a_table_and_many_patients_one(tmp_path: Path) -> None:
    for name in ("swept", "many"):
        (tmp_path / name).mkdir()
    swept = rows_of([(a, b) for a, b in permutations("abc", 2)] + [("b", "a#1"), ("c", "a#1"), ("a", "b#1")])
    swept.loc[swept["target"] == "a#1", "value"] = 11.0
    write_tables(swept, tmp_path / "swept")
    stems = {"hd_table_a", "hd_table_b", "hd_table_c", "hd_all_pairs"}
    assert {path.stem for path in (tmp_path / "swept").glob("*.md")} == stems
    ours = pd.read_csv(tmp_path / "swept" / "hd_table_a.csv").query("data == 'this study'")
    assert ours[["b", "c", "n"]].to_numpy().tolist() == [[10.0, 10.0, 2]]
    assert pd.read_csv(tmp_path / "swept" / "hd_all_pairs.csv")["n"].iloc[0] == 6
    write_tables(rows_of(list(permutations("abcdefg", 2))), tmp_path / "many")
    assert {path.stem for path in (tmp_path / "many").glob("*.md")} == {"hd_table"}
    assert pd.read_csv(tmp_path / "many" / "hd_table.csv")["n"].iloc[0] == 7


def test_a_table_of_failures_only_can_be_written(tmp_path: Path) -> None:
    write_tables(pd.DataFrame([failed_row(Case("d", s, "p", "icp", 0), "no sternum") for s in "ab"]), tmp_path)
    assert "2 failed" in (tmp_path / "hd_table.md").read_text(encoding="utf-8")
