"""Renew results/reference from finished runs, and draft the rows of CHANGELOG.md that say what moved.

    python tools/reference.py [--runs results/runs]

Old and new are compared first (`study compare`); where a number moved, a draft is put under "Unreleased" of
CHANGELOG.md, for whoever moved it to say why. Runs that are not of the code of now, or not as they were made, are
refused: nothing is changed then.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from study.batch import why_stale
from study.datasets import find_dataset, reported
from study.errors import StudyError
from study.files.atomic import write_text
from study.results import REFERENCE, Comparison, Comparisons, Run, compare
from study.results.clouds import CLOUDS

ROOT = Path(__file__).parents[1]
GRAPH = "skeleton_graph"
BEGIN, END = "<!-- draft of `make reference`: say why, then remove these two lines -->", "<!-- end of draft -->"
HEADING = "## Unreleased\n"
N_MEANS = 15


def against(runs: Mapping[str, Path], reference: Path) -> Comparisons:
    """Every run against the reference that it will replace; a new data set, or other data, can't be compared."""
    parts: dict[str, Comparison | StudyError] = {}
    for name, run in runs.items():
        try:
            parts[name] = compare(reference / name, run)
        except StudyError as error:
            parts[name] = error
    return Comparisons(parts)


def draft(found: Comparisons) -> str:
    """Rows for the change log, Markdown; empty where no number moved."""
    moved = {name: part for name, part in found.compared().items() if not part.agrees}
    if not moved and not found.refused():
        return ""
    lines = []
    if moved:
        lines += [
            "| Cohort | Hausdorff distance, old | new | Waypoint error by the protocol, old | new |",
            "|---|---|---|---|---|",
            *(f"| `{name}` | {_mean(part, 'hd')} | {_mean(part, 'waypoint_error')} |" for name, part in moved.items()),
            "",
            "| Cohort | Method | Metric | Old | New | Why |",
            "|---|---|---|---|---|---|",
        ]
    for name, part in moved.items():
        lines += [
            f"| `{name}` | `{row.method}` | `{row.metric}` | {row.reference:.4g} | {row.candidate:.4g} | why? |"
            for row in part.shifts.head(N_MEANS).itertuples()
        ]
        rest = len(part.shifts) - N_MEANS
        lines += [f"| `{name}` | {rest} more means | | | | why? |"] if rest > 0 else []
    lines += [""] if moved else []
    for name, part in moved.items():
        counts = {"rows are gone": len(part.missing), "rows are new": len(part.extra)}
        lines += [f"- `{name}`: {n} {words}. Why?" for words, n in counts.items() if n]
        lines += [f"- {told}. Why?" for told in part.upsets]
    lines += [f"- `{name}`: new reference ({why})" for name, why in found.refused().items()]
    return "\n".join(lines).strip() + "\n"


def _mean(part: Comparison, metric: str) -> str:
    row = part.means[(part.means["method"] == GRAPH) & (part.means["metric"] == metric)]
    return f"{row['reference'].item():.2f} | {row['candidate'].item():.2f}" if len(row) else "– | –"


def with_draft(text: str, rows: str) -> str:
    """The change log with the draft under its first heading, in the place of an older draft.

    Raises:
        StudyError: a change log without that heading.
    """
    if BEGIN in text and END in text:
        before, _, rest = text.partition(BEGIN)
        text = before + rest.partition(END)[2].lstrip("\n")
    if HEADING not in text:
        raise StudyError(f"CHANGELOG.md: expected the heading {HEADING.strip()!r}, got none; add it")
    before, _, after = text.partition(HEADING)
    return f"{before}{HEADING}\n{BEGIN}\n\n{rows}\n{END}\n\n{after.lstrip(chr(10))}"


def renew(runs: Mapping[str, Path], reference: Path) -> None:
    """Put the runs in the place of the reference's, without their clouds, which only the report reads."""
    for name, run in runs.items():
        shutil.rmtree(reference / name, ignore_errors=True)
        shutil.copytree(run, reference / name, ignore=shutil.ignore_patterns(CLOUDS))


def require_of_now(runs: Mapping[str, Path]) -> None:
    """Refuse runs that the code of now did not make.

    Raises:
        StudyError: the first one, and why.
    """
    for name, folder in runs.items():
        reason = why_stale(Run(folder), find_dataset(name))
        if reason is not None:
            raise StudyError(f"{folder}: expected a run of now, got one of another state: {reason}; run `make study`")


def main() -> int:
    """Compare, draft, renew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=ROOT / "results" / "runs")
    options = parser.parse_args()
    runs = {name: options.runs / name for name in reported()}
    log = ROOT / "CHANGELOG.md"
    try:
        require_of_now(runs)
        found = against(runs, REFERENCE)
        rows = draft(found)
        text = with_draft(log.read_text(encoding="utf-8"), rows) if rows else ""
        renew(runs, REFERENCE)
    except StudyError as error:
        print(f"reference: {error}", file=sys.stderr)
        return 2
    if rows:
        write_text(log, text)
    print(found.markdown())
    told = "CHANGELOG.md holds a draft of what moved: say why" if rows else "no number moved, CHANGELOG.md is as it was"
    print(f"{REFERENCE} renewed; {told}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
