"""How people are cut, told without reading an image; growth beside labels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from phantom_files import SMALL, own_manifest, scan

from study.ct.parts import on_grid
from study.data.manifest import load_manifest
from study.data.schema import SubjectEntry
from study.datasets import Anatomy, CohortDataset, Cut, find_dataset
from study.datasets.cut import cut_of, cut_parts
from study.errors import StudyError


def test_everybody_reported_says_how_they_are_cut() -> None:
    people = find_dataset("open")
    assert people.with_ct() == list(load_manifest().cohort("open").subjects)
    cuts = {name: people.cut(name) for name in people.with_ct()}
    assert cuts["lidc-0001"] == Cut("labels", "found by a network, not drawn by hand")
    others = [cut for name, cut in cuts.items() if name != "lidc-0001"]
    assert {cut.by for cut in others} == {"landmarks"}
    assert all(cut.is_done and "authors" in cut.made_by and cut.hard_to_see for cut in others)


def test_a_planted_patient_is_cut_as_its_origin_and_a_phantom_exactly() -> None:
    planted = find_dataset("planted")
    assert planted.with_ct() == ["lidc-0001"]
    assert planted.cut("planted3") == planted.cut("lidc-0001") == find_dataset("open").cut("lidc-0001")
    made = find_dataset("phantom")
    assert made.with_ct() == ["ct1", "ct2", "ct3", "ct4", "ct5", "patient"]
    assert made.cut("ct1").by == "labels, exact"


@pytest.mark.parametrize("dataset", ["open", "planted", "phantom"])
def test_an_unknown_name_is_refused(dataset: str) -> None:
    people = find_dataset(dataset)
    image, _ = scan("ct1")
    with pytest.raises(StudyError, match="got 'ct9'"):
        people.cut("ct9")
    with pytest.raises(StudyError, match="got 'ct9'"):
        people.grown("ct9", image)


def test_rib_labels_and_landmarks_that_are_not_there_yet() -> None:
    manifest = load_manifest()
    ribs = cut_of(manifest, manifest.cohort("ribseg").subjects["ribfrac421"])
    assert (ribs.by, ribs.hard_to_see) == ("rib labels", "")
    assert ribs.made_by
    waiting = cut_of(manifest, SubjectEntry(ct="lung1_ct", landmarks="annotations/nobody.yaml"))
    assert waiting == Cut("not yet", "waits for annotations/nobody.yaml")
    assert not waiting.is_done
    with pytest.raises(StudyError, match="expected labels, rib_labels or landmarks for 'lung1_ct'"):
        cut_parts(manifest, SubjectEntry(ct="lung1_ct"), scan("ct1")[0])


def test_growth_sees_the_ribs_and_agrees_with_the_labels_of_cartilage(tmp_path: Path) -> None:
    mine = find_dataset(str(own_manifest(tmp_path)), SMALL)
    anatomy = mine.anatomy("ct1")
    assert anatomy.image is not None
    assert anatomy.mask is not None
    grown = mine.grown("ct1", anatomy.image)
    assert grown is not None
    one, other = (on_grid(mask, anatomy.image).values >= 0 for mask in (grown, anatomy.mask))
    assert 0.6 < 2 * (one & other).sum() / (one.sum() + other.sum()) < 1
    # Where no label tells cartilage, or all of it is exact, there is nothing to compare.
    assert find_dataset("phantom", SMALL).grown("ct1", anatomy.image) is None
    assert find_dataset("open", SMALL).grown("lung1", anatomy.image) is None


def test_anatomies_leave_out_who_cannot_be_read_and_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def anatomy(self: CohortDataset, name: str, origin: Anatomy | None = None) -> Anatomy:
        if name == "lung1":
            raise StudyError("no network")
        return replace(blank, name=name)

    blank = Anatomy("", *(np.empty(0) for _ in range(3)))  # type: ignore[arg-type]
    monkeypatch.setattr(CohortDataset, "anatomy", anatomy)
    people, left_out = find_dataset("open").anatomies(["lidc-0001", "lung1", "lung2"])
    assert list(people) == ["lidc-0001", "lung2"]
    assert people["lung2"].name == "lung2"
    assert left_out == {"lung1": "no network"}
