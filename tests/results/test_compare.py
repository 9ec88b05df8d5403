import pytest
from result_rows import some_rows

from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.results.compare import compare


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
