"""Calibrate the 95 % bound of `study.BEST_METHOD`: chosen on some development people, checked on others.

    python tools/bounds.py [--out results/tuning/bounds.csv]

The people are of the three kinds that ``tools/tune.py`` knows, of seeds that it does not tune on. The bound is the
smallest size, in steps of 0.1 mm, that covers 95 % of the waypoints of the first half of the people, with and without
time stamps; the second half, whom nothing was chosen on, says what it covers. `study.methods.gaussian_process` holds
the sizes and a test holds them to the table.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from tune import REAL, three_kinds

from study.alignment.chest import Alignment
from study.evaluation.judgement import Judgement
from study.evaluation.pair import Pair
from study.methods import BEST_METHOD, METHODS
from study.pipeline import register_aligned
from study.seeds import named_rng

SHARE = 0.95
STEP_MM = 0.1
HALVES = {  # phantoms, phantoms of the whole spread, planted: no patient is in both, and none is tuned on
    "chosen on": ((203, 204), (404, 405), (402,)),
    "checked on": ((205,), (206, 208), (403, 404)),
}


def people(phantoms: tuple[int, ...], full_spread: tuple[int, ...], planted: tuple[int, ...]) -> list[Pair]:
    """The pairs of every kind for some seeds."""
    return three_kinds(
        [(name, seed) for seed in phantoms for name in ("ct1", "ct2", "ct3")],
        [(name, seed) for seed in full_spread for name in ("ct1", "ct2")],
        [(person, seed) for seed in planted for person in REAL],
    )


def errors_mm(pairs: list[Pair], *, timed: bool) -> np.ndarray:
    """True errors (p, k) mm of the waypoints of every pair, end to end."""
    rows = []
    for pair in pairs:
        if not timed:
            target = replace(pair.alignment.target, cloud=replace(pair.alignment.target.cloud, times=None))
            pair = replace(pair, alignment=Alignment(pair.alignment.source, target))
        result = register_aligned(pair.alignment, METHODS[BEST_METHOD], named_rng(0, pair.name))
        rows.append(Judgement(pair, result).true_waypoint_errors_mm())
    return np.array(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "results" / "tuning" / "bounds.csv")
    options = parser.parse_args()
    halves = {half: people(*seeds) for half, seeds in HALVES.items()}
    rows = []
    for timed in (True, False):
        chosen, checked = (errors_mm(pairs, timed=timed) for pairs in halves.values())
        bound = float(np.ceil(np.quantile(chosen, SHARE) / STEP_MM) * STEP_MM)
        rows.append(
            {
                "times": timed,
                "bound_mm": round(bound, 1),
                "pairs_chosen_on": len(chosen),
                "covers_chosen": (chosen <= bound).mean(),
                "pairs_checked_on": len(checked),
                "covers_checked": (checked <= bound).mean(),
                "mean_checked_mm": checked.mean(),
                "largest_checked_mm": checked.max(),
            }
        )
    table = pd.DataFrame(rows)
    table.to_csv(options.out, index=False, lineterminator="\n")
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()
