"""Intervals over people: by how much a mean, or a difference of two methods, would move with other people (sec. IV).

Pairs are not independent: a person is in several, as CT, as patient or both, and sweeps of one patient share that
patient. So people are drawn with replacement and not pairs: a pair counts as often as the product of its two ends does
(a node or pigeonhole bootstrap; Owen, The Annals of Applied Statistics 1 (2007) 386-411). Sweeps, seeds and planted
deformations of one person are averaged first. No p-value is given anywhere.

What such an interval can say depends on the people:

- People who are CT and patient are drawn once for both. Those who are only one are drawn among their like.
- A role that one person plays alone cannot be resampled. `phantom` has one patient, so its intervals hold for other CTs
  of that patient. `planted` has one CT, and its patients are deformations of that one person: its intervals hold for
  other deformations, and say nothing of other people.
- Plain percentiles are too narrow for few people, so they are moved outwards as Student's t asks for (Hesterberg, The
  American Statistician 69 (2015) 371-386). With four or five people these are nearly the extremes of all draws: the
  interval is wide and rough, cannot reach beyond the most unusual person, and still covers less than 95 %.
  `Interval.is_rough` says so, below `FEW` people.
- Where the noise of single pairs outweighs the differences between people, it is wider than need be.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import norm, t

from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.naming import person_of
from study.seeds import named_rng
from study.types import Floats

N_DRAWS = 4000
LEVEL = 0.95
FEW = 8  # people; an interval over fewer is called rough
ENDS = ["source", "target"]

# Of values (n, k) and weights (draws, n): a number a draw.
Statistic = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True)
class Interval:
    """A number and how far it would move with other people.

    Attributes:
        value: over the people there are.
        low, high: its 95 % interval; NaN where nobody can be resampled.
        n_pairs: pairs of people behind it; a pair's sweeps count once.
        n_people: that could be resampled; of two roles, the fewer.
    """

    value: float
    low: float
    high: float
    n_pairs: int
    n_people: int

    @property
    def is_known(self) -> bool:
        """Whether there are ends to it."""
        return bool(np.isfinite([self.value, self.low, self.high]).all())

    @property
    def is_rough(self) -> bool:
        """Whether too few people are behind it for its 95 % to be taken at their word."""
        return self.n_people < FEW

    def is_tie(self, resolution: float) -> bool:
        """Of a difference: whether its interval holds 0, is not known, or it is no larger than ``resolution``."""
        return not self.is_known or self.low <= 0 <= self.high or abs(self.value) <= resolution

    def __str__(self) -> str:
        """``"2.13 [1.90, 2.41]"``."""
        ends = f" [{_signed(self.low)}, {_signed(self.high)}]" if self.is_known else ""
        return f"{_signed(self.value)}{ends}"


def _signed(value: float) -> str:
    """Two decimals; what rounds to 0 has no sign."""
    text = f"{value:.2f}"
    return text if float(text) else "0.00"


def weighted_mean(values: Floats, weights: Floats) -> Floats:
    """Mean (draws,) of values (n, 1) with weights (draws, n)."""
    return np.asarray(weights @ values[:, 0] / weights.sum(axis=1))


def over_people(
    table: pd.DataFrame | pd.Series, statistic: Statistic = weighted_mean, *, seed: int = 0, n_draws: int = N_DRAWS
) -> Interval:
    """A statistic of pairs with its 95 % interval over people.

    Args:
        table: index with the levels ``source`` and ``target``; what the statistic takes as columns. Rows of the same
            two people (sweeps, seeds, planted deformations) are averaged.
        statistic: of values (n, k) and weights (draws, n).
        seed: of the draws; the same people give the same draws, so intervals of several methods can be compared.
        n_draws: how often people are drawn.

    Raises:
        StudyError: a table without a row, or with values that are not finite.
    """
    frame = table.to_frame() if isinstance(table, pd.Series) else table
    if frame.empty or not np.isfinite(frame.to_numpy(dtype=np.float64)).all():
        raise StudyError(f"expected pairs with finite values, got {len(frame)} rows; leave out the cases that failed")
    people = [[person_of(str(name)) for name in frame.index.get_level_values(end)] for end in ENDS]
    cells = frame.groupby(people).mean()
    values = cells.to_numpy(dtype=np.float64)
    value = float(statistic(values, np.ones((1, len(cells))))[0])
    weights, n_people = draw_weights(cells.index, named_rng(seed, "people"), n_draws)
    if not n_people:
        return Interval(value, np.nan, np.nan, len(cells), 0)
    tail = 100 * float(norm.cdf(-np.sqrt(n_people / (n_people - 1)) * t.ppf((1 + LEVEL) / 2, n_people - 1)))
    low, high = np.percentile(statistic(values, weights), [tail, 100 - tail])
    return Interval(value, float(low), float(high), len(cells), n_people)


def draw_weights(pairs: pd.Index, rng: np.random.Generator, n_draws: int) -> tuple[Floats, int]:
    """How often each pair of people counts when people are drawn with replacement.

    Args:
        pairs: two levels, the people of each pair; somebody paired with a deformation of themselves counts once.
        rng: of the draws.
        n_draws: how many; those in which no pair is left are dropped.

    Returns:
        weights (draws, pairs), and the people of the smallest role that could be resampled; 0 if none could.
    """
    sources, targets = (pairs.get_level_values(level) for level in (0, 1))
    both = set(sources) & set(targets)
    roles = [sorted(both), sorted(set(sources) - both), sorted(set(targets) - both)]
    drawn = [role for role in roles if len(role) > 1]
    counts = {name: np.ones(n_draws) for role in roles for name in role}
    for role in drawn:
        of_role = rng.multinomial(len(role), np.full(len(role), 1 / len(role)), size=n_draws)
        counts |= dict(zip(role, of_role.T.astype(np.float64), strict=True))
    ends = zip(sources, targets, strict=True)
    weights = np.stack([counts[a] if a == b else counts[a] * counts[b] for a, b in ends], axis=1)
    return weights[weights.any(axis=1)], min((len(role) for role in drawn), default=0)


def mean_intervals(per_pair: pd.DataFrame, **how: Any) -> pd.DataFrame:
    """Every method's mean with its interval over the pairs that it has.

    Args:
        per_pair: one metric of `study.results.Run.per_pair`: index source, target; a column a method.
        how: ``seed`` and ``n_draws`` of `over_people`.

    Returns:
        index method; columns ``value``, ``low``, ``high``, ``n_pairs``, ``n_people``, ``is_rough``.
    """
    present = [name for name in per_pair if per_pair[name].notna().any()]
    found = {str(name): over_people(per_pair[name].dropna(), **how) for name in present}
    return _as_table(found)


def difference_intervals(per_pair: pd.DataFrame, reference: str, resolution: float = 0.0, **how: Any) -> pd.DataFrame:
    """``reference`` minus every other method, each on the pairs where both have a value, with intervals.

    Args:
        per_pair: as for `mean_intervals`.
        reference: the method compared.
        resolution: a smaller difference is a tie, whatever its interval; ``mean_tolerance`` of the metric.
        how: ``seed`` and ``n_draws`` of `over_people`.

    Returns:
        as `mean_intervals`, and ``is_tie``.
    """
    found = {}
    for other in [name for name in per_pair if name != reference]:
        both = per_pair[[reference, other]].dropna()
        if len(both):
            found[str(other)] = over_people(both[reference] - both[other], **how)
    return _as_table(found).assign(is_tie=[interval.is_tie(resolution) for interval in found.values()])


def interval_text(row: pd.Series, digits: int = 2) -> str:
    """A row of `mean_intervals` or `difference_intervals` as ``"2.13 [1.90, 2.41]"``; unknown ends stay out."""
    ends = "" if pd.isna(row["low"]) else f" [{row['low']:.{digits}f}, {row['high']:.{digits}f}]"
    return f"{row['value']:.{digits}f}{ends}"


def _as_table(found: Mapping[str, Interval]) -> pd.DataFrame:
    columns = ("value", "low", "high", "n_pairs", "n_people", "is_rough")
    rows = [[getattr(interval, name) for name in columns] for interval in found.values()]
    return pd.DataFrame(rows, index=pd.Index(found, name="method"), columns=columns)


def paired_intervals(runs: Mapping[str, pd.DataFrame], metric: str, reference: str) -> pd.DataFrame:
    """One method against every other on each pair where both have a value, in words.

    Args:
        runs: `study.results.Run.per_pair` by data set; those without the metric or the method are left out.
        metric: one of ``METRICS``.
        reference: the method compared.

    Returns:
        columns ``method``, ``metric`` (its title), ``against``, ``dataset`` and ``verdict``: mean difference with its
        interval over people, on how many pairs ``reference`` is better, and whether that is a tie.
    """
    rows = []
    unit, resolution = METRICS[metric].unit, METRICS[metric].mean_tolerance
    for name, per_pair in runs.items():
        if metric not in per_pair.index.get_level_values("metric") or reference not in per_pair.columns:
            continue
        table = per_pair.loc[metric]
        for other in [column for column in table.columns if column != reference]:
            both = table[[reference, other]].dropna()
            if both.empty:
                continue
            found = over_people(both[reference] - both[other])
            better = int((both[other] - both[reference] > resolution).sum())
            verdict = f"{found} {unit}, better on {better} of {len(both)}{', a tie' * found.is_tie(resolution)}"
            rows.append([reference, METRICS[metric].title, other, name, verdict])
    return pd.DataFrame(rows, columns=["method", "metric", "against", "dataset", "verdict"])
