"""The command line: data, run, compare, register, cloud, report."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from study import __version__
from study.errors import StudyError

if TYPE_CHECKING:
    import pandas as pd

    from study.data.manifest import Manifest

DATASETS = "phantom, open, planted, ribseg, totalsegmentator, or a manifest file of your own"


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="study")
def cli() -> None:
    """Thoracic cartilage ultrasound-CT registration with a dense skeleton graph, as a reproducible study."""


@cli.group()
def data() -> None:
    """List, fetch and verify the files of a manifest."""


def _open_dataset(dataset: str | None) -> tuple[Manifest, str | None]:
    """The manifest and the cohort that ``--dataset`` names: a name in data_manifest.yaml, or a manifest file."""
    from study.data.manifest import load_manifest

    if dataset is None or not dataset.endswith((".yaml", ".yml")):
        return load_manifest(), dataset
    manifest = load_manifest(dataset)
    if len(manifest.cohorts) != 1:
        raise StudyError(f"{dataset}: expected one cohort, got {', '.join(manifest.cohorts)}; give each its own file")
    return manifest, next(iter(manifest.cohorts))


def _print_files(table: pd.DataFrame, dataset: str | None) -> None:
    if table.empty:
        click.echo(f"{dataset}: no files, it is generated")
    else:
        click.echo(table.to_string(index=False, na_rep="-"))


@data.command("list", short_help="Print every file and whether it is here.")
@click.option("--dataset", metavar="D", help="One cohort, or a manifest file; all when left out.")
def data_list(dataset: str | None) -> None:
    """Print every file: cohort, size, licence, and whether it is here."""
    from study.cohorts import cohort_of
    from study.data.fetch import data_list as table

    manifest, name = _open_dataset(dataset)
    _print_files(table(manifest, name and cohort_of(name)), dataset)


@data.command("fetch", short_help="Download what is missing, verified.")
@click.option("--dataset", default="open", show_default=True, metavar="D", help="The cohort, or a manifest file.")
def data_fetch(dataset: str) -> None:
    """Download what is missing, verified, into STUDY_DATA_DIR or the platform's cache folder."""
    from study.cohorts import cohort_of
    from study.data.fetch import fetch_all

    manifest, name = _open_dataset(dataset)
    paths = fetch_all(manifest, name and cohort_of(name), progress=True)
    for path in paths.values():
        click.echo(path)
    if not paths:
        click.echo(f"{dataset}: no files, it is generated")


@data.command("verify", short_help="Check every file against its SHA-256.")
@click.option("--dataset", metavar="D", help="One cohort, or a manifest file; all when left out.")
def data_verify(dataset: str | None) -> None:
    """Check the SHA-256 of every file; exit 1 when one is missing or wrong."""
    from study.cohorts import cohort_of
    from study.data.fetch import verify_all

    manifest, name = _open_dataset(dataset)
    table = verify_all(manifest, name and cohort_of(name))
    _print_files(table, dataset)
    click.get_current_context().exit(0 if (table["status"] == "verified").all() else 1)


@cli.command()
@click.option("--dataset", default="phantom", show_default=True, metavar="D", help=DATASETS + ".")
@click.option("--profile", default="full", show_default=True, metavar="quick|full", help="How much, how finely.")
@click.option("--methods", metavar="a,b", help="Methods to run; all when left out.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(min=1), help="Worker processes.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder of results.  [default: results/runs/<dataset>]")
def run(dataset: str, profile: str, methods: str | None, seed: int, jobs: int, out: Path | None) -> None:
    """Run every pair of a dataset with every method."""
    from study.batch import run_study
    from study.params import find_profile

    params = find_profile(profile)
    chosen = None if methods is None else [name.strip() for name in methods.split(",")]
    manifest, name = _open_dataset(dataset)
    assert name is not None
    folder = out or Path("results") / "runs" / name
    run_study(name, params, folder, methods=chosen, seed=seed, n_jobs=jobs, manifest=manifest, show_progress=True)
    _report(folder)


def _report(folder: Path) -> None:
    """Print what a run wrote: tables, waypoint errors, and the cases that failed with their reasons."""
    from study.results import FAILED, read_metrics, waypoint_summary

    metrics = read_metrics(folder / "metrics.csv")
    for table in sorted(folder.glob("hd_table*.md")):
        click.echo(f"\n{table.read_text(encoding='utf-8')}")
    if metrics["metric"].str.contains("waypoint_error").any():
        click.echo("Waypoint errors, mm (sec. IV-B; paper: its own volunteer, other data)\n")
        click.echo(waypoint_summary(metrics).round(2).to_string(index=False, na_rep="-"))
    failed = metrics[metrics["status"].str.startswith(FAILED)]
    for (subject, target, reason), cases in failed.groupby(["subject", "target", "status"], sort=False):
        click.echo(f"{subject} to {target}, {', '.join(cases['method'])}: {reason}")
    click.echo(f"metrics, tables and provenance: {folder}")


@cli.command()
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
def report(folder: Path) -> None:
    """Print the tables of every run under FOLDER."""
    runs = sorted(path.parent for path in folder.rglob("metrics.csv"))
    if not runs:
        raise StudyError(f"{folder}: expected runs with a metrics.csv below it, got none; run `study run` first")
    for path in runs:
        click.echo(f"\n## {path.relative_to(folder)}")
        _report(path)
    for label, pattern in (("figures", "*.png"), ("notebooks", "*.ipynb")):
        for place in sorted({path.parent for path in folder.rglob(pattern)}):
            click.echo(f"{label}: {place}")


@cli.command(short_help="Measure cartilages and sternum of every CT of a cohort.")
@click.option("--dataset", default="open", show_default=True, metavar="D", help="A cohort with images.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Table to write, .csv.")
def anatomy(dataset: str, out: Path) -> None:
    """Measure length, width, thickness, curvature and density of cartilages 2-5, and the sternum, per subject."""
    import pandas as pd

    from study.anatomy import measure_anatomy
    from study.cohorts import load_anatomy, pairs
    from study.params import find_profile
    from study.results import write_text

    params = find_profile("full")
    names = dict.fromkeys(name for pair in pairs(dataset, params) for name in pair)
    tables = []
    for name in names:
        subject = load_anatomy(dataset, name, params)
        if subject.image is None or subject.mask is None:
            raise StudyError(f"{dataset}: expected subjects with images, got {name} without; name another cohort")
        tables.append(measure_anatomy(subject.image, subject.mask, name))
    table = pd.concat(tables, ignore_index=True)
    write_text(out, table.to_csv(index=False, lineterminator="\n"))
    sizes = table[table["quantity"].isin(["length", "width", "thickness", "density_mean"])]
    click.echo(sizes.pivot_table(index="part", columns="quantity", values="value", sort=False).round(1).to_string())
    click.echo(f"{len(table)} measurements of {len(names)} subjects: {out}")


@cli.command(short_help="Check a run against a reference.")
@click.argument("reference", type=click.Path(path_type=Path))
@click.argument("candidate", type=click.Path(path_type=Path))
def compare(reference: Path, candidate: Path) -> None:
    """Check a run against a reference.

    Exit code 0: agrees; 1: differs, the largest differences are listed; 2: can't be compared.
    """
    from study.results import compare as compare_runs

    comparison = compare_runs(reference, candidate)
    click.echo(comparison.report())
    click.get_current_context().exit(comparison.exit_code)


@cli.command()
@click.argument("ct", type=click.Path(path_type=Path))
@click.argument("us", type=click.Path(path_type=Path))
@click.option("--method", default="skeleton_graph", show_default=True)
@click.option("--waypoints", type=click.Path(path_type=Path), help="CSV with columns x, y, z: mm in the CT frame.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of results.")
def register(ct: Path, us: Path, method: str, waypoints: Path | None, seed: int, out: Path) -> None:
    """Register two clouds of one's own (PLY, mm, any rigid pose)."""
    from study.data.clouds import read_ply, read_waypoints, write_registration
    from study.pipeline import find_method, register_pair

    find_method(method)
    path = None if waypoints is None else read_waypoints(waypoints)
    result = register_pair(read_ply(ct), read_ply(us), method=method, seed=seed)
    moved = None if path is None else result.transfer(path)
    for line in write_registration(result, moved, out):
        click.echo(line)
    for warning in [*result.warnings, *([] if result.converged else [f"not converged: {result.stop_reason}"])]:
        click.echo(f"study: warning: {warning}", err=True)


@cli.command(short_help="Cartilage cloud of a CT of one's own.")
@click.argument("ct", type=click.Path(path_type=Path))
@click.option("--labels", type=click.Path(path_type=Path), help="Label volume on the CT's grid.")
@click.option("--label-map", default="totalsegmentator_v2", show_default=True, help="Names of the label ids.")
@click.option("--landmarks", type=click.Path(path_type=Path), help="Landmark file, as in annotations/.")
@click.option("--points", default=9000, show_default=True, type=click.IntRange(min=500))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Cloud to write, .ply.")
def cloud(
    ct: Path, labels: Path | None, label_map: str, landmarks: Path | None, points: int, seed: int, out: Path
) -> None:
    """Cartilage cloud of a CT of one's own, from labels or landmarks."""
    from study.cohorts import read_anatomy
    from study.data.clouds import as_ply_path, write_ply
    from study.data.manifest import load_manifest
    from study.pipeline import named_rng

    out = as_ply_path(out)
    ids = load_manifest().label_ids(label_map)
    rng = named_rng(seed, f"cloud/{ct.name}")
    anatomy = read_anatomy(ct, points, rng, labels=labels, ids=ids, landmarks=landmarks)
    write_ply(anatomy.cloud, out)
    click.echo(f"{len(anatomy.cloud)} points of sternum and cartilages 2-5, mm RAS+: {out}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; an expected failure is one line on standard error and exit code 2."""
    chosen = None if arguments is None else list(arguments)
    try:
        code = cli.main(args=chosen, prog_name="study", standalone_mode=False)
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
        return 1
    except OSError as error:
        click.echo(f"study: expected a file or folder that can be read and written, got {error}", err=True)
        return 2
    except (click.Abort, KeyboardInterrupt):
        click.echo("study: stopped", err=True)
        return 130
    return code or 0


if __name__ == "__main__":
    sys.exit(main())
