"""Evidence goes on where it was stopped, comes to the same bytes, and leaves what is of now alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from study.batch import evidence
from study.batch.evidence import PLANS, EvidencePlan, run_evidence
from study.data.manifest import load_manifest
from study.datasets import for_evidence
from study.errors import StudyError
from study.evaluation.disturbances import KINDS, SEEDS, Disturbance
from study.evaluation.robustness import ERROR, FAILED, IN_PLANE
from study.evaluation.sensitivity import MEASURES, Setting
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.skeleton.som import SomParams

SHORT = SomParams(epochs=5, samples=20)
TINY = EvidencePlan(
    base=Disturbance(ct_points=1500, us_points=1500),
    kinds=("noise", "strips"),
    ends_only=True,
    people=SEEDS[2:3],
    methods=("coarse",),
    tried_on=SEEDS[2:3],
    method_seeds=(0,),
    graph=SkeletonGraphMethod(SHORT, SHORT),
    choices=("random draws", "parts of a cartilage (waypoints)"),
)
FILES = ("summary.csv", "draws.csv", "refused.csv")


ASKED: list[tuple[float, int]] = []


def cheap_levels(disturbance: Disturbance, draw: int, methods: tuple[str, ...]) -> list[dict[str, Any]]:
    """As `robustness_rows`, in no time."""
    ASKED.append((disturbance.noise_mm, disturbance.strips))
    what = {"draw": draw, "status": "ok", "reason": "", "value": 1 / 3 + disturbance.noise_mm}
    return [{**what, "method": method, "metric": metric} for method in methods for metric in (ERROR, IN_PLANE)]


def cheap_choices(people: int, listed: list[Setting], seeds: tuple[int, ...], _: object) -> list[dict[str, Any]]:
    """As `sensitivity_rows`."""
    what = {"people": people, "reason": ""}
    return [
        {
            **what,
            "choice": o.choice,
            "option": o.option,
            "role": o.role,
            "seed": s,
            "metric": m,
            "value": 1 / len(o.option),
        }
        for o in listed
        for s in seeds
        for m in MEASURES
    ]


@pytest.fixture(autouse=True)
def cheap(monkeypatch: pytest.MonkeyPatch) -> None:
    ASKED.clear()
    monkeypatch.setattr(evidence, "datasets_for_evidence", list)
    monkeypatch.setattr(evidence, "robustness_rows", cheap_levels)
    monkeypatch.setattr(evidence, "sensitivity_rows", cheap_choices)


def contents(folders: list[Path]) -> dict[str, bytes]:
    names = [(folder, name) for folder in folders for name in (*FILES, f"{folder.name}.png")]
    return {f"{folder.name}/{name}": (folder / name).read_bytes() for folder, name in names}


def test_a_stopped_run_goes_on_and_comes_to_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run_evidence(tmp_path / "whole", plan=TINY)
    expected = contents(whole)
    assert [folder.name for folder in whole] == ["robustness", "sensitivity"]
    assert ASKED == [(0.0, 0), (4.0, 0), (0.5, 0), (0.5, 16)]

    def stopped(*arguments: Any) -> list[dict[str, Any]]:
        if len(ASKED) == 2:
            raise KeyboardInterrupt
        return cheap_levels(*arguments)

    ASKED.clear()
    monkeypatch.setattr(evidence, "robustness_rows", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_evidence(tmp_path / "again", plan=TINY)
    monkeypatch.setattr(evidence, "robustness_rows", cheap_levels)
    again = run_evidence(tmp_path / "again", plan=TINY)
    assert ASKED == [(0.0, 0), (4.0, 0), (0.5, 0), (0.5, 16)]  # nothing twice
    assert contents(again) == expected
    assert not list(tmp_path.rglob(".*"))

    run_evidence(tmp_path / "again", plan=TINY)  # of now: left as it is
    assert len(ASKED) == 4
    (again[0] / "summary.csv").write_text("edited", encoding="utf-8")
    assert contents(run_evidence(tmp_path / "again", plan=TINY)) == expected
    record = json.loads((again[0] / "provenance.json").read_text(encoding="utf-8"))
    assert record["parameters"]["people"] == [SEEDS[2]]
    assert len(record["parameters"]["levels"]) == 4


def test_a_case_that_nobody_foresaw_to_fail_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(disturbance: Disturbance, *others: Any) -> list[dict[str, Any]]:
        if disturbance.strips == 16:
            raise ZeroDivisionError("a bug")
        return cheap_levels(disturbance, *others)

    monkeypatch.setattr(evidence, "robustness_rows", broken)
    folder = run_evidence(tmp_path, plan=TINY)[0]
    summary = pd.read_csv(folder / "summary.csv")
    failed = summary.groupby(["kind", "level"])["failed"].max().to_dict()
    assert failed == {("noise", 0.0): 0, ("noise", 4.0): 0, ("strips", 0.0): 0, ("strips", 16.0): 1}
    draws = pd.read_csv(folder / "draws.csv")
    assert list(draws) == ["kind", "level", "draw", "method", "metric", "value", "status"]
    assert (draws["status"] == FAILED).sum() == 2
    assert "ZeroDivisionError: a bug" in (folder / "refused.csv").read_text(encoding="utf-8")


def test_the_full_plan_has_every_level_choice_and_twenty_draws() -> None:
    full = PLANS["full"]
    assert {level.kind for level in full.levels()} == set(KINDS)
    assert len(full.people) >= 20
    assert len(full.method_seeds) > 1
    assert len(full.settings()) > len(PLANS["quick"].settings()) > 5


def test_a_choice_that_is_none_is_refused() -> None:
    with pytest.raises(StudyError, match="got luck"):
        EvidencePlan(choices=("luck",)).settings()


def test_the_manifest_says_which_data_sets_are_evidence() -> None:
    manifest = load_manifest()
    flagged = manifest.cohorts["open"].model_copy(update={"evidence": True})
    other = manifest.model_copy(update={"cohorts": {**manifest.cohorts, "more": flagged}})
    assert for_evidence(other) == [*for_evidence(manifest), "more"]
