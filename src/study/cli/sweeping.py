"""The command that makes a cloud of a tracked sweep: sweep."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(short_help="Cartilage cloud of a tracked sweep of one's own.")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--config", type=click.Path(path_type=Path), help="PLUS configuration (.xml) or calibration (.json).")
@click.option("--masks", type=click.Path(path_type=Path), help=".seg.nrrd, .nrrd, .mha, .nii.gz or a folder of PNGs.")
@click.option("--segment", "segments", multiple=True, metavar="NAME", help="Segment of a .seg.nrrd; may be repeated.")
@click.option("--probe", default="Probe", show_default=True, metavar="NAME", help="The probe's frame in RECORDING.")
@click.option("--base", metavar="NAME", help="Base frame.  [default: Reference where RECORDING has one, else Tracker]")
@click.option("--latency", type=float, metavar="S", help="How late frames are stamped, instead of the recording's.")
@click.option("--spacing", default=1.5, show_default=True, type=click.FloatRange(min=0, min_open=True), metavar="MM")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Cloud to write, .ply.")
def sweep(
    recording: Path,
    config: Path | None,
    masks: Path | None,
    segments: tuple[str, ...],
    probe: str,
    base: str | None,
    latency: float | None,
    spacing: float,
    out: Path,
) -> None:
    """Cartilage cloud of a tracked sweep: a PLUS sequence (.mha, .nrrd) or a folder of masks and tables.

    Without masks the surface is looked for in the B-mode itself, a baseline that needs no training: look at the
    picture before you use what it found. Beside the cloud lie a picture (.png) and what became of every frame (.json).
    """
    from study.recording import cloud_of_recording

    for line in cloud_of_recording(
        recording, out, config=config, masks=masks, segments=segments, probe=probe, base=base, latency_s=latency,
        spacing_mm=spacing, show_progress=True,
    ):  # fmt: skip
        click.echo(line, err=line.startswith("study: warning"))
