"""Runs against their references, all data sets in one call, told as text, Markdown, JSON and JUnit XML."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from junitparser import Error, Failure, JUnitXml, TestCase, TestSuite

from study.errors import StudyError
from study.files.atomic import json_text, write_bytes, write_text
from study.results.compare import Comparison, compare, with_status
from study.results.metrics_csv import KEY

AGREES, DIFFERS, REFUSED = "agrees", "differs", "cannot be compared"
N_LISTED = 20  # rows of a table of differences in Markdown and JUnit XML; JSON has them all


@dataclass(frozen=True)
class Comparisons:
    """Every data set of a candidate against its reference.

    Attributes:
        parts: by data set, what was found, or why it cannot be compared.
    """

    parts: Mapping[str, Comparison | StudyError]

    @property
    def verdict(self) -> str:
        """The worst of the parts' verdicts."""
        found = {_verdict(part) for part in self.parts.values()}
        return next(verdict for verdict in (REFUSED, DIFFERS, AGREES) if verdict in found)

    @property
    def exit_code(self) -> int:
        """0 agrees, 1 differs, 2 something cannot be compared."""
        return (AGREES, DIFFERS, REFUSED).index(self.verdict)

    def compared(self) -> dict[str, Comparison]:
        """The data sets that could be compared."""
        return {name: part for name, part in self.parts.items() if isinstance(part, Comparison)}

    def refused(self) -> dict[str, str]:
        """Why the other data sets could not."""
        return {name: str(part) for name, part in self.parts.items() if isinstance(part, StudyError)}

    def report(self) -> str:
        """What was compared and what differs, for a terminal."""
        if len(self.parts) == 1 and self.compared():
            return next(iter(self.compared().values())).report()
        if self.verdict == AGREES:
            rows = sum(part.n_compared for part in self.compared().values())
            used = max(part.largest for part in self.compared().values())
            told = f"compared {rows} rows of {', '.join(self.parts)}; largest difference {used:.3g} of its tolerance"
            return f"{told}; all {len(self.parts)} data sets: {AGREES}"
        each = [
            f"{name}: " + (part.report() if isinstance(part, Comparison) else f"{REFUSED}: {part}")
            for name, part in self.parts.items()
        ]
        return "\n\n".join([*each, f"all {len(self.parts)} data sets: {self.verdict}"])

    def markdown(self) -> str:
        """What changed and by how much, old and new side by side, the largest first; for a job's summary."""
        lines = [f"# Against the reference: {self.verdict}", "", *_table(self._overview()), ""]
        if self.refused():
            lines += ["## Cannot be compared", "", *(f"- `{name}`: {why}" for name, why in self.refused().items()), ""]
        upsets = [told for part in self.compared().values() for told in part.upsets]
        if upsets:
            lines += ["## Orders and claims that turned", "", *_table(pd.DataFrame(map(_old_and_new, upsets))), ""]
        for title, frame, columns in (
            ("Means beyond tolerance", self._all("shifts"), _MEANS),
            ("Values beyond tolerance", self._all("differences"), _VALUES),
            ("Rows that only the reference has", self._all("missing"), _ROWS),
            ("Rows that only the candidate has", self._all("extra"), _ROWS),
        ):
            if len(frame):
                lines += [f"## {title}: {len(frame)}", "", *_listed(frame, columns), ""]
        return "\n".join(lines)

    def json(self) -> str:
        """Everything that was found, in full, with every mean on both sides."""
        parts = {
            name: _content(part) if isinstance(part, Comparison) else {"verdict": REFUSED, "reason": str(part)}
            for name, part in self.parts.items()
        }
        return json_text({"verdict": self.verdict, "exit_code": self.exit_code, "datasets": parts})

    def junit(self) -> bytes:
        """A test suite a data set: a case a method, and one for the order of the methods and the claims."""
        document = JUnitXml("study compare")
        for name, part in self.parts.items():
            suite = TestSuite(name)
            if isinstance(part, StudyError):
                suite.add_testcase(_case(name, "can be compared", Error(str(part), REFUSED)))
            else:
                suite.add_testcases([_method_case(name, method, part) for method in part.methods])
                told = "\n".join(part.upsets)
                suite.add_testcase(_case(name, "order of the methods and claims", _failure(told)))
            document.add_testsuite(suite)
        document.update_statistics()
        return bytes(document.tostring())

    def write(self, *, markdown: Path | None, json: Path | None, junit: Path | None) -> None:
        """Write those that have a path."""
        if markdown is not None:
            write_text(markdown, self.markdown())
        if json is not None:
            write_text(json, self.json())
        if junit is not None:
            write_bytes(junit, self.junit())

    def _overview(self) -> pd.DataFrame:
        rows = []
        for name, part in self.parts.items():
            row: dict[str, Any] = {"data set": f"`{name}`", "verdict": _verdict(part)}
            if isinstance(part, Comparison):
                row |= {
                    "rows compared": part.n_compared,
                    "missing": len(part.missing),
                    "new": len(part.extra),
                    "values beyond": len(part.differences),
                    "means beyond": len(part.shifts),
                    "orders and claims turned": len(part.upsets),
                    "largest difference / its tolerance": f"{part.largest:.3g}",
                }
            rows.append(row)
        return pd.DataFrame(rows, dtype=object).fillna("–")

    def _all(self, what: str) -> pd.DataFrame:
        """Rows of a kind of all data sets, the largest multiple of a tolerance first."""
        found: list[pd.DataFrame] = [frame for part in self.compared().values() if len(frame := getattr(part, what))]
        if not found:
            return pd.DataFrame()
        rows: pd.DataFrame = pd.concat(found, ignore_index=True)
        if "times_tolerance" in rows:
            rows = rows.sort_values("times_tolerance", ascending=False, kind="stable")
        return rows


def compare_all(reference: Path, candidate: Path) -> Comparisons:
    """Compare every run of a folder with its reference; none that differs or can't be compared stops the others.

    Args:
        reference: a folder with ``metrics.csv``, or with one such folder per data set.
        candidate: the same layout.
    """
    theirs, ours = _runs(reference), _runs(candidate)
    if not theirs or not ours:
        bare = reference if not theirs else candidate
        why = f"expected metrics.csv in {bare} or in its folders, got none; check the path or run `study run`"
        return Comparisons({name: StudyError(why) for name in sorted({*theirs, *ours}) or ["."]})
    return Comparisons(
        {
            name: _attempt(partial(_compare_named, name, reference, candidate, name in theirs, name in ours))
            for name in sorted({*theirs, *ours})
        }
    )


def _compare_named(name: str, reference: Path, candidate: Path, expected: bool, got: bool) -> Comparison:
    if expected and got:
        return compare(reference / name, candidate / name)
    has, lacks = (reference, candidate) if expected else (candidate, reference)
    raise StudyError(
        f"expected the same metrics.csv files in both folders, got {Path(name, 'metrics.csv').as_posix()} only in {has}"
        f", not in {lacks}; run the same data sets"
    )


def _attempt(comparing: Callable[[], Comparison]) -> Comparison | StudyError:
    try:
        return comparing()
    except StudyError as error:
        return error


def _runs(folder: Path) -> list[str]:
    """Folders with a ``metrics.csv``: this one, or those in it."""
    if (folder / "metrics.csv").is_file():
        return ["."]
    return sorted(path.parent.name for path in folder.glob("*/metrics.csv") if not path.parent.name.startswith("."))


def _verdict(part: Comparison | StudyError) -> str:
    if isinstance(part, StudyError):
        return REFUSED
    return AGREES if part.agrees else DIFFERS


_TOLD = {"reference": "old", "candidate": "new", "times_tolerance": "× tolerance"}
_MEANS = ("dataset", "method", "metric", "reference", "candidate", "shift", "tolerance", "times_tolerance")
_VALUES = (*KEY, "reference", "candidate", "difference", "tolerance", "times_tolerance")
_ROWS = KEY


def _listed(frame: pd.DataFrame, columns: tuple[str, ...]) -> Iterator[str]:
    shown = frame.head(N_LISTED)
    if columns == _VALUES:
        shown = with_status(shown, ".6g")
    shown = shown[list(columns)].rename(columns=_TOLD)
    yield from _table(shown)
    if len(frame) > N_LISTED:
        yield ""
        yield f"... and {len(frame) - N_LISTED} more"


def _table(frame: pd.DataFrame) -> list[str]:
    numbers = frame.select_dtypes("float").columns
    text = frame.assign(**{name: frame[name].map("{:.6g}".format) for name in numbers})
    return str(text.astype(str).to_markdown(index=False, disable_numparse=True)).splitlines()


def _old_and_new(upset: str) -> dict[str, str]:
    """A turned order or claim side by side; of an order, the places that changed alone."""
    head, _, now = upset.partition("; now ")
    about, _, was = head.rpartition(": ")
    before, after = was.removeprefix("by mean ").split(" < "), now.split(" < ")
    changed = [k for k, pair in enumerate(zip(before, after, strict=False)) if pair[0] != pair[1]]
    if len(before) == len(after) > 1 and changed:
        part = slice(changed[0], changed[-1] + 1)
        about += f", places {part.start + 1} to {part.stop} by mean"
        was, now = " < ".join(before[part]), " < ".join(after[part])
    return {"what": about, "old": was, "new": now}


def _content(part: Comparison) -> dict[str, Any]:
    return {
        "verdict": _verdict(part),
        "n_compared": part.n_compared,
        "largest_times_tolerance": part.largest,
        "missing": _records(part.missing),
        "extra": _records(part.extra),
        "values_beyond_tolerance": _records(part.differences),
        "means_beyond_tolerance": _records(part.shifts),
        "turned": list(part.upsets),
        "means": _records(part.means),
    }


def _records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    return list(json.loads(frame.to_json(orient="records", double_precision=15)))


def _method_case(name: str, method: str, part: Comparison) -> TestCase:
    told = []
    for title, frame, columns in (
        ("rows only in the reference", part.missing, _ROWS),
        ("rows only in the candidate", part.extra, _ROWS),
        ("means beyond tolerance", part.shifts, _MEANS),
        ("values beyond tolerance", part.differences, _VALUES),
    ):
        rows = frame[frame["method"] == method]
        if len(rows):
            told.append("\n".join([f"{len(rows)} {title}", *_listed(rows, columns)]))
    return _case(name, method, _failure("\n\n".join(told)))


def _failure(told: str) -> Failure | None:
    """None where there is nothing to tell; the first line is what a page of results shows."""
    if not told:
        return None
    failure = Failure(told.splitlines()[0], DIFFERS)
    failure.text = told
    return failure


def _case(dataset: str, name: str, result: Error | Failure | None) -> TestCase:
    case = TestCase(name, classname=f"study.compare.{dataset}")
    if result is not None:
        case.result = result
    return case
