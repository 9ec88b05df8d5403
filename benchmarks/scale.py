"""What a registration costs: by method, by stage, by the number of points, frames and voxels. Printed, and stored.

    python benchmarks/scale.py [--most 1000000] [--only methods] [--out results/runs/bench]

Times are processor time of one thread in one run, after a first call that compiles; ratios are what carries over to
another machine. Each number of points has a process of its own, whose memory is the largest it ever held, imports
included. Tables go to ``methods.csv``, ``stages.csv``, ``points.csv``, ``frames.csv`` and ``voxels.csv``.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.pool import Pool
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from registration_speed import processor_seconds
from threadpoolctl import threadpool_limits

from study import BEST_METHOD, METHODS, phantom, register_pair
from study.alignment.chest import Alignment, find_chest
from study.ct.parts import parts_from_labels
from study.ct.surface import surface
from study.data.manifest import load_manifest
from study.files.atomic import write_text
from study.params import PHANTOM_SEED
from study.pipeline import _even_chest, register_aligned  # the stages of register_pair
from study.quality import measure_quality
from study.seeds import named_rng
from study.types import Floats, PointCloud
from study.ultrasound.cloud import sweep_cloud
from study.ultrasound.probe import Probe
from study.ultrasound.sweep_errors import SweepErrors
from study.ultrasound.virtual_sweep import simulate_sweep

CT_POINTS, US_POINTS = 9000, 6600
PAPERS = "skeleton_graph"
SIZES = (1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000)  # points of each cloud
NOISE_MM = 0.5
LIMIT_S = 600  # of the clock, for one size


def clouds() -> tuple[Floats, Floats]:
    """A synthetic pair, CT and US, (9000, 3) and (6600, 3) mm."""
    person, patient = (phantom.draw_subject(name, PHANTOM_SEED) for name in ("ct1", "patient"))
    ct = phantom.reference_cloud(person, CT_POINTS, np.random.default_rng(0)).points
    return ct, phantom.anterior_cloud(patient, US_POINTS, 0.5, 0, np.random.default_rng(1)).points


def by_method() -> pd.DataFrame:
    """`register_pair` with every method, coarse alignment included."""
    ct, us = clouds()
    seconds = {name: processor_seconds(lambda name=name: register_pair(ct, us, name), 3) for name in METHODS}
    table = pd.DataFrame({"method": list(seconds), "seconds": list(seconds.values())})
    return table.assign(ratio=table["seconds"] / seconds[PAPERS])


def by_stage() -> pd.DataFrame:
    """The stages of `register_pair`."""
    ct, us = (PointCloud(points, name) for points, name in zip(clouds(), ("ct", "us"), strict=True))
    alignment = Alignment(_even_chest(ct), _even_chest(us))
    rows: list[dict[str, Any]] = []
    for name in (PAPERS, BEST_METHOD):
        result = register_aligned(alignment, METHODS[name], named_rng(0, "bench"))
        whole = processor_seconds(lambda name=name: register_pair(ct, us, name), 3)
        stages = {
            "chests found": processor_seconds(lambda: (find_chest(ct), find_chest(us)), 3),
            "clouds thinned, chests found": processor_seconds(lambda: (_even_chest(ct), _even_chest(us)), 3),
            "method, judged by itself": processor_seconds(
                lambda name=name: register_aligned(alignment, METHODS[name], named_rng(0, "bench")), 3
            ),
            "quality": processor_seconds(lambda result=result: measure_quality(alignment, result.warped), 3),
        }
        rows += [
            {"method": name, "stage": stage, "seconds": s, "share": s / whole}
            for stage, s in {**stages, "all": whole}.items()
        ]
    return pd.DataFrame(rows)


def dense(cloud: Floats, n: int, rng: np.random.Generator) -> Floats:
    """A cloud seen again and again, ``n`` points (n, 3) mm in all, each off by the noise of a segmentation.

    To draw a million points on the phantom's own surface takes minutes, which would tell nothing of the registration.
    """
    points: Floats = cloud[rng.integers(len(cloud), size=n)] + rng.normal(scale=NOISE_MM, size=(n, 3))
    return points


def of_points(ct: Floats, us: Floats, n: int, method: str) -> dict[str, Any]:
    """One registration of ``n`` and ``n`` points, after one of the clouds (., 3) mm that they are made from."""
    with threadpool_limits(1):
        register_pair(ct, us, method)
        many = [dense(cloud, n, np.random.default_rng(0)) for cloud in (ct, us)]
        start = time.process_time()
        register_pair(*many, method)
        seconds = time.process_time() - start
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {"method": method, "points": n, "seconds": seconds, "peak_gb": peak_gb}


def alone(measure: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """What a function returns from a process that has done nothing before.

    Raises:
        TimeoutError: it took longer than ``LIMIT_S``; the process is ended.
    """
    with Pool(1, context=get_context("spawn")) as pool:
        return pool.apply_async(measure, arguments).get(LIMIT_S)


def by_points(most: int) -> pd.DataFrame:
    """Cost against the number of points; ``slope`` of log time against log points, from row to row."""
    sizes = [n for n in SIZES if n <= most]
    pair, tables = clouds(), []
    for method in (PAPERS, BEST_METHOD):
        rows = [alone(of_points, *pair, n, method) for n in sizes]
        tables.append(with_slope(pd.DataFrame(rows), "points"))
    return pd.concat(tables)


def by_frames() -> pd.DataFrame:
    """From masks to a cloud, against the number of frames: a slower hand over the same surface."""
    mesh = phantom_mesh()
    rows = []
    for factor in (1.0, 0.5, 0.25):
        probe = Probe(speed_mm_s=Probe.speed_mm_s * factor)
        sweep = simulate_sweep(mesh, (0.0, 1.0, 0.0), SweepErrors(), np.random.default_rng(0), probe=probe)
        rows.append({"frames": sweep.n_frames, "seconds": processor_seconds(lambda sweep=sweep: sweep_cloud(sweep))})
    return with_slope(pd.DataFrame(rows), "frames")


def phantom_mesh() -> Any:
    """The surface of a synthetic person, by the road of a CT."""
    _, mask = phantom_ct(2.0)
    return surface(mask)


def phantom_ct(spacing_mm: float) -> tuple[Any, Any]:
    """A synthetic CT and the mask of its parts."""
    person = phantom.draw_subject("patient", PHANTOM_SEED)
    image, labels = phantom.ct_volume(person, spacing_mm, np.random.default_rng(0))
    return image, parts_from_labels(labels, load_manifest().label_ids("totalsegmentator_v2"))


def by_voxels() -> pd.DataFrame:
    """From labels to parts and surface, against the number of voxels."""
    rows = []
    person, ids = phantom.draw_subject("patient", PHANTOM_SEED), load_manifest().label_ids("totalsegmentator_v2")
    for spacing_mm in (2.5, 2.0, 1.5, 1.2):
        _, labels = phantom.ct_volume(person, spacing_mm, np.random.default_rng(0))
        rows.append(
            {
                "voxels": int(np.prod(labels.shape)),
                "seconds": processor_seconds(lambda labels=labels: surface(parts_from_labels(labels, ids))),
            }
        )
    return with_slope(pd.DataFrame(rows), "voxels")


def with_slope(table: pd.DataFrame, size: str) -> pd.DataFrame:
    """``slope`` of log time against log size, from row to row."""
    logs = np.log(table[[size, "seconds"]]).diff()
    return table.assign(slope=logs["seconds"] / logs[size])


def readable(table: pd.DataFrame) -> str:
    """The table as it is printed: counts in groups of three digits, seconds and ratios with two decimals."""
    counts = {name: "{:,}".format for name in ("points", "frames", "voxels")}
    return table.to_string(index=False, na_rep="", float_format="{:.2f}".format, formatters=counts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=int, default=1_000_000, help="points of the largest clouds")
    parser.add_argument("--only", action="append", help="a table's name; again for another")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "results" / "runs" / "bench")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    tables: dict[str, Callable[[], pd.DataFrame]] = {
        "methods": by_method,
        "stages": by_stage,
        "points": lambda: by_points(options.most),
        "frames": by_frames,
        "voxels": by_voxels,
    }
    with threadpool_limits(1):
        for name, measure in tables.items():
            if options.only and name not in options.only:
                continue
            table = measure()
            print(f"\n{name}\n{readable(table)}", flush=True)
            write_text(options.out / f"{name}.csv", table.to_csv(index=False, lineterminator="\n", float_format="%.4f"))


if __name__ == "__main__":
    main()
