"""The report: one folder of pages that open from a disk, with no network."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import mistune
import pandas as pd

from study.batch.workers import Workers
from study.datasets import reported
from study.errors import StudyError
from study.evaluation.metrics import METRICS
from study.report.assets import ASSETS, require_vendored
from study.report.drawings import SHOWN, write_drawings
from study.report.notebooks import notebook_page
from study.results.finding import MEASURES, NotBorneOut, between_real_people, metric_table, reading, small_table
from study.results.run import Run, visible
from study.results.verdicts import claim_rows, claims_markdown

FOLDER = "report"
STATIC = ("viewer.js", "viewer_data.js", "style.css", "niivue.umd.js", "niivue.LICENSE.txt")
MARK = '<meta name="generator" content="study report">'
FIGURES = {  # by the stem of a picture: what it shows, for those who do not see it
    "hausdorff": "Hausdorff distance of every method, pair by pair, beside its mean",
    "surface_distance": "Distances between the warped CT cloud and the US cloud, by method",
    "waypoints": "Waypoint errors of every method by the paper's protocol",
    "judges": "The same waypoints judged by the paper's protocol and by the truth, method by method",
    "against_hd": "True waypoint error against Hausdorff distance, a point a method",
    "against_waypoint_error": "True waypoint error against the protocol's waypoint error, a point a method",
    "protocol_phantom": "The protocol's waypoint error beside the true one, method by method, on phantom",
    "protocol_planted": "The protocol's waypoint error beside the true one, method by method, on planted",
}


@dataclass(frozen=True)
class Picture:
    """A figure of the report: where it is, and what it shows in words."""

    file: str
    alt: str


def write_report(
    folder: Path, datasets: Iterable[str] | None = None, *, n_jobs: int = 1, show_progress: bool = False
) -> Path:
    """Write ``report`` below a folder of runs: finding, claims, tables, figures, 3-D view, provenance, notebooks.

    Args:
        folder: with a run a data set, under its name, and executed notebooks below ``notebooks``.
        datasets: names of those runs; every reported data set when None.
        n_jobs: worker processes.
        show_progress: bars on standard error.

    Returns:
        the first page.

    Raises:
        StudyError: a run that is missing, was altered, or is not what data and code of now give; or a folder ``report``
            that this did not write.
    """
    names = reported() if datasets is None else list(dict.fromkeys(datasets))
    runs = {name: _run_of(folder, name) for name in names}
    if not runs:
        raise StudyError("expected a data set to report, got none; leave --dataset out for all that are reported")
    require_vendored()
    out, new = folder / FOLDER, folder / f".{FOLDER}.unfinished"
    _require_own(out)
    shutil.rmtree(new, ignore_errors=True)  # of a report that was stopped
    new.mkdir(parents=True)
    for name in STATIC:
        shutil.copyfile(ASSETS / name, new / name)
    offers = write_drawings(runs, new, Workers(n_jobs, show_progress))
    context = _context(runs, offers, _pictures(folder, runs, new), _notebooks(folder, new))
    (new / "index.html").write_text(_template("index.html.j2").render(context), encoding="utf-8")
    _swap(out, new)
    return out / "index.html"


def _run_of(folder: Path, name: str) -> Run:
    run = Run(folder / name)
    if not (run.folder / "metrics.csv").is_file():
        raise StudyError(f"expected a run of {name} at {run.folder}, got none; run `study run --dataset {name}` first")
    if run.condition:
        raise StudyError(f"{run.folder}: expected a run as it was made, but it {run.condition}; run it again")
    return run


def _require_own(out: Path) -> None:
    if out.exists() and not (out / "index.html").is_file():
        raise StudyError(f"{out}: expected a new folder or an older report, got something else; move it away")
    if out.exists() and MARK not in (out / "index.html").read_text(encoding="utf-8", errors="replace"):
        raise StudyError(f"{out}: expected an older report, got pages that `study` did not write; move them away")


def _swap(out: Path, new: Path) -> None:
    old = out.with_name(f".{FOLDER}.old")
    shutil.rmtree(old, ignore_errors=True)
    if out.exists():
        out.rename(old)
    new.rename(out)
    shutil.rmtree(old, ignore_errors=True)


def _template(name: str) -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(ASSETS), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True
    )
    return environment.get_template(name)


def _html(markdown: str) -> str:
    """Markdown of this package as HTML; tags in it are text."""
    made = mistune.create_markdown(escape=True, plugins=["table"])(markdown)
    wide = '<div class="wide" tabindex="0" role="region" aria-label="table"><table>'
    return str(made).replace("<table>", wide).replace("</table>", "</table></div>")


def _context(
    runs: Mapping[str, Run],
    offers: list[dict[str, Any]],
    pictures: Mapping[str, list[Picture]],
    notebooks: list[tuple[str, str]],
) -> dict[str, Any]:
    """What the first page is filled with."""
    known = [run for run in runs.values() if run.has_truth]
    measures = {metric: metric_table(metric, runs) for metric in MEASURES if _has(runs, metric)}
    return {
        "mark": MARK,
        "finding": _finding(runs),
        "small": _html(small_table((known or list(runs.values()))[0])),
        "verdicts": _html(_verdicts(list(runs.values()))),
        "claims": _html(claims_markdown(list(runs.values())).partition("\n")[2]),
        "tables": [(METRICS[metric], _html(table)) for metric, table in measures.items()],
        "table_one": [(name, _html(_plain(run.hd_table()))) for name, run in runs.items()],
        "pictures": pictures,
        "offers": offers,
        # In a script element nothing is escaped but the end of the element.
        "config": json.dumps({"datasets": offers, "titles": SHOWN}).replace("<", "\\u003c"),
        "provenance": _provenance(runs),
        "notebooks": notebooks,
    }


def _has(runs: Mapping[str, Run], metric: str) -> bool:
    return any((run.values["metric"] == metric).any() for run in runs.values())


def _plain(table: pd.DataFrame) -> str:
    return str(table.round(2).to_markdown(disable_numparse=True))


def _verdicts(runs: list[Run]) -> str:
    """How many claims there are of each verdict on each data set, as Markdown."""
    rows = claim_rows(runs)
    counts = rows[rows["dataset"].isin([run.dataset for run in runs])].value_counts(["verdict", "dataset"])
    table = counts.unstack("dataset").reindex(columns=[run.dataset for run in runs]).fillna(0).astype(int)
    return str(table.rename_axis("claims that are", axis="index").to_markdown())


def _finding(runs: Mapping[str, Run]) -> str:
    """The finding as HTML, or why these runs do not give one."""
    try:
        text = reading(runs)
        real = [between_real_people(run) for run in runs.values() if not run.has_truth]
    except NotBorneOut as error:
        return _html(f"No finding is stated: {error}.")
    return _html("\n".join([text, *real]))


def _pictures(folder: Path, runs: Mapping[str, Run], out: Path) -> dict[str, list[Picture]]:
    """Copies of the figures beside the runs and of those over all of them, by where they are from."""
    found: dict[str, list[Picture]] = {}
    for title, place in {"All data sets": folder, **{name: run.folder for name, run in runs.items()}}.items():
        for path in sorted(place.glob("*.png")):
            file = f"figures/{path.name}" if place == folder else f"figures/{place.name}--{path.name}"
            (out / "figures").mkdir(exist_ok=True)
            shutil.copyfile(path, out / file)
            words = FIGURES.get(path.stem, path.stem.replace("_", " "))
            about = "" if place == folder else f", on {title}"
            found.setdefault(title, []).append(Picture(file, f"{words}{about}"))
    return found


def _notebooks(folder: Path, out: Path) -> list[tuple[str, str]]:
    """Pages of the executed notebooks: path in the report and title."""
    pages = []
    for path in visible(folder / "notebooks", "*.ipynb"):
        name = "--".join(path.relative_to(folder / "notebooks").with_suffix("").parts)
        title, page = notebook_page(path, _template("notebook.html.j2"))
        (out / "notebooks").mkdir(exist_ok=True)
        (out / "notebooks" / f"{name}.html").write_text(page, encoding="utf-8")
        pages.append((f"notebooks/{name}.html", f"{name}: {title}"))
    return pages


def _provenance(runs: Mapping[str, Run]) -> dict[str, dict[str, str]]:
    """Where each run's numbers come from, row by row."""
    return {name: _about(run) for name, run in runs.items()}


def _about(run: Run) -> dict[str, str]:
    made = run.provenance
    machine = made.get("machine", {})
    return {
        "commit": str(made.get("commit") or "none"),
        "uncommitted changes": str(made.get("uncommitted_changes") or "none"),
        "code, SHA-256": str(made.get("code_sha256")),
        "environment.lock, SHA-256": str(made.get("lock_sha256") or "none"),
        "seed": str(made.get("seed")),
        "parameters": ", ".join(f"{key} {value}" for key, value in made["parameters"]["study"].items()),
        "inputs, SHA-256": "; ".join(f"{key} {value[:12]}…" for key, value in made.get("inputs_sha256", {}).items()),
        "finished": str(made.get("finished")),
        "seconds": f"{made.get('seconds', 0):.0f}",
        "most memory of one process": f"{made.get('peak_memory_mb', 0)} MB",
        "machine": ", ".join(str(value) for value in machine.values() if value),
        "packages": ", ".join(f"{key} {value}" for key, value in made.get("versions", {}).items()),
        "pairs, methods, cases that failed": f"{run.n_pairs}, {len(run.methods)}, {len(run.failures)}",
    }
