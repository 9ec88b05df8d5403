"""Pictures that show where to look for the landmarks of a CT, and the millimetres of what was picked.

    python tools/pick_landmarks.py CT --out pictures/                       front.png and a grid to read x, z from
    python tools/pick_landmarks.py CT --out pictures/ --slices -120 -125    those axial slices, to read x, y from
    python tools/pick_landmarks.py CT --pick 33.5 -85.6                     the 3-D point under a pick
    python tools/pick_landmarks.py CT --out pictures/ --check FILE.yaml     its points, and what grows from them

Read x and z from the front view, refine x and y in the axial slice at that z, write `annotations/<subject>.yaml`,
and look at `check-*.png`: green crosses must lie in the middle of each cartilage's ends, red outlines on cartilage.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from study.ct.growth import parts_from_landmarks
from study.ct.landmarks import Landmarks
from study.ct.wall import WallImage, anterior_wall_image
from study.files.landmarks import read_landmarks
from study.files.volumes import read_volume
from study.types import Part, Volume


def marked(landmarks: Landmarks) -> np.ndarray:
    return np.vstack([*landmarks.junctions.values(), *landmarks.attachments.values(), landmarks.sternum])


def draw_front(wall: WallImage, out: Path, landmarks: Landmarks | None, half_width_mm: float = 130.0) -> None:
    figure, axis = plt.subplots(figsize=(16, 16))
    extent = (wall.x_mm[0], wall.x_mm[-1], wall.z_mm[0], wall.z_mm[-1])
    axis.imshow(wall.image, cmap="gray", origin="lower", extent=extent, vmin=-20, vmax=150)
    centre = float(wall.x_mm.mean())
    axis.set_xlim(
        centre + half_width_mm, centre - half_width_mm
    )  # the patient's right on the left, as seen from the front
    axis.xaxis.set_major_locator(plt.MultipleLocator(10))
    axis.yaxis.set_major_locator(plt.MultipleLocator(10))
    axis.tick_params(labelsize=8, labelrotation=45)
    axis.grid(alpha=0.3)
    axis.set_xlabel("x mm (patient's right on the left)")
    axis.set_ylabel("z mm")
    if landmarks is not None:
        points = marked(landmarks)
        axis.plot(points[:, 0], points[:, 2], "+", color="lime", markersize=14)
    figure.tight_layout()
    figure.savefig(out, dpi=70)
    plt.close(figure)


def draw_slices(ct: Volume, heights: list[float], out: Path, landmarks: Landmarks | None, mask: Volume | None) -> None:
    rows = -(-len(heights) // 2)
    figure, axes = plt.subplots(rows, 2, figsize=(24, 8 * rows), squeeze=False)
    for axis, z in zip(axes.flat, heights, strict=False):
        k = int(np.clip(np.rint(ct.to_index([[0, 0, z]])[0, 2]), 0, ct.shape[2] - 1))
        image = ct.values[:, :, k].T
        first, last = ct.to_mm([[0, 0, k], [ct.shape[0] - 1, ct.shape[1] - 1, k]])
        extent = (first[0], last[0], first[1], last[1])
        axis.imshow(image, cmap="gray", origin="lower", extent=extent, vmin=-80, vmax=280)
        body = np.flatnonzero((image > -300).sum(axis=1) > 60)
        front = first[1] + body.max() * ct.spacing_mm[1]
        axis.set_ylim(front - 90, front + 5)
        axis.set_xlim(last[0] - 60, first[0] + 60)
        axis.xaxis.set_major_locator(plt.MultipleLocator(10))
        axis.yaxis.set_major_locator(plt.MultipleLocator(10))
        axis.grid(alpha=0.25)
        axis.set_title(f"z = {z:g} mm")
        if landmarks is not None:
            points = marked(landmarks)
            points = points[np.abs(points[:, 2] - z) < max(3.0, ct.spacing_mm[2] / 2)]
            axis.plot(points[:, 0], points[:, 1], "+", color="lime", markersize=14)
        if mask is not None:
            m = int(np.rint(mask.to_index([[0, 0, z]])[0, 2]))
            if 0 <= m < mask.shape[2]:
                a, b = mask.to_mm([[0, 0, m], [mask.shape[0] - 1, mask.shape[1] - 1, m]])
                xs, ys = np.linspace(a[0], b[0], mask.shape[0]), np.linspace(a[1], b[1], mask.shape[1])
                for part in Part:
                    inside = mask.values[:, :, m] == part
                    if part >= 0 and inside.any():
                        axis.contour(xs, ys, inside.T, [0.5], colors=["yellow" if part == 0 else "red"], linewidths=1)
    for axis in axes.flat[len(heights) :]:
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(out, dpi=50)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ct", type=Path)
    parser.add_argument("--out", type=Path, default=Path())
    parser.add_argument("--slices", type=float, nargs="*", default=[])
    parser.add_argument("--pick", type=float, nargs=2, metavar=("X", "Z"))
    parser.add_argument("--check", type=Path)
    options = parser.parse_args()
    ct = read_volume(options.ct)
    options.out.mkdir(parents=True, exist_ok=True)
    landmarks = read_landmarks(options.check) if options.check else None
    if options.pick:
        print(anterior_wall_image(ct).pick(*options.pick).round(1).tolist())
        return
    prefix = "check-" if landmarks else ""
    mask = parts_from_landmarks(ct, landmarks) if landmarks else None
    if options.slices or landmarks is not None:
        heights = options.slices or sorted({float(z) for z in np.rint(marked(landmarks)[:, 2])}, reverse=True)
        draw_slices(ct, heights, options.out / f"{prefix}slices.png", landmarks, mask)
    if not options.slices:
        draw_front(anterior_wall_image(ct), options.out / f"{prefix}front.png", landmarks)


if __name__ == "__main__":
    main()
