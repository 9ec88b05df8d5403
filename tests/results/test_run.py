import json
from datetime import UTC, datetime

import pytest
from result_rows import SOURCES, some_rows

from study.errors import StudyError
from study.files.atomic import write_json
from study.methods.icp import Icp
from study.results.claim import claimed
from study.results.metrics_csv import Case, metric_rows, write_metrics
from study.results.provenance import provenance
from study.results.run import Run, find_runs, run_folder, write_run


def test_a_run_goes_stale_with_its_code_its_parameters_and_its_seed(tmp_path):
    code = tmp_path / "src" / "study" / "som.py"
    code.parent.mkdir(parents=True)
    code.write_text("rate = 0.1\n")
    run, now = tmp_path / "run", datetime(2024, 1, 1, tzinfo=UTC)
    parameters = {"methods": {"icp": Icp()}}

    def why(parameters=parameters, seed=0, dataset="phantom", inputs=None):
        return Run(run).why_stale(dataset, parameters, seed, inputs, tmp_path)

    assert "no run" in why()
    write_metrics(metric_rows(Case("phantom", "ct1", "patient", "icp", 0), {"hd": 1.0}), run / "metrics.csv")
    assert "cannot be read" in why()
    record = provenance("phantom", parameters, 0, {"ct": "ab"}, now, now, tmp_path)
    write_json(record, run / "provenance.json")
    assert "older version" in why()
    write_json({**record, "files_sha256": {}}, run / "provenance.json")
    assert why() is None
    assert "the data set" in why(dataset="planted")
    assert "an input file" in why(inputs={"ct": "cd"})
    assert why(inputs={"ct": "ab"}) is None
    assert "the seed" in why(seed=1)
    assert "list of methods" in why({"methods": {"icp": Icp(max_iterations=3)}})
    code.write_text("rate = 0.2\n")
    assert "the code" in why()


def test_only_the_whole_study_at_seed_0_is_kept_as_the_run_of_a_dataset():
    folders = {run_folder(*chosen) for chosen in [("open", "full", 0), ("open", "quick", 0), ("open", "full", 1)]}
    assert len(folders) == 3
    assert {path.parent.name for path in folders} == {"runs", "trials"}


STARTED = datetime(2024, 1, 1, tzinfo=UTC)


def written(folder, rows, source="ct1"):
    timing = {"dataset": "phantom", "source": source, "target": "patient", "method": "icp", "seed": 0}
    timings = [{**timing, "stage": "register", "seconds": 0.5}]
    record = provenance("phantom", {"methods": {}}, 0, {"ct": "ab"}, STARTED, STARTED)
    with claimed(folder) as claim:
        return write_run(claim, rows, timings, record)


def test_a_run_is_its_folder(tmp_path):
    rows = some_rows(without=[("ct2", "icp")])
    run = written(tmp_path / "phantom", rows)
    assert len(run.metrics) == len(rows)
    assert run.dataset == "phantom"
    assert run.methods == ["icp", "skeleton_graph"]  # the order of METHODS
    assert not run.has_truth
    assert run.n_pairs == len(SOURCES)
    assert run.timings["seconds"].to_list() == [0.5]
    assert run.provenance["inputs_sha256"] == {"ct": "ab"}
    assert run.failures.to_dict("records") == [
        {
            "source": "ct2",
            "target": "patient",
            "method": "icp",
            "reason": "no sternum found in 'ct2': best overlap 0.31, need 0.60",
        }
    ]
    means = run.per_pair
    every = run.values.query("metric == 'waypoint_error' and source == 'ct1' and method == 'icp'")["value"]
    assert means.loc[("waypoint_error", "ct1", "patient"), "icp"] == every.mean()
    assert means.loc[("hd", "ct2", "patient")].isna()["icp"]
    assert (tmp_path / "phantom" / "hd_table.md").is_file()
    assert run.tables() == [tmp_path / "phantom" / "hd_table.md"]
    assert run.overview()["cases that failed"] == 1
    assert run.compare(run).agrees
    summary = run.summary()
    assert list(summary.columns) == run.methods
    assert summary.loc["Hausdorff distance (mm)", "icp"].endswith("(n=2)")


def test_one_ct_has_its_patients_as_columns(tmp_path):
    rows = [
        row
        for target in ("p1", "p2")
        for row in metric_rows(Case("d", "a", target, "icp", 0), {"hd": 9.0, "waypoint_error": [1.0, 2.0]})
    ]
    run = written(tmp_path, rows)
    assert list(run.hd_table().columns[:2]) == ["p1", "p2"]
    assert set(run.by_column()["source"]) == {"p1", "p2"}
    assert set(run.metrics["source"]) == {"a"}


def test_a_run_shows_itself_in_a_notebook(tmp_path):
    run = written(tmp_path / "a<b", some_rows())
    (run.folder / "waypoints.png").write_bytes(b"picture")
    html = run._repr_html_()
    assert "skeleton_graph" in html
    assert html.count("<img") == 1
    assert "<tr>" in html
    strange = Run(run.folder, "made <script>")._repr_html_()
    assert "<script>" not in strange


def test_runs_are_found_below_a_folder(tmp_path):
    for name in ("b", "a"):
        written(tmp_path / name, some_rows())
    assert [run.folder.name for run in find_runs(tmp_path)] == ["a", "b"]
    with pytest.raises(StudyError, match="got none"):
        find_runs(tmp_path / "nothing")


def test_two_datasets_in_a_folder_are_no_run(tmp_path):
    write_metrics(some_rows() + some_rows(dataset="open"), tmp_path / "metrics.csv")
    with pytest.raises(StudyError, match="rows of one dataset, got open, phantom"):
        _ = Run(tmp_path).dataset
    with pytest.raises(StudyError, match=r"provenance\.json, got"):
        _ = Run(tmp_path).provenance


def test_a_run_of_some_methods_has_a_folder_of_its_own(tmp_path):
    assert run_folder("open", "full", 0, None, tmp_path) == tmp_path / "results" / "runs" / "open"
    some = run_folder("open", "full", 0, ["icp", "cpd"], tmp_path)
    assert some == tmp_path / "results" / "trials" / "open-full-seed0-icp+cpd"


@pytest.mark.parametrize("harm", ["edited", "halved", "elsewhere", "lost", "table"])
def test_a_folder_whose_files_are_not_the_runs_is_not_current(tmp_path, harm):
    run = written(tmp_path / "run", some_rows())
    assert run.altered is None
    metrics = run.folder / "metrics.csv"
    text = metrics.read_text(encoding="utf-8")
    if harm == "edited":
        last = text.splitlines()[-1].split(",")
        metrics.write_text(text.replace(last[-3], repr(float(last[-3]) - 0.01)), encoding="utf-8")
    elif harm == "halved":
        metrics.write_text("".join(text.splitlines(keepends=True)[:60]), encoding="utf-8")
    elif harm == "elsewhere":
        write_metrics(some_rows(seed=1), metrics)
    elif harm == "lost":
        (run.folder / "timings.csv").unlink()
    else:
        (run.folder / "hd_table.md").write_text("| better |", encoding="utf-8")
    name = {"lost": "lost timings.csv", "table": "edited hd_table.md"}.get(harm, "edited metrics.csv")
    told = Run(run.folder).why_stale("phantom", {"methods": {}}, 0)
    assert told == f"the run has since been altered: {name}"
    assert Run(run.folder).condition in told


def test_an_older_provenance_is_told_and_no_crash(tmp_path):
    run = written(tmp_path / "run", some_rows())
    path = run.folder / "provenance.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    for name in ("files_sha256", "dataset"):
        del record[name]
    write_json(record, path)
    older = Run(run.folder)
    assert "older version" in older.condition
    assert older.overview()["pairs"] == len(SOURCES)
    path.write_text("{", encoding="utf-8")
    assert "provenance.json" in Run(run.folder).condition


def test_figures_belong_to_the_run_they_are_of(tmp_path):
    run = written(tmp_path / "run", some_rows())
    assert run.keep_figures({"waypoints.png": b"picture"}) == ["waypoints.png"]
    assert run.keep_figures({"waypoints.png": b"another"}) == ["waypoints.png"]
    assert Run(run.folder).altered is None
    assert "waypoints.png" in Run(run.folder).provenance["files_sha256"]
    (run.folder / "waypoints.png").write_bytes(b"edited")
    with pytest.raises(StudyError, match=r"edited waypoints\.png"):
        run.keep_figures({"hausdorff.png": b"picture"})
    later = written(tmp_path / "run", some_rows(seed=1))
    record = {**later.provenance, "finished": "later"}
    write_json(record, run.folder / "provenance.json")
    with pytest.raises(StudyError, match="got a later one"):
        run.keep_figures({"waypoints.png": b"picture"})
    assert not (run.folder / "waypoints.png").exists()  # a figure of an earlier run is not beside later metrics


def test_what_is_not_finished_is_not_found(tmp_path):
    written(tmp_path / "a", some_rows())
    write_metrics(some_rows(), tmp_path / ".b.unfinished" / "new" / "metrics.csv")
    assert [run.folder.name for run in find_runs(tmp_path)] == ["a"]
