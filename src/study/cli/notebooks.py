"""The command `study notebooks`: words in, exit code out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from study.errors import StudyError


@click.command(short_help="Execute the notebooks over a grid of parameters.")
@click.argument("names", nargs=-1, metavar="[NN]...")
@click.option("--dataset", metavar="a,b", help="Data sets.  [default: each notebook's own; of 50, all reported]")
@click.option("--seed", metavar="0,1,2", help="Seeds.  [default: 0]")
@click.option(
    "--methods", multiple=True, metavar="a,b", help="Methods of a run; given again, of another one.  [default: all]"
)
@click.option("--profile", metavar="quick|full", help="How much, how finely.  [default: full]")
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(min=1), help="Worker processes.")
@click.option("--fresh", is_flag=True, help="Start over: execute what is finished, too.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Folder of executed notebooks.  [default: results/runs/notebooks here with the parameters that the notebooks "
    "have of their own, else results/trials/notebooks]",
)
def notebooks(
    names: tuple[str, ...],
    dataset: str | None,
    seed: str | None,
    methods: tuple[str, ...],
    profile: str | None,
    jobs: int,
    fresh: bool,
    out: Path | None,
) -> None:
    """Execute notebooks NN (all when left out) through papermill, with every combination of the parameters given.

    A notebook gets only the parameters that it has. Each is kept with its parameters and times, also when it failed;
    what is finished is left as it is when the same command is given again.

    Exit code 0: done; 1: a notebook failed; 2: a name that nothing has, or data that can't be had.
    """
    from study.batch.notebooks import plan, run_notebooks
    from study.batch.papermills import find_notebooks
    from study.files.places import CHECKOUT, is_checkout
    from study.results.notebook_index import INDEX

    axes: dict[str, list[Any]] = {}
    if dataset is not None:  # a file is found from here, the kernels are elsewhere
        here = {one: str(Path(one).resolve()) for one in _words(dataset) if one.endswith((".yaml", ".yml"))}
        axes["dataset"] = [here.get(one, one) for one in _words(dataset)]
    if profile is not None:
        axes["profile"] = [profile]
    if seed is not None:
        axes["seed"] = _seeds(seed)
    if methods:
        axes["methods"] = [",".join(_words(those)) for those in methods]
    if out is None:
        out = Path("results") / ("trials" if axes else "runs") / "notebooks"
    folder = CHECKOUT / "notebooks" if is_checkout() else Path("notebooks")
    ended = run_notebooks(plan(find_notebooks(folder, names), axes), out, n_jobs=jobs, fresh=fresh, show_progress=True)
    failed = [one for one in ended if one.fault]
    for one in failed:
        click.echo(f"study: {one.name}: {one.fault}; kept as far as it came: {one.path}", err=True)
    n_kept = sum(one.kept for one in ended)
    click.echo(f"notebooks: {len(ended)}, finished before: {n_kept}, failed: {len(failed)}; {out / INDEX}")
    click.get_current_context().exit(1 if failed else 0)


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",")]


def _seeds(text: str) -> list[int]:
    if not all(word.isdecimal() for word in _words(text)):
        raise StudyError(f"--seed: expected whole numbers from 0 as in 0,1,2, got {text!r}")
    return [int(word) for word in _words(text)]
