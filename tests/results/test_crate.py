"""The RO-Crate of a run's folder, as the library that defines it reads it."""

import json
import shutil
from datetime import UTC, datetime, timedelta
from importlib.resources import files

import pytest
import requests
from result_rows import some_rows
from rocrate.rocrate import ROCrate

from study.methods.icp import Icp
from study.results.claim import claimed
from study.results.crate import CRATE, PROFILE
from study.results.provenance import provenance
from study.results.run import Run, write_run

STARTED = datetime(2024, 1, 1, tzinfo=UTC)
TABLE_FILES = {"hd_table.csv", "hd_table.md", "hd_table.tex"}


def written(folder, manifest, days=0):
    timing = {"dataset": "phantom", "source": "ct1", "target": "patient", "method": "icp", "seed": 0}
    timings = [{**timing, "stage": "register", "seconds": 0.5 + 100 * days}]
    start = STARTED + timedelta(days=days)
    record = provenance("phantom", {"study": {}, "methods": {"icp": Icp()}}, 0, {"lung1_ct": "ab"}, start, start)
    with claimed(folder) as claim:
        return write_run(claim, some_rows(), timings, record, "trace", {"manifest.yaml": manifest})


@pytest.fixture
def made(tmp_path):
    (tmp_path / "my_manifest.yaml").write_text("cohorts: {}\n", encoding="utf-8")
    return written(tmp_path / "run", tmp_path / "my_manifest.yaml")


def test_the_library_reads_it_and_finds_every_file(made):
    crate = ROCrate(str(made.folder))
    described = {entity.id for entity in crate.data_entities if entity.id != "./"}
    there = {path.name for path in made.folder.iterdir()}
    assert described == there - {CRATE}
    assert described >= {"metrics.csv", "parameters.json", "manifest.yaml", "provenance.json", "failures.log"}
    assert described >= TABLE_FILES
    root = crate.root_dataset
    assert root["conformsTo"].id == PROFILE
    assert root.datePublished == STARTED
    assert root["license"].id.endswith("MIT")
    action = root["mentions"][0] if isinstance(root["mentions"], list) else root["mentions"]
    assert action.type == "CreateAction"
    assert action["instrument"].type == "SoftwareApplication"
    assert action["instrument"]["identifier"] == f"sha256:{made.provenance['code_sha256']}"
    assert {entity.id for entity in action["object"]} == {
        "parameters.json",
        "manifest.yaml",
        "#dataset",
        "#seed",
        "#input/lung1_ct",
    }
    assert {entity.id for entity in action["result"]} == described - {"parameters.json", "manifest.yaml"}
    assert action["startTime"] == action["endTime"] == STARTED.isoformat()


def validation(folder, monkeypatch):
    """What the profile's validator finds; the JSON-LD context that it asks for comes from the library's own copy."""
    from rocrate_validator import services
    from rocrate_validator.models import Severity

    context = files("rocrate").joinpath("data/ro-crate.jsonld").read_bytes()

    def answer(_session, _method, url, **_options):
        response = requests.Response()
        response.status_code, response.url, response._content = 200, url, context
        response.headers["Content-Type"] = "application/ld+json"
        return response

    monkeypatch.setattr(requests.Session, "request", answer)
    settings = services.ValidationSettings(
        rocrate_uri=str(folder), profile_identifier="process-run-crate-0.5", requirement_severity=Severity.REQUIRED
    )
    return services.validate(settings)


def test_the_validator_of_the_profile_finds_no_fault(made, monkeypatch):
    pytest.importorskip(
        "rocrate_validator", reason="roc-validator is not installed; CI runs it in an environment of its own"
    )
    with monkeypatch.context() as patch:
        found = validation(made.folder, patch)
        assert [issue.message for issue in found.get_issues()] == []
        assert found.passed()
    content = json.loads((made.folder / CRATE).read_text(encoding="utf-8"))
    action = next(entity for entity in content["@graph"] if entity["@type"] == "CreateAction")
    del action["instrument"]
    (made.folder / CRATE).write_text(json.dumps(content), encoding="utf-8")
    assert not validation(made.folder, monkeypatch).passed()


def test_every_name_leads_somewhere(made):
    graph = json.loads((made.folder / CRATE).read_text(encoding="utf-8"))["@graph"]
    ids = [entity["@id"] for entity in graph]
    assert len(ids) == len(set(ids))

    def named(value):
        if isinstance(value, dict):
            return {value["@id"]}
        return set().union(*map(named, value)) if isinstance(value, list) else set()

    outside = {name for entity in graph for value in entity.values() for name in named(value)} - set(ids)
    assert outside == {"https://w3id.org/ro/crate/1.1"}


def test_it_is_held_to_its_hash_and_follows_the_figures(made):
    assert made.altered is None
    made.keep_figures({"waypoints.png": b"picture", "p03#1.png": b"of a further sweep"})
    (made.folder / "50_study.ipynb").write_text("{}", encoding="utf-8")
    made.keep_figures({"hausdorff.png": b"another"})
    crate = ROCrate(str(made.folder))
    assert {"waypoints.png", "hausdorff.png", "50_study.ipynb"} <= {entity.id for entity in crate.data_entities}
    assert crate.dereference("waypoints.png")["contentSize"] == "7"
    assert crate.dereference("p03%231.png")["name"] == "p03#1.png"
    assert Run(made.folder).altered is None
    (made.folder / CRATE).write_text("{}", encoding="utf-8")
    assert "edited ro-crate-metadata.json" in Run(made.folder).altered


def test_two_runs_differ_in_its_dates_alone(made, tmp_path):
    later = written(tmp_path / "later", tmp_path / "my_manifest.yaml", days=1)
    first, second = ((run.folder / CRATE).read_text(encoding="utf-8") for run in (made, later))
    assert first != second
    assert first.replace("2024-01-01", "2024-01-02") == second
    shutil.rmtree(later.folder)
    again = written(tmp_path / "later", tmp_path / "my_manifest.yaml")
    assert (again.folder / CRATE).read_text(encoding="utf-8") == first
