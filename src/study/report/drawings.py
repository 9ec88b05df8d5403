"""The files that the 3-D view loads on demand, and its list of them: a script a CT and a script a pair."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from study.batch.workers import Workers
from study.datasets import Dataset, find_dataset
from study.figures import method_style
from study.files.atomic import write_text
from study.naming import split_sweep
from study.params import StudyParams
from study.report.scenes import Drawn, drawn_ct, drawn_pair
from study.results.clouds import CLOUDS, Clouds
from study.results.run import PAIR, Run

SHOWN = {  # metrics beside the view, and what they are called there
    "hd": "Hausdorff distance",
    "waypoint_error": "waypoint error by the paper's protocol",
    "true_waypoint_error": "true waypoint error",
}
KINDS = {
    "real": "The CT is of a real person; the ultrasound is simulated: a virtual sweep over {whom}, never measured.",
    "synthetic": "Both people are synthetic, and the ultrasound is simulated: nothing here was measured on anybody.",
}
WHOM = {True: "the same person under a known deformation", False: "another real person's CT"}


def write_drawings(runs: dict[str, Run], folder: Path, workers: Workers) -> list[dict[str, Any]]:
    """Write the scripts of every run into ``folder``/data.

    Returns:
        what the page's selectors offer: a mapping a data set.

    Raises:
        StudyError: a run without clouds, or one that data and code of now do not give.
    """
    return [_one_run(run, folder, workers) for run in runs.values()]


def _one_run(run: Run, folder: Path, workers: Workers) -> dict[str, Any]:
    clouds = run.clouds()  # before minutes are spent on people
    made = run.provenance
    dataset = find_dataset(run.dataset, StudyParams(**made["parameters"]["study"]), made["seed"])
    pairs = [pair for pair in dataset.pairs() if any(case[:2] == pair for case in clouds)]
    sources = list(dict.fromkeys(source for source, _ in pairs))
    whole = dict.fromkeys([*sources, *(split_sweep(target)[0] for _, target in pairs)])
    own = [name for name in whole if dataset.origin(name) is None]  # the others are made of those
    people = workers.run(
        f"{run.dataset}: people to draw", {name: (drawn_ct, dataset, name, _key(dataset, name)) for name in own}
    )
    drawn: dict[str, Drawn] = {name: outcome.get() for name, outcome in people.items()}
    for name in sources:
        write_text(folder / _file(dataset, name), drawn[name].script)
    scripts = workers.run(f"{run.dataset}: pairs to draw", {pair: _call(run, dataset, drawn, pair) for pair in pairs})
    for pair, outcome in scripts.items():
        write_text(folder / _file(dataset, *pair), outcome.get())
    return _offer(run, dataset, clouds, pairs)


def _call(run: Run, dataset: Dataset, drawn: dict[str, Drawn], pair: tuple[str, str]) -> tuple[Any, ...]:
    source, target = pair
    there = drawn.get(split_sweep(target)[0])
    path = run.folder / CLOUDS
    return drawn_pair, dataset, drawn[source], target, there and there.anatomy, path, _key(dataset, *pair)


def _offer(run: Run, dataset: Dataset, clouds: Clouds, pairs: list[tuple[str, str]]) -> dict[str, Any]:
    means = run.values[run.values["metric"].isin(SHOWN)].groupby([*PAIR, "method", "metric"])["value"].mean()
    numbers = {key: round(float(value), 2) for key, value in means.items()}
    methods = [name for name in run.methods if any(case[2] == name for case in clouds)]
    return {
        "name": run.dataset,
        "title": dataset.title,
        "kind": KINDS[dataset.people].format(whom=WHOM[dataset.has_truth]),
        "has_truth": dataset.has_truth,
        "methods": [{"name": name, "label": method_style(name).label} for name in methods],
        "pairs": [_offered_pair(dataset, pair, methods, numbers) for pair in pairs],
    }


def _offered_pair(
    dataset: Dataset, pair: tuple[str, str], methods: list[str], numbers: dict[Any, float]
) -> dict[str, Any]:
    source, target = pair
    values = {
        method: {metric: numbers[key] for metric in SHOWN if (key := (*pair, method, metric)) in numbers}
        for method in methods
    }
    return {
        "label": f"{source} to {target}",
        "ct": {"key": _key(dataset, source), "file": _file(dataset, source)},
        "pair": {"key": _key(dataset, *pair), "file": _file(dataset, *pair)},
        "values": values,
    }


def _key(dataset: Dataset, *names: str) -> str:
    return "/".join((dataset.name, *names))


def _file(dataset: Dataset, *names: str) -> str:
    """A script's path in the report; what a name may not have on some disk becomes ``_``."""
    plain = [re.sub(r"[^A-Za-z0-9.-]", "_", name) for name in (dataset.name, *names)]
    return f"data/{'--'.join(plain)}.js"
