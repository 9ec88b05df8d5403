"""Which pairs of a data set a picture shows: chosen by rule, the same for every profile and seed."""

from __future__ import annotations

from collections.abc import Sequence

from study.errors import StudyError
from study.results.run import REFERENCE, Run


def typical_and_worst(
    dataset: str, among: Sequence[tuple[str, str]], method: str = "skeleton_graph"
) -> tuple[tuple[str, str], tuple[str, str]]:
    """The pairs of a data set with the median and with the largest mean waypoint error, by the paper's protocol.

    The committed reference says which they are, so that every profile and seed shows the same people. A data set
    without one has its first pair for both.

    Args:
        dataset: its name.
        among: pairs to choose from: a smaller profile has fewer.
        method: whose error.

    Returns:
        source and target of each; of two pairs in the middle the smaller error is the typical one.

    Raises:
        StudyError: no pair to choose from.
    """
    if not among:
        raise StudyError(f"{dataset}: expected pairs to choose from, got none; take a larger profile")
    folder = REFERENCE / dataset
    if not (folder / "metrics.csv").is_file():
        return among[0], among[0]
    errors = Run(folder).per_pair.loc["waypoint_error"][method].dropna().sort_values(kind="stable")
    pairs = [(str(source), str(target)) for source, target in errors.index if (source, target) in set(among)]
    if not pairs:
        return among[0], among[0]
    return pairs[(len(pairs) - 1) // 2], pairs[-1]
