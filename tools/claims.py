"""Write results/claims.csv and results/claims.md from finished runs, or check that they are up to date.

    python tools/claims.py write | check [FOLDER ...] [--out results]

The runs are those below the folders given, results/reference when none is; the rows of results/evidence/people, of more
people, are added. Nothing is run.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from study.errors import StudyError
from study.results import REFERENCE, evidence, find_runs, write_claims

PEOPLE = evidence.KEPT / evidence.PEOPLE


def main() -> int:
    """Write or check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["write", "check"])
    parser.add_argument("folders", nargs="*", type=Path, default=[REFERENCE])
    parser.add_argument("--out", type=Path, default=REFERENCE.parent)
    options = parser.parse_args()
    try:
        runs = [run for folder in options.folders for run in find_runs(folder)]
        if options.what == "write":
            print(*write_claims(runs, options.out, PEOPLE), sep="\n")
            return 0
        with TemporaryDirectory() as folder:
            stale = [
                path.name
                for path in write_claims(runs, Path(folder), PEOPLE)
                if not (old := options.out / path.name).is_file() or path.read_bytes() != old.read_bytes()
            ]
    except StudyError as error:
        print(f"claims: {error}", file=sys.stderr)
        return 2
    told = f"{', '.join(stale)}: not of these runs; run `python tools/claims.py write`"
    print(told if stale else "claims are up to date")
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main())
