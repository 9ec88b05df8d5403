"""Where the limits of `study.alignment.sizes` and `study.quality` stand: development people on either side.

    python benchmarks/chest_limits.py [--seeds 401 410] [--cases FILE.csv]

First the sizes of every development person, whole and as a probe sees them: range, limits, and how many lie outside.
Then, from the cases that `hostile.py --rows FILE.csv` wrote, each measure of quality in right and in wrong answers.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from hostile import World, named_rng
from joblib import Parallel, delayed

from study import phantom
from study.alignment.chest import find_chest
from study.alignment.sizes import LIMITS, PAIR_LIMITS, chest_sizes
from study.errors import StudyError
from study.quality import QUALITY_LIMITS
from study.types import PointCloud, RigidTransform


def sizes_of(seed: int, name: str, kind: str) -> dict[str, float | str]:
    """Sizes of one person's cloud, or why there are none."""
    rng = named_rng(seed, f"limits/{name}/{kind}")
    world = World(seed, "ct1", rng)
    world.source = world.target = phantom.draw_subject(name, seed)
    points = world.ct() if kind == "CT" else world.us(noise=rng.uniform(0.3, 1.2), strips=int(rng.integers(5)))
    row: dict[str, float | str] = {"kind": kind}
    try:
        return row | chest_sizes(find_chest(PointCloud(RigidTransform.random(rng).apply(points), kind)))
    except StudyError as error:
        return row | {"refused": str(error)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=(401, 410), metavar=("FIRST", "LAST"))
    parser.add_argument("--cases", type=Path, help="rows of hostile.py")
    options = parser.parse_args()
    seeds = range(options.seeds[0], options.seeds[1] + 1)
    work = [(seed, name, kind) for seed in seeds for name in phantom.SUBJECTS for kind in ("CT", "US")]
    rows = pd.DataFrame(Parallel(n_jobs=2)(delayed(sizes_of)(*one) for one in work))
    refused = int(rows["refused"].notna().sum()) if "refused" in rows else 0
    rows = rows[[*LIMITS, "kind"]].dropna()
    print(f"{len(work)} clouds of development people, {refused} refused by the coarse alignment\n")
    print("measure          smallest   median  largest    limits            outside")
    for name, limit in LIMITS.items():
        low, middle, high = np.quantile(rows[name], [0, 0.5, 1])
        outside = np.mean([limit.excess(value) > 0 for value in rows[name]])
        print(f"{name:14s} {low:10.3f} {middle:8.3f} {high:8.3f}    {limit.low:g} to {limit.high:g}    {outside:.1%}")
    print("\nlog ratios of any US cloud over any CT cloud")
    log = {key: np.log(rows[key].to_numpy()) for key in ("span", "reach", "width")}
    log["size"] = np.mean(list(log.values()), axis=0)
    for name, limit in PAIR_LIMITS.items():
        ratio = log[name][rows["kind"] == "US"][:, None] - log[name][rows["kind"] == "CT"][None]
        outside = np.mean((ratio < limit.low) | (ratio > limit.high))
        low, middle, high = np.quantile(ratio, [0, 0.5, 1])
        print(f"{name:14s} {low:10.3f} {middle:8.3f} {high:8.3f}    ±{limit.high:g}    {outside:.1%}")
    if options.cases:
        print_quality(pd.read_csv(options.cases))


def print_quality(cases: pd.DataFrame) -> None:
    """Share of right and of wrong answers beyond each limit of quality."""
    right, wrong = cases[cases["outcome"] == "right"], cases[cases["outcome"].isin(["warned", "wrong in silence"])]
    print(f"\nmeasures of {len(right)} right and {len(wrong)} wrong answers: share beyond the limit")
    for name, (limit, _) in QUALITY_LIMITS.items():
        rates = [(group[f"q_{name}"] > limit).mean() for group in (right, wrong)]
        print(f"{name:18s} limit {limit:5g}   right {rates[0]:6.1%}   wrong {rates[1]:6.1%}")


if __name__ == "__main__":
    main()
