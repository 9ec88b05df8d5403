import json
from datetime import UTC, datetime

import numpy as np
import pandas as pd
import pytest

from study.errors import StudyError
from study.methods.icp import Icp
from study.metrics import METRICS
from study.results import (
    COLUMNS,
    PAPER_DATA,
    beside_paper,
    compare,
    failed_row,
    hd_table,
    metric_rows,
    paper_hd_table,
    paper_waypoints,
    provenance,
    read_metrics,
    run_folder,
    sha256_of,
    waypoint_summary,
    why_stale,
    write_hd_table,
    write_json,
    write_metrics,
    write_text,
    write_timings,
)

METHODS = ("skeleton_graph", "icp")
SUBJECTS = ("ct1", "ct2", "ct10")


def some_rows(seed=0, dataset="phantom", without=()):
    rng = np.random.default_rng(seed)
    rows = []
    for method in METHODS:
        for subject in SUBJECTS:
            errors = rng.uniform(1, 5, 20)
            case = (dataset, subject, "patient", method, 0)
            if (subject, method) in without:
                rows.append(failed_row(*case, "no sternum found in 'ct2':\nbest overlap 0.31, need 0.60"))
            else:
                values = {"hd": rng.uniform(8, 12), "waypoint_error": errors, "waypoint_error_inplane": errors / 2}
                rows += metric_rows(*case, values, converged=method != "icp")
    return rows


@pytest.fixture
def run(tmp_path):
    def write(name, rows):
        write_metrics(rows, tmp_path / name / "metrics.csv")
        return tmp_path / name

    return write


def test_metrics_keep_every_bit_and_any_row_order_gives_the_same_bytes(tmp_path):
    rows = some_rows(without=[("ct2", "icp")])
    a, b = tmp_path / "a" / "metrics.csv", tmp_path / "b.csv"
    write_metrics(rows, a)
    write_metrics([rows[k] for k in np.random.default_rng(1).permutation(len(rows))], b)
    assert a.read_bytes() == b.read_bytes()
    assert b"\r" not in a.read_bytes()
    table = read_metrics(a)
    assert tuple(table.columns) == COLUMNS
    assert len(table) == len(rows) == 5 * 41 + 1
    written = {tuple(row[name] for name in COLUMNS[:7]): row["value"] for row in rows}
    for row in table.itertuples(index=False):
        expected = written[tuple(row[:7])]
        assert row.value == expected or (np.isnan(expected) and np.isnan(row.value))
    assert not list(tmp_path.rglob("*.tmp"))


def test_a_failed_case_is_one_row_with_its_reason(tmp_path):
    write_metrics(some_rows(without=[("ct2", "icp")]), tmp_path / "metrics.csv")
    table = read_metrics(tmp_path / "metrics.csv")
    failed = table[table["status"].str.startswith("failed")]
    assert len(failed) == 1
    assert failed.iloc[0]["status"] == "failed: no sternum found in 'ct2': best overlap 0.31, need 0.60"
    assert set(table.loc[table["method"] == "icp", "status"]) == {"not converged", failed.iloc[0]["status"]}


def test_a_killed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "metrics.csv"
    write_text(path, "old")

    def dies(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("pathlib.Path.replace", dies)
    with pytest.raises(KeyboardInterrupt):
        write_text(path, "new")
    assert path.read_text(encoding="utf-8") == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.csv"]


def edited(text, old, new):
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda text: "", "expected a table"),
        (lambda text: text.splitlines()[0] + "\n", "only a header"),
        (lambda text: edited(text, "subject", "patient"), "expected columns"),
        (lambda text: edited(text, ",hd,0,", ",hd,first,"), "expected numbers"),
        (lambda text: edited(text, ",hd,", ",hausdorff,"), "line 2: expected a known metric"),
        (lambda text: edited(text, ",mm,ok", ",cm,ok"), "expected the metric's unit"),
        (lambda text: edited(text, ",mm,ok", ",mm,fine"), "expected a status"),
        (lambda text: edited(text, ",mm,ok", ",mm,failed: late"), "finite value exactly where"),
        (lambda text: text + text.splitlines()[-1] + "\n", "expected one row per"),
        (lambda text: text + "a,b\n", "expected numbers"),
        (lambda text: text + ",".join("abcdefghijklm") + "\n", "expected a table"),
    ],
)
def test_other_schemas_are_refused_and_located(tmp_path, spoil, message):
    path = tmp_path / "metrics.csv"
    write_metrics(some_rows(), path)
    path.write_text(spoil(path.read_text(encoding="utf-8")))
    with pytest.raises(StudyError, match=message):
        read_metrics(path)


def test_what_cannot_be_read_is_not_written(tmp_path):
    path = tmp_path / "metrics.csv"
    rows = some_rows()
    for bad in ([], [*rows, rows[0]], [*rows[1:], {**rows[0], "value": float("nan")}]):
        with pytest.raises(StudyError):
            write_metrics(bad, path)
    assert not path.exists()
    with pytest.raises(StudyError, match="expected a metric among"):
        metric_rows("d", "s", "t", "m", 0, {"hausdorff": 1.0})
    with pytest.raises(StudyError, match="write a failed row"):
        metric_rows("d", "s", "t", "m", 0, {"hd": np.nan})


def test_hd_table_has_the_shape_of_table_1(run):
    metrics = read_metrics(run("a", some_rows(without=[("ct2", "icp")])) / "metrics.csv")
    table = hd_table(metrics)
    assert list(table.columns) == ["ct1", "ct2", "ct10", "mean", "sd", "n", "n_failed", "n_not_converged"]
    hd = metrics[metrics["metric"] == "hd"].set_index(["method", "subject"])["value"]
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
    everywhere = [(subject, "icp") for subject in SUBJECTS]
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


def test_a_run_agrees_with_itself_and_with_small_differences(run):
    rows = some_rows(without=[("ct2", "icp")])
    small = [{**row, "value": row["value"] + 0.9 * METRICS.get(row["metric"], METRICS["hd"]).tolerance} for row in rows]
    for name, other in (("same", rows), ("small", small)):
        comparison = compare(run("reference", rows), run(name, other))
        assert comparison.n_compared == len(rows)
        assert (comparison.agrees, comparison.exit_code) == (True, 0)
        assert f"compared {len(rows)} rows of 1 file(s)" in comparison.report()


def test_the_largest_difference_is_listed_first(run):
    rows = some_rows()
    moved = [{**row, "value": row["value"] + (0.3 if k == 7 else 0.15 if k == 9 else 0)} for k, row in enumerate(rows)]
    comparison = compare(run("reference", rows), run("moved", moved))
    assert comparison.exit_code == 1
    assert list(comparison.differences["index"]) == [rows[7]["index"], rows[9]["index"]]
    assert comparison.differences["times_tolerance"].iloc[0] == pytest.approx(3)
    assert "2 value(s) beyond tolerance" in comparison.report()
    assert comparison.report().endswith("differs")


def test_rows_that_only_one_run_has_differ(run):
    rows = some_rows()
    fewer = compare(run("a", rows), run("b", rows[:-1]))
    more = compare(run("b", rows[:-1]), run("a", rows))
    assert (len(fewer.missing), len(fewer.extra), fewer.exit_code) == (1, 0, 1)
    assert (len(more.missing), len(more.extra), more.exit_code) == (0, 1, 1)
    # A case that newly failed: its numbers are missing and its reason is new.
    failed = compare(run("a", rows), run("c", some_rows(without=[("ct2", "icp")])))
    assert (failed.exit_code, len(failed.missing), len(failed.extra)) == (1, 41, 1)


def test_a_changed_status_differs(run):
    rows = some_rows()
    changed = [{**row, "status": "ok"} for row in rows]
    comparison = compare(run("a", rows), run("b", changed))
    assert comparison.exit_code == 1
    assert len(comparison.differences) == sum(row["method"] == "icp" for row in rows)
    assert "(not converged)" in comparison.report()


def test_what_cannot_be_compared_is_an_error(run, tmp_path):
    good = run("good", some_rows())
    (tmp_path / "bare").mkdir()
    with pytest.raises(StudyError, match=r"expected metrics\.csv in"):
        compare(tmp_path / "bare", good)
    with pytest.raises(StudyError, match="only in"):
        compare(good, tmp_path / "nowhere")
    empty = run("empty", some_rows())
    (empty / "metrics.csv").write_text("")
    with pytest.raises(StudyError, match="expected a table"):
        compare(good, empty)
    with pytest.raises(StudyError, match="expected a table"):
        compare(empty, good)
    (empty / "metrics.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(StudyError, match="UTF-8"):
        compare(good, empty)


def test_folders_of_datasets_are_compared_together(run, tmp_path):
    for name in ("reference", "candidate"):
        run(f"{name}/phantom", some_rows())
        run(f"{name}/open", some_rows(1, "open"))
    comparison = compare(tmp_path / "reference", tmp_path / "candidate")
    assert (comparison.n_files, comparison.n_compared, comparison.exit_code) == (2, 2 * len(some_rows()), 0)
    (tmp_path / "candidate" / "open" / "metrics.csv").unlink()
    with pytest.raises(StudyError, match=r"open/metrics\.csv only in"):
        compare(tmp_path / "reference", tmp_path / "candidate")


def test_provenance_holds_what_a_reader_needs(tmp_path):
    (tmp_path / "environment.lock").write_text("numpy==2.0\n")
    start, end = datetime(2024, 1, 1, 12, tzinfo=UTC), datetime(2024, 1, 1, 12, 1, tzinfo=UTC)
    record = provenance({"icp": Icp(), "grid": np.arange(2), "out": tmp_path}, 7, {"ct": "ab"}, start, end, tmp_path)
    write_json(record, tmp_path / "provenance.json")
    read = json.loads((tmp_path / "provenance.json").read_text(encoding="utf-8"))
    assert read["lock_sha256"] == sha256_of(tmp_path / "environment.lock")
    assert read["parameters"]["icp"]["max_iterations"] == 30
    assert read["parameters"]["grid"] == [0, 1]
    assert (read["seed"], read["seconds"], read["inputs_sha256"]) == (7, 60.0, {"ct": "ab"})
    assert {"python", "numpy", "pycpd"} <= set(read["versions"])
    assert read["commit"] is None  # no checkout there
    assert read["machine"]["cores"] >= 1


def test_provenance_knows_the_commit_of_a_checkout():
    now = datetime.now(UTC)
    commit = provenance({}, 0, {}, now, now)["commit"]
    if commit is None:
        pytest.skip("not a git checkout")
    assert len(commit) == 40


def test_timings_are_sorted(tmp_path):
    row = {"dataset": "phantom", "subject": "ct1", "target": "patient", "method": "icp", "seed": 0, "seconds": 0.5}
    write_timings([{**row, "stage": "register"}, {**row, "stage": "align"}], tmp_path / "timings.csv")
    lines = (tmp_path / "timings.csv").read_text(encoding="utf-8").splitlines()
    assert [line.split(",")[5] for line in lines] == ["stage", "align", "register"]


def test_a_run_goes_stale_with_its_code_its_parameters_and_its_seed(tmp_path):
    code = tmp_path / "src" / "study" / "som.py"
    code.parent.mkdir(parents=True)
    code.write_text("rate = 0.1\n")
    run, now = tmp_path / "run", datetime(2024, 1, 1, tzinfo=UTC)
    parameters = {"methods": {"icp": Icp()}}

    def why(parameters=parameters, seed=0):
        return why_stale(run, parameters, seed, tmp_path)

    assert "no run" in why()
    write_metrics(metric_rows("phantom", "ct1", "patient", "icp", 0, {"hd": 1.0}), run / "metrics.csv")
    assert "cannot be read" in why()
    write_json(provenance(parameters, 0, {}, now, now, tmp_path), run / "provenance.json")
    assert why() is None
    assert "the seed" in why(seed=1)
    assert "list of methods" in why({"methods": {"icp": Icp(max_iterations=3)}})
    code.write_text("rate = 0.2\n")
    assert "the code" in why()


def test_only_the_whole_study_at_seed_0_is_kept_as_the_run_of_a_dataset():
    folders = {run_folder(*chosen) for chosen in [("open", "full", 0), ("open", "quick", 0), ("open", "full", 1)]}
    assert len(folders) == 3
    assert {path.parent.name for path in folders} == {"runs", "trials"}
