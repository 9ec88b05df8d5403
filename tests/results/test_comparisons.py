"""All data sets in one call, and what is written of it."""

import json

import pytest
from junitparser import Error, Failure, JUnitXml
from result_rows import some_rows

from study.results.comparisons import AGREES, DIFFERS, REFUSED, compare_all
from study.results.metrics_csv import read_metrics, write_metrics
from study.results.run import REFERENCE


@pytest.fixture
def reference(tmp_path, run):
    for name in ("phantom", "open", "planted"):
        run(f"reference/{name}", some_rows(dataset=name))
    return tmp_path / "reference"


def candidate(tmp_path, run, **changed):
    """The same rows but for the data sets given."""
    for name in ("phantom", "open", "planted"):
        run(f"candidate/{name}", changed.get(name, some_rows(dataset=name)))
    return tmp_path / "candidate"


def moved(rows, mm, method="skeleton_graph"):
    return [{**row, "value": row["value"] + mm} if row["method"] == method else row for row in rows]


def test_data_sets_that_agree_are_compared_together(reference, tmp_path, run):
    found = compare_all(reference, candidate(tmp_path, run))
    assert list(found.parts) == ["open", "phantom", "planted"]
    assert sum(part.n_compared for part in found.compared().values()) == 3 * len(some_rows())
    assert (found.verdict, found.exit_code) == (AGREES, 0)
    assert found.report().endswith("all 3 data sets: agrees")
    assert "# Against the reference: agrees" in found.markdown()
    assert "beyond tolerance" not in found.markdown()


def test_a_shift_of_half_a_millimetre_is_told_in_every_form(reference, tmp_path, run):
    rows = some_rows(dataset="open")
    found = compare_all(reference, candidate(tmp_path, run, open=moved(rows, 0.5)))
    assert (found.verdict, found.exit_code) == (DIFFERS, 1)
    assert {name: part.agrees for name, part in found.compared().items()} == {
        "open": False,
        "phantom": True,
        "planted": True,
    }
    text = found.markdown()
    n_moved = sum(row["method"] == "skeleton_graph" for row in rows)
    assert f"## Values beyond tolerance: {n_moved}" in text
    assert f"... and {n_moved - 20} more" in text
    content = json.loads(found.json())
    told = content["datasets"]["open"]
    assert (content["exit_code"], told["verdict"], content["datasets"]["phantom"]["verdict"]) == (1, DIFFERS, AGREES)
    assert len(told["values_beyond_tolerance"]) == n_moved
    assert all(row["candidate"] - row["reference"] == pytest.approx(0.5) for row in told["values_beyond_tolerance"])
    times = [row["times_tolerance"] for row in told["values_beyond_tolerance"]]
    assert times == sorted(times, reverse=True)
    suites = {suite.name: suite for suite in JUnitXml.fromstring(found.junit())}
    assert {name: (suite.tests, suite.failures, suite.errors) for name, suite in suites.items()} == {
        "open": (3, suites["open"].failures, 0),
        "phantom": (3, 0, 0),
        "planted": (3, 0, 0),
    }
    failed = {case.name: case.result for case in suites["open"] if case.result}
    assert set(failed) >= {"skeleton_graph"}
    assert "icp" not in failed
    assert isinstance(failed["skeleton_graph"][0], Failure)
    assert "means beyond tolerance" in failed["skeleton_graph"][0].text


def test_old_and_new_stand_side_by_side_the_largest_first(reference, tmp_path, run):
    rows = some_rows(dataset="open")
    rows[0]["value"] += 1.0
    rows[4]["value"] += 3.0
    old = some_rows(dataset="open")
    text = compare_all(reference, candidate(tmp_path, run, open=rows)).markdown()
    lines = text[text.index("## Values") :].splitlines()[4:6]
    for line, k, by in zip(lines, (4, 0), (3, 1), strict=True):
        assert f"| {old[k]['value']:.6g} | {old[k]['value'] + by:.6g} |" in " ".join(line.split())


def test_a_missing_row_a_new_one_and_a_turned_order_are_told(reference, tmp_path, run):
    swapped = [
        {**row, "method": {"icp": "skeleton_graph", "skeleton_graph": "icp"}[row["method"]], "status": "ok"}
        for row in some_rows(dataset="phantom")
    ]
    given = candidate(tmp_path, run, open=some_rows(dataset="open")[:-1], phantom=swapped)
    found = compare_all(reference, given)
    assert found.exit_code == 1
    text = found.markdown()
    assert "## Rows that only the reference has: 1" in text
    assert "| phantom, hd, places 1 to 2 by mean" in text
    turned = next(line for line in text.splitlines() if "phantom, hd, places" in line)
    _, _, old, new, _ = (cell.strip() for cell in turned.split("|"))
    assert {old, new} == {"skeleton_graph < icp", "icp < skeleton_graph"}
    suites = {suite.name: suite for suite in JUnitXml.fromstring(found.junit())}
    failed = [case.name for case in suites["phantom"] if case.result]
    assert "order of the methods and claims" in failed
    assert [case.name for case in suites["open"] if case.result] == ["icp"]
    assert "## Rows that only the candidate has: 1" in compare_all(given, reference).markdown()


def test_what_cannot_be_compared_does_not_stop_the_others(reference, tmp_path, run):
    given = candidate(tmp_path, run, phantom=moved(some_rows(dataset="phantom"), 0.5))
    (given / "open" / "metrics.csv").unlink()
    (given / "planted" / "metrics.csv").write_text("a,b\n", encoding="utf-8")
    found = compare_all(reference, given)
    assert (found.verdict, found.exit_code) == (REFUSED, 2)
    assert set(found.refused()) == {"open", "planted"}
    assert "open/metrics.csv only in" in found.refused()["open"]
    assert not found.compared()["phantom"].agrees
    assert "phantom: compared" in found.report()
    assert "- `planted`: " in found.markdown()
    assert json.loads(found.json())["datasets"]["open"]["verdict"] == REFUSED
    suites = {suite.name: suite for suite in JUnitXml.fromstring(found.junit())}
    assert [isinstance(case.result[0], Error) for case in suites["open"]] == [True]
    assert suites["open"].errors == 1


def test_an_empty_folder_cannot_be_compared(reference, tmp_path):
    (tmp_path / "empty").mkdir()
    for pair in ((reference, tmp_path / "empty"), (tmp_path / "empty", reference)):
        found = compare_all(*pair)
        assert found.exit_code == 2
        assert set(found.parts) == {"open", "phantom", "planted"}
        assert all("expected metrics.csv in" in why for why in found.refused().values())
        assert JUnitXml.fromstring(found.junit()).errors == 3
    assert compare_all(tmp_path / "empty", tmp_path / "nowhere").exit_code == 2


def test_the_reference_agrees_with_itself_and_half_a_millimetre_turns_claims(tmp_path):
    """On the committed numbers: a shift of the graph by 0.5 mm of its Hausdorff distance is no rounding."""
    rows = read_metrics(REFERENCE / "phantom" / "metrics.csv")
    rows.loc[(rows["method"] == "skeleton_graph") & (rows["metric"] == "hd"), "value"] += 0.5
    write_metrics(rows.to_dict("records"), tmp_path / "metrics.csv")
    assert compare_all(REFERENCE / "phantom", REFERENCE / "phantom").exit_code == 0
    found = compare_all(REFERENCE / "phantom", tmp_path)
    assert found.exit_code == 1
    assert "| phantom, hd, places " in found.markdown()
    assert any(told.startswith("phantom, hd: by mean") for told in found.compared()["."].upsets)
