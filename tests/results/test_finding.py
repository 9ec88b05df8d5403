"""The finding's sentences stand only as long as the numbers bear them out."""

from functools import cached_property

import pandas as pd
import pytest

from study.datasets import reported
from study.results import REFERENCE, Run
from study.results.finding import NotBorneOut, in_short, metric_table, reading, small_table


class Changed(Run):
    """The reference with one method's Hausdorff distances made larger, or without one method."""

    @cached_property
    def metrics(self) -> pd.DataFrame:
        rows = super().metrics.copy()
        worse = (rows["method"] == "skeleton_graph") & (rows["metric"] == "hd")
        rows.loc[worse, "value"] += 20.0
        return rows


class Fewer(Run):
    @cached_property
    def metrics(self) -> pd.DataFrame:
        rows = super().metrics
        return rows[rows["method"] != "bcpd"]


@pytest.fixture(scope="module")
def runs() -> dict[str, Run]:
    return {name: Run(REFERENCE / name) for name in reported()}


def test_the_reference_says_what_the_readme_says(runs: dict[str, Run]) -> None:
    text = reading(runs)
    root = REFERENCE.parents[1]
    assert text.count("\n") == 3
    assert text in (root / "docs" / "evidence.md").read_text(encoding="utf-8")
    assert in_short(runs, "phantom") in (root / "README.md").read_text(encoding="utf-8")
    assert small_table(runs["phantom"]) in (root / "README.md").read_text(encoding="utf-8")


def test_other_numbers_or_fewer_methods_are_not_described(runs: dict[str, Run]) -> None:
    with pytest.raises(NotBorneOut, match="the numbers no longer bear that out"):
        reading({**runs, "open": Changed(REFERENCE / "open")})
    with pytest.raises(NotBorneOut, match="expected also bcpd"):
        reading({**runs, "open": Fewer(REFERENCE / "open")})
    with pytest.raises(NotBorneOut, match="whose truth is known"):
        reading({"open": runs["open"]})


def test_a_columns_smallest_mean_is_bold_and_the_truth_is_not_a_method(runs: dict[str, Run]) -> None:
    lines = metric_table("true_waypoint_error", runs).splitlines()
    assert "open" not in lines[0]
    assert sum(line.count("**") for line in lines) == 4  # one method on each of two data sets
    (truth,) = [line for line in lines if line.startswith("| `truth`")]
    assert "**" not in truth
