import json
from datetime import UTC, datetime

import numpy as np
import pytest

from study.files.atomic import sha256_of, write_json
from study.methods.icp import Icp
from study.results.provenance import provenance


def test_provenance_holds_what_a_reader_needs(tmp_path):
    (tmp_path / "environment.lock").write_text("numpy==2.0\n")
    start, end = datetime(2024, 1, 1, 12, tzinfo=UTC), datetime(2024, 1, 1, 12, 1, tzinfo=UTC)
    record = provenance(
        "d", {"icp": Icp(), "grid": np.arange(2), "out": tmp_path}, 7, {"ct": "ab"}, start, end, tmp_path
    )
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
    commit = provenance("d", {}, 0, {}, now, now)["commit"]
    if commit is None:
        pytest.skip("not a git checkout")
    assert len(commit) == 40
