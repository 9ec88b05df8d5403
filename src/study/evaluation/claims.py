"""The paper's claims, one at a time, each with what comes out of a run, and what the paper does not ask (sec. IV)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import pandas as pd

from study.evaluation.claim_questions import (
    BASELINES,
    GRAPH,
    MINUTES,
    NOT,
    PARTLY,
    TUNED,
    UNTESTABLE,
    Question,
    about,
    below,
    first,
    in_their_gap,
    kept_whole,
    number,
    same_easiest,
    steadiest,
)
from study.evaluation.intervals import Interval, over_people
from study.evaluation.metrics import METRICS

NOT_ASKED = "not asked: "
UNKNOWN = "–"

# As printed, mm: Table I; waypoints from the text (sec. IV-B).
PAPER: Mapping[str, Mapping[str, float]] = {
    "hd": {"icp": 17.35, "nonrigid_icp": 14.58, "cpd": 14.72, GRAPH: 9.48},
    "waypoint_error": {"icp": 4.78, "nonrigid_icp": 4.28, "cpd": 3.95, GRAPH: 2.21},
}
NAMES = {"icp": "ICP", "nonrigid_icp": "non-rigid ICP", "cpd": "CPD", GRAPH: "the skeleton graph"}


@dataclass(frozen=True)
class Finding:
    """What a run says of a claim.

    Attributes:
        interval: the claim's number with its interval over people.
        verdict: in the words of `claims_table`.
        shown: the number, or the count of pairs, as text.
    """

    interval: Interval
    verdict: str
    shown: str


@dataclass(frozen=True)
class Claim:
    """A claim, what the paper says of its own data, and how to read it off a run.

    Attributes:
        text: the claim, and in brackets what its number is.
        paper: the paper's outcome.
        ask: the question that it puts to rows of numbers; None where no run of any data set can answer it.
    """

    text: str
    paper: str
    ask: Callable[[pd.DataFrame], Question | None] | None

    @property
    def asked(self) -> bool:
        """Whether the paper makes it."""
        return not self.text.startswith(NOT_ASKED)

    def finding(self, rows: pd.DataFrame) -> Finding | None:
        """What rows of numbers say; None where they cannot tell.

        Args:
            rows: of one data set, columns metric, source, target, method and value; see `with_minutes`.
        """
        question = self.ask(rows) if self.ask else None
        if question is None:
            return None
        interval = over_people(question.table, question.statistic)
        return Finding(interval, question.judge(interval), question.count or str(interval))

    def outcome(self, rows: pd.DataFrame) -> str:
        """``"k of n"`` pairs, ``"yes"`` or ``"no"`` by the sign alone, `UNKNOWN` where rows cannot tell.

        Without an interval: what is told of two runs on two machines must not hang on the ends of one.
        """
        question = self.ask(rows) if self.ask else None
        if question is None:
            return UNKNOWN
        return question.count or ("yes" if question.point < 0 else "no")


def with_minutes(values: pd.DataFrame, timings: pd.DataFrame) -> pd.DataFrame:
    """Rows of numbers, and a row for the minutes of each registration as metric ``minutes``."""
    took = timings[timings["stage"] == "register"]
    took = took.assign(metric=MINUTES, index=0, value=took["seconds"] / 60)
    return pd.concat([values, took[["source", "target", "method", "metric", "index", "value"]]], ignore_index=True)


def _mean_claims(metric: str, title: str) -> list[Claim]:
    """The paper's means of a metric, and the differences of its method to the others."""
    paper = PAPER[metric]
    means = [
        Claim(f"{title} of {NAMES[name]} (mean, mm)", f"{value:.2f}", partial(number, metric=metric, method=name))
        for name, value in paper.items()
    ]
    differences = [
        Claim(
            f"{title} smaller than that of {NAMES[rival]} (difference of means, mm)",
            f"{paper[GRAPH] - paper[rival]:.2f}",
            partial(below, metric=metric, method=GRAPH, rival=rival),
        )
        for rival in BASELINES
    ]
    return [*means, *differences]


def _more(method: str, metrics: Sequence[str]) -> list[Claim]:
    """The graph as published against a method that the paper does not know, by several metrics."""
    return [
        Claim(
            f"{NOT_ASKED}{METRICS[metric].title} smaller than that of {method} (difference of means, mm)",
            UNKNOWN,
            partial(below, metric=metric, method=GRAPH, rival=method),
        )
        for metric in metrics
    ]


HD, PATH, TRUE, TRUE_PLANE = "hd", "waypoint_error", "true_waypoint_error", "true_waypoint_error_inplane"
PLANE = "waypoint_error_inplane"

CLAIMS: tuple[Claim, ...] = (
    # Sec. IV-A, Table I, abstract, conclusion.
    *_mean_claims(HD, "Hausdorff distance"),
    Claim("smallest Hausdorff distance on every CT (share of pairs)", "5 of 5", partial(first, metric=HD)),
    Claim(
        "steadiest Hausdorff distance over people (its SD minus that of the steadiest baseline, mm)",
        "-3.00",
        partial(steadiest, metric=HD),
    ),
    # Sec. IV-B, Fig. 4, abstract, conclusion.
    *_mean_claims(PATH, "waypoint error"),
    Claim("smallest mean waypoint error on every CT (share of pairs)", "5 of 5", partial(first, metric=PATH)),
    Claim(
        "smallest maximum waypoint error on every CT (share of pairs)", "5 of 5", partial(first, metric=PATH, of="max")
    ),
    Claim(
        "steadiest waypoint error over people (its SD over waypoints minus that of the steadiest baseline, mm)",
        "-1.22",
        partial(steadiest, metric=PATH),
    ),
    Claim(
        "ICP worst on most CTs, by waypoint error (share of pairs)",
        "4 of 5",
        partial(first, metric=PATH, method="icp", rivals=(GRAPH, *BASELINES), least=False, most=True),
    ),
    Claim(
        "waypoint error of CPD smaller than that of non-rigid ICP (difference of means, mm)",
        "-0.33",
        partial(below, metric=PATH, method="cpd", rival="nonrigid_icp"),
    ),
    Claim(
        "all four methods do best on the same CT, the one nearest in size and shape (share of patients)",
        "1 of 1",
        partial(same_easiest, metric=PATH),
    ),
    Claim(
        "non-rigid ICP much faster than CPD (difference of means, minutes)",
        "not said",
        partial(below, metric=MINUTES, method="nonrigid_icp", rival="cpd"),
    ),
    Claim(
        "CPD takes about 20 minutes a CT (mean, minutes)",
        "20",
        partial(about, metric=MINUTES, method="cpd", printed=20),
    ),
    Claim(
        "waypoints arrive in their intercostal space (share within 9 mm of its middle, in the feature plane)",
        "all, as drawn",
        in_their_gap,
    ),
    # Sec. I, contributions; sec. III-B, III-C.
    Claim(
        "continuity of the anatomy is preserved (share of neighbours torn or crushed)",
        "not measured",
        partial(kept_whole, metric="stretched_share"),
    ),
    Claim(
        "branches do not interfere with their neighbours (share of points on another cartilage)",
        "not measured",
        partial(kept_whole, metric="wrong_part_share"),
    ),
    Claim("better than registration of the skin's surface (sec. V)", "not measured", None),
    Claim("tracking lags behind the images by 268 ms (sec. II-B)", "268 ms", None),
    # What the paper does not ask.
    Claim(
        NOT_ASKED + "Hausdorff distance below all tuned baselines (share of pairs)",
        UNKNOWN,
        partial(first, metric=HD, rivals=TUNED),
    ),
    Claim(
        NOT_ASKED + "waypoint error below all tuned baselines (share of pairs)",
        UNKNOWN,
        partial(first, metric=PATH, rivals=TUNED),
    ),
    Claim(NOT_ASKED + "smallest error by the truth (share of pairs)", UNKNOWN, partial(first, metric=TRUE)),
    Claim(
        NOT_ASKED + "smallest error by the truth, tuned baselines too (share of pairs)",
        UNKNOWN,
        partial(first, metric=TRUE, rivals=TUNED),
    ),
    *_more("cpd_tuned", (HD, PATH, PLANE, TRUE_PLANE, TRUE)),
    *_more("cpd_tuned_whole", (HD, PATH, PLANE, TRUE_PLANE, TRUE)),
)


def claims_table(runs: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Every claim against every run.

    Args:
        runs: rows of numbers by data set, as `study.results.Run.values` gives them, or `with_minutes`.

    Returns:
        index the claims; columns ``paper``, one a data set (number with its interval or count of pairs, and verdict),
        and ``here``, see `overall`.
    """
    found = {name: [claim.finding(rows) for claim in CLAIMS] for name, rows in runs.items()}
    cells = {
        name: [UNKNOWN if f is None else f"{f.shown}: {f.verdict}" for f in findings]
        for name, findings in found.items()
    }
    table = pd.DataFrame({"paper": [claim.paper for claim in CLAIMS], **cells}, index=[claim.text for claim in CLAIMS])
    per_claim = zip(CLAIMS, zip(*found.values(), strict=True), strict=True)
    table["here"] = [
        overall([f.verdict for f in findings if f is not None]) if claim.ask else UNTESTABLE
        for claim, findings in per_claim
    ]
    return table.rename_axis("claim")


def overall(verdicts: Sequence[str]) -> str:
    """One verdict over data sets: theirs where they agree, ``not`` where none bears a claim out, else ``partly``.

    `UNKNOWN` without any.
    """
    if not verdicts:
        return UNKNOWN
    kinds = {NOT if verdict.startswith(NOT) else verdict for verdict in verdicts}
    if len(set(verdicts)) == 1:
        return verdicts[0]
    return kinds.pop() if len(kinds) == 1 else PARTLY


def differences(runs: Mapping[str, pd.DataFrame], metric: str, reference: str = GRAPH) -> pd.DataFrame:
    """``reference`` minus every other method on each pair where both have a value.

    Args:
        runs: `study.results.Run.per_pair` by data set.
        metric: one of ``METRICS``.
        reference: the method compared.

    Returns:
        columns ``dataset``, ``method`` and ``difference`` (the metric's unit).
    """
    parts = []
    for name, per_pair in runs.items():
        table = per_pair.loc[metric]
        for other in [column for column in table.columns if column != reference]:
            both = table[[reference, other]].dropna()
            difference = both[reference] - both[other]
            parts.append(pd.DataFrame({"dataset": name, "method": other, "difference": difference.to_numpy()}))
    return pd.concat(parts, ignore_index=True)
