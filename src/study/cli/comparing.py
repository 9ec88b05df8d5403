"""The commands that set runs against each other: compare, rerun."""

from __future__ import annotations

from pathlib import Path

import click

from study.errors import StudyError


@click.command(short_help="Check runs against a reference.")
@click.argument("reference", type=click.Path(path_type=Path))
@click.argument("candidate", type=click.Path(path_type=Path))
@click.option("--markdown", type=click.Path(path_type=Path), metavar="F", help="Write what changed for a reader, .md.")
@click.option("--json", type=click.Path(path_type=Path), metavar="F", help="Write every difference and mean, .json.")
@click.option("--junit", type=click.Path(path_type=Path), metavar="F", help="Write what CI reads as tests, .xml.")
def compare(reference: Path, candidate: Path, markdown: Path | None, json: Path | None, junit: Path | None) -> None:
    """Check a run, or a folder of runs, against a reference.

    Every value and every method's mean must be within its metric's tolerance, and the methods in the same order.
    All data sets are compared, whatever one of them shows.

    Exit code 0: agrees; 1: differs, the largest differences are listed; 2: something can't be compared.
    """
    from study.results.comparisons import compare_all

    comparisons = compare_all(reference, candidate)
    comparisons.write(markdown=markdown, json=json, junit=junit)
    if not comparisons.compared():
        raise StudyError("; ".join(dict.fromkeys(comparisons.refused().values())))
    click.echo(comparisons.report())
    click.get_current_context().exit(comparisons.exit_code)


@click.command(short_help="Repeat the run of a folder and compare.")
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(min=1), help="Worker processes.")
@click.option("--dataset", metavar="F", help="Where the manifest is now, of a run on a manifest of one's own.")
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder of the new run.  [default: results/trials/<folder>-rerun]"
)
def rerun(folder: Path, jobs: int, dataset: str | None, out: Path | None) -> None:
    """Repeat the run of FOLDER with its recorded data set, parameters, methods and seed, and compare.

    What is other than it was, as code, versions or machine, is said on standard error.

    Exit code 0: the same; 1: differs; 2: it can't be repeated, and why.
    """
    from study.batch.rerun import rerun as repeat
    from study.results.compare import compare as compare_runs

    out = out or Path("results", "trials", f"{folder.resolve().name}-rerun")
    run, told = repeat(folder, out, dataset=dataset, n_jobs=jobs, show_progress=True)
    for line in told:
        click.echo(f"study: note: {line}", err=True)
    comparison = compare_runs(folder, run.folder)
    click.echo(comparison.report())
    click.get_current_context().exit(comparison.exit_code)
