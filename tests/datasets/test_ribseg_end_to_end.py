"""`study run --dataset ribseg` on loopback: archives under the real names, phantom CTs, RibSeg's rib labels."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from http_archive import RIBFRAC_PATH, ArchiveServer, rebased_manifest, ribfrac_zip, ribseg_zip
from phantom_files import SMALL, nifti, ribseg_labels, scan, structure_ids

from study.batch import run_study
from study.data.manifest import load_manifest
from study.datasets import find_dataset
from study.files.atomic import sha256_of
from study.files.volumes import read_labels
from study.results.metrics_csv import FAILED, read_metrics

SCANS = {421: "ct1", 441: "ct2"}
DAMAGED = 461
METHODS = ("coarse", "icp")


def run(folder: Path) -> tuple[Path, Path, ArchiveServer]:
    """Results of a run, its manifest, and the server it fetched from; one of the three scans is damaged."""
    images, labels = {}, {}
    for number, name in SCANS.items():
        image, ids = scan(name)
        images[number] = nifti(image, folder / "made" / f"{number}.nii.gz").read_bytes()
        labels[number] = nifti(ribseg_labels(ids), folder / "made" / f"{number}-ribs.nii.gz").read_bytes()
    images[DAMAGED], labels[DAMAGED] = images[421][:-5000], labels[421]
    with pytest.MonkeyPatch.context() as patch, ArchiveServer() as server:
        patch.setenv("STUDY_DATA_DIR", str(folder / "data"))
        patch.setenv("NO_PROXY", "127.0.0.1")
        server.files[RIBFRAC_PATH] = ribfrac_zip(images)
        (folder / "ribseg_v2.zip").write_bytes(ribseg_zip(labels))
        sha256 = sha256_of(folder / "ribseg_v2.zip")
        path = rebased_manifest(folder / "manifest.yaml", server.url, keep=["ribseg"], ribseg_sha256=sha256)
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
        subjects = raw["cohorts"]["ribseg"]["subjects"]
        raw["cohorts"]["ribseg"]["subjects"] = {f"ribfrac{n}": subjects[f"ribfrac{n}"] for n in (*SCANS, DAMAGED)}
        path.write_text(yaml.safe_dump(raw), encoding="utf-8")
        manifest = load_manifest(path)
        params = replace(SMALL, max_sources=0, max_targets=0)
        people = find_dataset("ribseg", params, manifest=manifest)
        run_study(people, folder / "out", methods=METHODS)
        files = people.files("ribfrac421")
        assert read_labels(files["ribseg421_ribs"]).values.max() <= 24
    return folder / "out", path, server


def test_the_labels_hold_ribs_only_numbered_from_the_right() -> None:
    """The stand-in is what RibSeg gives: no cartilage, no sternum, right ribs first."""
    _, labels = scan("ct1")
    ribs = ribseg_labels(labels)
    ids = structure_ids()
    assert set(np.unique(ribs.values)) == {0, *range(1, 8), *range(13, 20)}  # seven ribs reach the front
    assert np.array_equal(ribs.values == 2, labels.values == ids["rib_right_2"])
    assert np.array_equal(ribs.values == 14, labels.values == ids["rib_left_2"])
    where = [ribs.to_mm(np.argwhere(ribs.values == rib)).mean(axis=0) for rib in (2, 14)]
    assert where[0][0] > where[1][0]  # RAS+: x grows to the right
    assert not (ribs.values[np.isin(labels.values, [ids["sternum"], ids["costal_cartilages"]])]).any()


def check_every_pair_of_whole_scans_ran_with_every_method(out: Path) -> None:
    metrics = read_metrics(out / "metrics.csv")
    whole = metrics[~metrics["status"].str.startswith(FAILED)]
    cases = whole.groupby(["source", "target", "method"]).size()
    assert set(cases.index) == {
        (f"ribfrac{a}", f"ribfrac{b}", method) for a, b in ((421, 441), (441, 421)) for method in METHODS
    }
    # distances, the same of the visible part, quality, and 20 waypoints of both by error, in the plane and in depth
    assert set(cases) == {3 + 3 + 5 + 2 * 3 * 20}
    assert set(whole["status"]) <= {"ok", "not converged"}
    assert set(whole[whole["method"] == "coarse"]["status"]) == {"ok"}
    errors = whole[whole["metric"] == "waypoint_error"].groupby("method")["value"].mean()
    assert errors.max() < 12.0  # two people, overlaid at their sternums; swapped levels are 30 mm apart


def check_the_damaged_scan_is_rows_with_its_reason(out: Path) -> None:
    metrics = read_metrics(out / "metrics.csv")
    failed = metrics[metrics["status"].str.startswith(FAILED)]
    assert len(failed) == 4 * len(METHODS)
    assert ((failed["source"] == "ribfrac461") | (failed["target"] == "ribfrac461")).all()
    assert failed["status"].str.contains("truncated or damaged").all()


def check_tables_print_their_n(out: Path) -> None:
    table = pd.read_csv(out / "hd_all_pairs.csv")
    ours = table[table["data"] == "this study"]
    assert ours["n"].to_list() == [2, 2]
    assert ours["n_failed"].to_list() == [4, 4]
    assert (out / "hd_table_ribfrac421.md").is_file()


def check_the_archive_was_read_by_ranges_and_the_inputs_are_on_record(
    out: Path, manifest: Path, server: ArchiveServer
) -> None:
    assert server.requests
    assert all(request.first is not None for request in server.requests)
    inputs = json.loads((out / "provenance.json").read_text(encoding="utf-8"))["inputs_sha256"]
    assert set(inputs) == {manifest.name} | {
        f"{kind}{number}_{what}"
        for number in (*SCANS, DAMAGED)
        for kind, what in (("ribfrac", "ct"), ("ribseg", "ribs"))
    }
    assert inputs["ribfrac421_ct"] == sha256_of(out.parent / "made" / "421.nii.gz")


def test_the_papers_data_goes_from_archive_to_table(tmp_path: Path) -> None:
    """One test, since it is one run: half a minute that two test processes should not both spend."""
    out, manifest, server = run(tmp_path)
    check_every_pair_of_whole_scans_ran_with_every_method(out)
    check_the_damaged_scan_is_rows_with_its_reason(out)
    check_tables_print_their_n(out)
    check_the_archive_was_read_by_ranges_and_the_inputs_are_on_record(out, manifest, server)
