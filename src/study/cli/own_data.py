"""The commands for scans and clouds of one's own: register, cloud, landmarks."""

from __future__ import annotations

from pathlib import Path

import click

from study.errors import StudyError


@click.command(short_help="Register two clouds of one's own.")
@click.argument("ct", type=click.Path(path_type=Path))
@click.argument("us", type=click.Path(path_type=Path))
@click.option(
    "--method",
    default="skeleton_graph",
    show_default=True,
    help="A name in METHODS; the default is the paper's, gaussian_process has the smallest true error.",
)
@click.option("--waypoints", type=click.Path(path_type=Path), help="Of the CT frame, mm: .csv, .mrk.json or .fcsv.")
@click.option(
    "--radius",
    default=20.0,
    show_default=True,
    type=click.FloatRange(min=0, min_open=True),
    metavar="MM",
    help="Sphere around a waypoint whose points carry it.",
)
@click.option("--front", metavar="X,Y,Z", help="Direction from the chest to the probe, in the frame of US, RAS.")
@click.option("--field", metavar="GRID|MM", help="Displacement field too, on an image's grid (US frame) or of MM.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of results.")
def register(
    ct: Path,
    us: Path,
    method: str,
    waypoints: Path | None,
    radius: float,
    front: str | None,
    field: str | None,
    seed: int,
    out: Path,
) -> None:
    """Register two clouds of one's own (PLY, mm, any rigid pose): sternum and cartilages 2-5, nothing else.

    A property "time" of US's vertices says when each was seen, in seconds; methods that know of breathing use it.
    A comment SPACE=LPS in a PLY file is heeded. docs/formats.md says what is read and written; files of an earlier
    registration in OUT are replaced, other files stay.
    """
    from study.files.register_files import register_files

    towards = None if front is None else _numbers(front, "--front", "X,Y,Z", 3)
    lines, warnings = register_files(
        ct, us, out, method=method, waypoints=waypoints, radius_mm=radius, front=towards, seed=seed, field=field
    )
    for line in lines:
        click.echo(line)
    for warning in warnings:
        click.echo(f"study: warning: {warning}", err=True)


def _numbers(text: str, option: str, shape: str, n: int) -> list[float]:
    """The numbers of an option, as many as it has."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != n:
        raise StudyError(
            f"{option}: expected {n} numbers as in {','.join('012'[:n])}, got {text!r}; give it as {shape}"
        )
    return numbers


@click.command(short_help="Cartilage cloud of a CT of one's own.")
@click.argument("ct", type=click.Path(path_type=Path))
@click.option(
    "--labels",
    type=click.Path(path_type=Path),
    help="Label volume on the CT's grid, or a folder of masks as TotalSegmentator writes it.",
)
@click.option("--label-map", default="totalsegmentator_v2", show_default=True, help="Names of the label ids.")
@click.option(
    "--landmarks", type=click.Path(path_type=Path), help="Landmark file as in annotations/, or Slicer's points."
)
@click.option("--points", default=9000, show_default=True, type=click.IntRange(min=500))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Cloud to write, .ply.")
def cloud(
    ct: Path, labels: Path | None, label_map: str, landmarks: Path | None, points: int, seed: int, out: Path
) -> None:
    """Cartilage cloud of a CT of one's own, from labels or landmarks."""
    from study.data.manifest import load_manifest
    from study.datasets import read_anatomy
    from study.files.clouds import as_ply_path, write_ply
    from study.seeds import named_rng

    out = as_ply_path(out)
    ids = load_manifest().label_ids(label_map)
    rng = named_rng(seed, f"cloud/{ct.name}")
    anatomy = read_anatomy(ct, points, rng, labels=labels, ids=ids, landmarks=landmarks)
    write_ply(anatomy.cloud, out)
    click.echo(f"{len(anatomy.cloud)} points of sternum and cartilages 2-5, mm RAS+: {out}")


@click.command(short_help="Pictures and places for the landmarks of a CT.")
@click.argument("ct", type=click.Path(path_type=Path))
@click.option("--pick", "picks", multiple=True, metavar="X,Z", help="Place in the front view; may be given many times.")
@click.option(
    "--slice", "heights", multiple=True, type=float, metavar="Z", help="Axial slice to draw; may be repeated."
)
@click.option("--check", type=click.Path(path_type=Path), help="Landmark file, or Slicer's points: draw what grows.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Folder of pictures.")
def landmarks(
    ct: Path, picks: tuple[str, ...], heights: tuple[float, ...], check: Path | None, out: Path | None
) -> None:
    """Draw the front of a chest, turn picks in it into millimetres, and check a landmark file.

    \b
    study landmarks CT --out pictures                      front.png, to read x and z from
    study landmarks CT --pick 33.5,-85.6 --pick -30,-86    x, y, z of places in it, a line each
    study landmarks CT --slice -120 --out pictures         slices.png, to read x and y from
    study landmarks CT --check mine.yaml --out pictures    check-front.png and check-panels.png: what grows from it
    """
    from study.ct.growth import parts_from_landmarks
    from study.ct.wall import anterior_wall_image
    from study.figures.canvas import png
    from study.figures.landmarks import axial_slices, chest_front, landmark_panels
    from study.files.atomic import write_bytes
    from study.files.landmarks import read_landmarks
    from study.files.volumes import read_volume

    if out is None and (heights or check or not picks):
        raise StudyError("expected --out, the folder of the pictures, got none; add it, or ask for --pick X,Z alone")
    places = [_numbers(pick, "--pick", "X,Z", 2) for pick in picks]
    placed = None if check is None else read_landmarks(check)
    image = read_volume(ct)
    wall = anterior_wall_image(image)
    for x, z in places:
        click.echo("[{:.1f}, {:.1f}, {:.1f}]".format(*wall.pick(x, z)))
    if out is None:
        return
    figures = {}
    if heights:
        figures["slices"] = axial_slices(image, heights)
    if placed is not None:
        grown = parts_from_landmarks(image, placed)
        figures["check-front"] = chest_front(wall, placed, grown)
        figures["check-panels"] = landmark_panels(image, placed, grown)
    if not figures:
        figures["front"] = chest_front(wall)
    for name, figure in figures.items():
        write_bytes(out / f"{name}.png", png(figure))
        click.echo(out / f"{name}.png")
