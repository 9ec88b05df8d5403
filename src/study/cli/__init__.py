"""The command line: data, run, notebooks, compare, rerun, register, cloud, landmarks, sweep, report."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from traceback import print_exc
from typing import TYPE_CHECKING

import click

from study import __version__
from study.cli.comparing import compare, rerun
from study.cli.notebooks import notebooks
from study.cli.own_data import cloud, landmarks, register
from study.cli.sweeping import sweep
from study.errors import StudyError
from study.offline import go_offline

if TYPE_CHECKING:
    import pandas as pd

    from study.data.schema import Manifest
    from study.results.run import Run

UNFORESEEN = 70  # EX_SOFTWARE of sysexits.h: none of 0 (agrees), 1 (differs), 2 (refused)
DATASETS = "A name in data_manifest.yaml (`study datasets` lists them), or a manifest file of your own."


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="study")
@click.option("--traceback", is_flag=True, envvar="STUDY_TRACEBACK", help="Show where an unforeseen error arose.")
@click.option("--offline", is_flag=True, help="Refuse every connection beyond this machine, as STUDY_OFFLINE=1 does.")
@click.pass_context
def cli(context: click.Context, traceback: bool, offline: bool) -> None:
    """Thoracic cartilage ultrasound-CT registration with a dense skeleton graph, as a reproducible study."""
    if isinstance(context.obj, dict):  # `main`, which asks for it after the context has gone
        context.obj["traceback"] = traceback
    if offline:
        go_offline()


cli.add_command(notebooks)


@cli.group()
def data() -> None:
    """List, fetch and verify the files of a manifest."""


def _files_of(dataset: str | None) -> tuple[Manifest, str | None]:
    """The manifest and the cohort whose files ``--dataset`` means: all when None."""
    from study.data.manifest import load_manifest
    from study.datasets import find_dataset

    if dataset is None:
        return load_manifest(), None
    chosen = find_dataset(dataset)
    return chosen.manifest, chosen.file_cohort


def _print_files(table: pd.DataFrame, dataset: str | None) -> None:
    if table.empty:
        click.echo(f"{dataset}: no files, it is generated")
    else:
        click.echo(table.to_string(index=False, na_rep="-"))


@data.command("list", short_help="Print every file and whether it is here.")
@click.option("--dataset", metavar="D", help="One cohort, or a manifest file; all when left out.")
def data_list(dataset: str | None) -> None:
    """Print every file: cohort, size, licence, and whether it is here."""
    from study.data.store import data_list as table

    manifest, cohort = _files_of(dataset)
    _print_files(table(manifest, cohort), dataset)


@data.command("fetch", short_help="Download what is missing, verified.")
@click.option("--dataset", default="open", show_default=True, metavar="D", help="The cohort, or a manifest file.")
def data_fetch(dataset: str) -> None:
    """Download what is missing, verified, into STUDY_DATA_DIR or the platform's cache folder."""
    from study.data.fetch import fetch_all

    manifest, cohort = _files_of(dataset)
    paths = fetch_all(manifest, cohort, progress=True)
    for path in paths.values():
        click.echo(path)
    if not paths:
        click.echo(f"{dataset}: no files, it is generated")


@data.command("verify", short_help="Check every file against its SHA-256.")
@click.option("--dataset", metavar="D", help="One cohort, or a manifest file; all when left out.")
def data_verify(dataset: str | None) -> None:
    """Check the SHA-256 of every file; exit 1 when one is missing or wrong."""
    from study.data.store import verify_all

    manifest, cohort = _files_of(dataset)
    table = verify_all(manifest, cohort)
    _print_files(table, dataset)
    click.get_current_context().exit(0 if (table["status"] == "verified").all() else 1)


@data.command("init", short_help="Write a commented manifest for a folder of CTs.")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="Manifest to write.  [default: FOLDER/manifest.yaml]"
)
def data_init(folder: Path, out: Path | None) -> None:
    """Write a commented manifest for a folder of CTs, with the labels or landmarks beside them."""
    from study.data.draft import draft_manifest
    from study.data.manifest import load_manifest
    from study.files.atomic import write_text

    out = out or folder / "manifest.yaml"
    if out.exists():
        raise StudyError(f"expected a new file, got {out}, which is there; delete it or give another name by --out")
    text, absent = draft_manifest(folder, out)
    write_text(out, text)
    cohort = next(iter(load_manifest(out).cohorts.values()))
    click.echo(f"{len(cohort.subjects)} CTs: {out}; look it over, then `study run --dataset {out}`")
    if absent:
        click.echo(f"study: warning: without labels or landmarks: {', '.join(absent)}; see `study landmarks`", err=True)


@cli.command("datasets", short_help="Print the names of the data sets.")
@click.option("--reported", is_flag=True, help="Only those that the study reports.")
@click.option("--evidence", is_flag=True, help="Only those that `make evidence` runs.")
def list_datasets(reported: bool, evidence: bool) -> None:
    """Print the names of the data sets, one a line."""
    from study.data.manifest import load_manifest

    for name, cohort in load_manifest().cohorts.items():
        if (cohort.reported or not reported) and (cohort.evidence or not evidence):
            click.echo(name)


@cli.command()
@click.option("--dataset", default="phantom", show_default=True, metavar="D", help=DATASETS)
@click.option("--profile", default="full", show_default=True, metavar="quick|full", help="How much, how finely.")
@click.option("--methods", metavar="a,b", help="Methods to run; all when left out.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(min=1), help="Worker processes.")
@click.option(
    "--scheduler", metavar="tcp://HOST:PORT", help="Use the workers of this Dask cluster; see docs/scaling.md."
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Folder of results.  [default: results/runs/<dataset> here for the full profile, all methods and seed 0, "
    "else a folder of its own below results/trials]",
)
def run(
    dataset: str, profile: str, methods: str | None, seed: int, jobs: int, scheduler: str | None, out: Path | None
) -> None:
    """Run every pair of a dataset with every method.

    A run that was stopped goes on when the same command is given again: finished cases are kept beside its folder.
    """
    from study.batch import run_study
    from study.datasets import find_dataset
    from study.params import find_profile
    from study.results.run import run_folder

    if scheduler is not None and jobs != 1:
        raise StudyError("expected either --jobs or --scheduler, got both; the cluster says how many workers there are")
    chosen = None if methods is None else [name.strip() for name in methods.split(",")]
    people = find_dataset(dataset, find_profile(profile), seed)
    if out is None:
        out = run_folder(people.name, profile, seed, chosen, Path())
    _report(run_study(people, out, methods=chosen, n_jobs=jobs, show_progress=True, scheduler=scheduler))


@cli.command(short_help="Gather what `make evidence` shows: robustness, sensitivity, more people.")
@click.option("--profile", default="full", show_default=True, metavar="quick|full", help="How much, how finely.")
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(min=1), help="Worker processes.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the folders of results.")
def evidence(profile: str, jobs: int, out: Path) -> None:
    """Run robustness, sensitivity and the data sets that the manifest calls evidence, each into a folder below OUT.

    A run that was stopped goes on when the same command is given again; what is there and of now is not run again.
    """
    from study.batch.evidence import run_evidence

    for folder in run_evidence(out, profile=profile, n_jobs=jobs, show_progress=True):
        click.echo(folder)


def _report(run: Run) -> None:
    """Print what a run wrote: tables, waypoint errors, the cases that failed, and whether the folder is as it was."""
    from study.results.run import FAILURES_LOG

    for table in run.tables():
        click.echo(f"\n{table.read_text(encoding='utf-8')}")
    if not run.values.empty:
        beside = "" if run.own_manifest else "; paper: its own volunteer, other data"
        click.echo(f"Waypoint errors, mm (sec. IV-B{beside})\n")
        click.echo(run.waypoint_summary().round(2).to_string(index=False, na_rep="-"))
    for (source, target, reason), cases in run.failures.groupby(["source", "target", "reason"], sort=False):
        click.echo(f"{source} to {target}, {', '.join(cases['method'])}: failed: {reason}")
    if (run.folder / FAILURES_LOG).is_file():
        click.echo(f"where in the code: {run.folder / FAILURES_LOG}")
    if run.condition:
        click.echo(f"study: warning: {run.folder}: the run {run.condition}", err=True)
    click.echo(f"metrics, tables and provenance: {run.folder}")


@cli.command(short_help="Print the tables of finished runs, or write all of it as pages.")
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False), default="results/runs")
@click.option(
    "--html", is_flag=True, help="Write FOLDER/report/index.html, which needs no network, and print its path."
)
@click.option("--dataset", metavar="a,b", help="With --html: only these; every reported one when left out.")
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(min=1), help="Worker processes of --html.")
def report(folder: Path, html: bool, dataset: str | None, jobs: int) -> None:
    """Print the tables of every run under FOLDER (results/runs when left out), or write its pages."""
    from study.results.run import find_runs, visible

    if html:
        from study.datasets import reported
        from study.report import write_report
        from study.results.finding import one_line
        from study.results.run import Run

        chosen = reported() if dataset is None else [name.strip() for name in dataset.split(",")]
        page = write_report(folder, chosen, n_jobs=jobs, show_progress=True)
        click.echo(f"finding: {one_line({name: Run(folder / name) for name in chosen})}")
        click.echo(f"report: {page}")
        return
    for run in find_runs(folder):
        click.echo(f"\n## {run.folder.relative_to(folder)}")
        _report(run)
    for label, pattern in (("figures", "*.png"), ("notebooks", "*.ipynb")):
        for place in sorted({path.parent for path in visible(folder, pattern)}):
            click.echo(f"{label}: {place}")


@cli.command(short_help="Measure cartilages and sternum of every CT of a cohort.")
@click.option("--dataset", default="open", show_default=True, metavar="D", help="A cohort with images.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Table to write, .csv.")
def anatomy(dataset: str, out: Path) -> None:
    """Measure length, width, thickness, curvature and density of cartilages 2-5, and the sternum, per subject."""
    import pandas as pd

    from study.ct.sizes import measure_anatomy
    from study.datasets import find_dataset
    from study.files.atomic import write_text

    people = find_dataset(dataset)
    tables = []
    for name in people.names():
        subject = people.anatomy(name)
        if subject.image is None or subject.mask is None:
            raise StudyError(f"{dataset}: expected subjects with images, got {name} without; name another cohort")
        tables.append(measure_anatomy(subject.image, subject.mask, name))
    table = pd.concat(tables, ignore_index=True)
    write_text(out, table.to_csv(index=False, lineterminator="\n"))
    sizes = table[table["quantity"].isin(["length", "width", "thickness", "density_mean"])]
    click.echo(sizes.pivot_table(index="part", columns="quantity", values="value", sort=False).round(1).to_string())
    click.echo(f"{len(table)} measurements of {len(people.names())} subjects: {out}")


cli.add_command(compare)
cli.add_command(rerun)
cli.add_command(sweep)
cli.add_command(cloud)
cli.add_command(landmarks)
cli.add_command(register)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; an expected failure is one line on standard error and exit code 2, any other code 70."""
    chosen = None if arguments is None else list(arguments)
    options = {"traceback": False}
    try:
        code = cli.main(args=chosen, prog_name="study", standalone_mode=False, obj=options)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return 0
    except click.ClickException as error:
        command = error.ctx.command_path if isinstance(error, click.UsageError) and error.ctx else "study"
        click.echo(f"study: {' '.join(error.format_message().split())} (see `{command} --help`)", err=True)
        return 2
    except StudyError as error:
        click.echo(f"study: {' '.join(str(error).split())}", err=True)
        return 2
    except BrokenPipeError:  # whoever read the output has gone: `study data list | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141  # as a shell says of SIGPIPE; 1 is what `study compare` says of runs that differ
    except OSError as error:
        click.echo(f"study: expected a file or folder that can be read and written, got {error}", err=True)
        return 2
    except (click.Abort, KeyboardInterrupt):
        click.echo("study: stopped", err=True)
        return 130
    except Exception as error:  # the last line of defence: a bug, or a machine without memory
        if options["traceback"]:
            print_exc()
        reason = " ".join(f"{type(error).__name__} {error}".split())[:500]
        click.echo(
            f"study: expected no such error, got {reason}; please report it with what `study --traceback ...` shows",
            err=True,
        )
        return UNFORESEEN
    return code or 0
