"""The command line: data, run, compare, register, cloud, report."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import click

from study import __version__
from study.errors import StudyError

DATASETS = "phantom, open, planted, ribseg, totalsegmentator, or a manifest file of your own"


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="study")
def cli() -> None:
    """Thoracic cartilage ultrasound-CT registration with a dense skeleton graph, as a reproducible study."""


@cli.group()
def data() -> None:
    """List, fetch and verify the files of data_manifest.yaml."""


def _dataset_option(function: click.decorators.FC) -> click.decorators.FC:
    return click.option("--dataset", metavar="D", help="One cohort; all when left out.")(function)


@data.command("list")
@_dataset_option
def data_list(dataset: str | None) -> None:
    """Print every file: cohort, size, licence, and whether it is here."""
    from study.data.fetch import data_list as table
    from study.data.manifest import load_manifest

    click.echo(table(load_manifest(), dataset).to_string(index=False))


@data.command("fetch")
@click.option("--dataset", default="open", show_default=True, metavar="D", help="The cohort to fetch.")
def data_fetch(dataset: str) -> None:
    """Download what is missing, verified, into STUDY_DATA_DIR or the platform's cache folder."""
    from study.data.fetch import fetch_all
    from study.data.manifest import load_manifest

    for path in fetch_all(load_manifest(), dataset, progress=True).values():
        click.echo(path)


@data.command("verify")
@_dataset_option
def data_verify(dataset: str | None) -> None:
    """Check the SHA-256 of every file that is here; exit 1 when one is missing or wrong."""
    from study.data.fetch import verify_all
    from study.data.manifest import load_manifest

    table = verify_all(load_manifest(), dataset)
    click.echo(table.to_string(index=False))
    if not (table["status"] == "verified").all():
        sys.exit(1)


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
    from study.data.manifest import load_manifest
    from study.params import find_profile

    params = find_profile(profile)
    if dataset.endswith((".yaml", ".yml")):
        manifest = load_manifest(dataset)
        if len(manifest.cohorts) != 1:
            raise StudyError(f"{dataset}: expected one cohort to run, got {', '.join(manifest.cohorts)}; keep one")
        dataset = next(iter(manifest.cohorts))
    else:
        manifest = load_manifest()
    folder = out or Path("results") / "runs" / dataset
    chosen = methods.split(",") if methods else None
    run_study(
        dataset, params, folder, methods=chosen, seed=seed, n_jobs=jobs, manifest=manifest, show_progress=True
    )
    _report(folder)


def _report(folder: Path) -> None:
    from study.results import read_metrics, waypoint_summary

    for table in sorted(folder.glob("hd_table*.md")):
        click.echo(f"\n{table.read_text(encoding='utf-8')}")
    click.echo("Waypoint errors, mm (sec. IV-B; paper: its own volunteer, other data)\n")
    click.echo(waypoint_summary(read_metrics(folder / "metrics.csv")).round(2).to_string(index=False, na_rep="-"))
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


@cli.command()
@click.argument("reference", type=click.Path(path_type=Path))
@click.argument("candidate", type=click.Path(path_type=Path))
def compare(reference: Path, candidate: Path) -> None:
    """Check a run against a reference: exit 0 agrees, 1 differs, 2 no comparison."""
    from study.results import compare as compare_runs

    comparison = compare_runs(reference, candidate)
    click.echo(comparison.report())
    sys.exit(comparison.exit_code)


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


@cli.command()
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
    from study.cartilage_growth import parts_from_landmarks, parts_from_ribs
    from study.cohorts import anatomy_of
    from study.ct import parts_from_labels
    from study.data.clouds import write_ply
    from study.data.landmarks import read_landmarks
    from study.data.manifest import load_manifest
    from study.data.volumes import read_labels, read_volume
    from study.pipeline import named_rng

    if (labels is None) == (landmarks is None):
        raise StudyError("expected either --labels or --landmarks, got both or neither")
    image = read_volume(ct)
    if landmarks is not None:
        mask = parts_from_landmarks(image, read_landmarks(landmarks))
    else:
        assert labels is not None
        ids = {name: label for label, name in load_manifest().label_map(label_map).items()}
        whole = "costal_cartilages" in ids
        volume = read_labels(labels, image)
        mask = parts_from_labels(volume, ids) if whole else parts_from_ribs(image, volume, ids)
    anatomy = anatomy_of(ct.name, image, mask, points, named_rng(seed, f"cloud/{ct.name}"))
    write_ply(anatomy.cloud, out)
    click.echo(f"{len(anatomy.cloud)} points of sternum and cartilages 2-5, mm RAS+: {out}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; an expected failure is one line on standard error and exit code 2."""
    try:
        cli.main(args=None if arguments is None else list(arguments), prog_name="study", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return 0
    except click.ClickException as error:
        click.echo(f"study: {error.format_message()} (see `study --help`)", err=True)
        return 2
    except StudyError as error:
        click.echo(f"study: {' '.join(str(error).split())}", err=True)
        return 2
    except (click.Abort, KeyboardInterrupt):
        click.echo("study: stopped", err=True)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
