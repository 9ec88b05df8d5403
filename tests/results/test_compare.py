import pytest
from result_rows import some_rows

from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.results.compare import compare
from study.results.metrics_csv import Case, metric_rows, read_metrics
from study.results.run import REFERENCE


def tolerance(row):
    """Of waypoints, whose many values average out; of a metric with one value a pair, that of the mean."""
    metric = METRICS.get(row["metric"], METRICS["hd"])
    return metric.tolerance if row["metric"].startswith("waypoint") else metric.mean_tolerance


def test_a_run_agrees_with_itself_and_with_small_differences(run):
    rows = some_rows(without=[("ct2", "icp")])
    small = [
        {**row, "value": row["value"] + (-0.9 if row["index"] % 2 else 0.9) * tolerance(row)}  # to either side
        for row in rows
    ]
    for name, other in (("same", rows), ("small", small)):
        comparison = compare(run("reference", rows), run(name, other))
        assert comparison.n_compared == len(rows)
        assert (comparison.agrees, comparison.exit_code) == (True, 0)
        assert f"compared {len(rows)} rows" in comparison.report()


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
    with pytest.raises(StudyError, match=r"expected .*bare/metrics\.csv, got no such file"):
        compare(tmp_path / "bare", good)
    with pytest.raises(StudyError, match=r"expected .*nowhere/metrics\.csv, got no such file"):
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


def shifted(rows, method, mm, metric=None):
    chosen = {metric} if metric else set(METRICS)
    return [
        {**row, "value": row["value"] + mm} if row["method"] == method and row["metric"] in chosen else row
        for row in rows
    ]


@pytest.mark.parametrize("metric", ["hd", "waypoint_error", "waypoint_error_inplane"])
def test_a_shift_of_every_row_of_a_method_differs_though_each_row_is_within_tolerance(run, metric):
    rows = some_rows()
    mm = 0.95 * METRICS[metric].tolerance
    comparison = compare(run("a", rows), run("b", shifted(rows, "skeleton_graph", mm, metric)))
    assert comparison.differences.empty
    assert comparison.exit_code == 1
    found = comparison.shifts[["method", "metric"]].to_numpy().tolist()
    assert found == [["skeleton_graph", metric]]
    assert comparison.shifts["shift"].item() == pytest.approx(mm)
    assert "1 mean(s) beyond tolerance" in comparison.report()


def three_methods(lead):
    """Rows of three methods, each ``lead`` mm ahead of the next."""
    return [
        row
        for k, method in enumerate(("skeleton_graph", "icp", "cpd"))
        for source in ("ct1", "ct2")
        for row in metric_rows(Case("phantom", source, "p", method, 0), {"hd": 8.0 + lead * k, "msd": 1.0})
    ]


def test_an_order_that_turns_differs_however_little_moved(run):
    rows = three_methods(0.004)
    reference = run("a", rows)
    comparison = compare(reference, run("b", shifted(rows, "skeleton_graph", 0.006, "hd")))
    assert comparison.differences.empty
    assert comparison.shifts.empty
    assert comparison.exit_code == 1
    report = comparison.report()
    assert "phantom, hd: by mean skeleton_graph < icp < cpd; now icp < skeleton_graph < cpd" in report
    difference = "Hausdorff distance smaller than that of ICP (difference of means, mm)"
    assert f"phantom, {difference}: yes; now no" in report
    assert compare(reference, run("c", shifted(rows, "skeleton_graph", 0.003, "hd"))).agrees


def test_a_lead_that_becomes_a_tie_differs(run):
    rows = three_methods(0.012)
    comparison = compare(run("a", rows), run("b", shifted(rows, "skeleton_graph", 0.006, "hd")))
    assert comparison.differences.empty
    assert comparison.shifts.empty
    told = "smallest Hausdorff distance on every CT (share of pairs): 2 of 2; now 0 of 2, 2 tied"
    assert comparison.upsets == (f"phantom, {told}",)


def test_the_reference_with_one_method_moved_differs(run):
    """0.19 mm on every row of one method, each within its tolerance of 0.2 mm, changes places and a claim."""
    reference = REFERENCE / "phantom"
    rows = read_metrics(reference / "metrics.csv")
    rows.loc[(rows["method"] == "skeleton_graph") & (rows["metric"] == "hd"), "value"] += 0.19
    comparison = compare(reference, run("moved", rows.to_dict("records")))
    assert comparison.differences.empty
    assert comparison.exit_code == 1
    smallest = "smallest Hausdorff distance on every CT (share of pairs)"
    assert f"phantom, {smallest}: 4 of 5; now 3 of 5" in comparison.upsets
    by_mean = next(told for told in comparison.upsets if "hd: by mean" in told)
    before, _, now = by_mean.partition("; now")
    assert "skeleton_graph < skeleton_graph_tuned_whole <" in before
    assert "skeleton_graph_tuned_whole < skeleton_graph <" in now
    assert compare(reference, reference).agrees


def test_runs_of_other_data_or_seeds_cannot_be_compared(run):
    good = run("good", some_rows())
    with pytest.raises(StudyError, match=r"expected a run of phantom at seed 0, as .* got open at seed 0"):
        compare(good, run("other", some_rows(dataset="open")))
    with pytest.raises(StudyError, match="got phantom at seed 3"):
        compare(good, run("seed", [{**row, "seed": 3} for row in some_rows()]))
