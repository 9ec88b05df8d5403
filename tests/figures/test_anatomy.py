"""Slices, projections and surfaces lie at their millimetres, the patient's right at the left."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from figure_data import CLOUD, TETRAHEDRON, texts
from matplotlib.figure import Figure

from study import figures
from study.types import Part, RigidTransform, Volume


def volumes() -> tuple[Volume, Volume]:
    """A block of soft tissue and, on a crop of its grid, a mask with a sternum, R3 and L3."""
    values = np.full((40, 20, 30), 40, dtype=np.int16)
    mask = np.full((30, 10, 20), int(Part.UNKNOWN), dtype=np.int8)
    mask[13:17, 3:7, 4:16] = Part.STERNUM
    mask[18:28, 3:7, 8:12] = Part.RIGHT_3
    mask[2:12, 3:7, 8:12] = Part.LEFT_3
    spacing = np.array([1.5, 1.5, 2.0])
    whole = Volume(values, spacing, RigidTransform(translation=np.array([-30.0, 10, -20])), "ct")
    return whole, Volume(mask, spacing, RigidTransform(translation=whole.to_mm([[5, 4, 6]])[0]), "parts")


def wall() -> figures.FrontWall:
    volume, _ = volumes()
    x_mm, z_mm = (volume.to_mm(np.eye(3)[axis] * np.arange(volume.shape[axis])[:, None])[:, axis] for axis in (0, 2))
    return figures.FrontWall(np.asarray(volume.values, dtype=np.float64).mean(axis=1).T, x_mm, z_mm, "a")


FRAMES = {"cartilage": np.eye(20, 30), "rib": np.eye(20, 30)}
EXAMPLES: dict[str, Callable[[], Figure]] = {
    "ct_slice": lambda: figures.ct_slice(*volumes()),
    "anatomy_overview": lambda: figures.anatomy_overview({"a": volumes(), "b": volumes()}),
    "front_wall": lambda: figures.front_wall(wall(), volumes()[1], reference=volumes()[1]),
    "biomarker": lambda: figures.biomarker(wall(), volumes()[1], FRAMES, (51.0, 35.0)),
    "mesh_and_cloud": lambda: figures.mesh_and_cloud(TETRAHEDRON, CLOUD),
}
REFUSED: dict[str, Callable[[], Figure]] = {
    "empty mask": lambda: figures.ct_slice(
        volumes()[0], volumes()[1].with_values(np.full_like(volumes()[1].values, -1))
    ),
    "mask of another grid": lambda: figures.ct_slice(
        volumes()[0], Volume(volumes()[1].values, np.array([1.0, 1.0, 1.0]))
    ),
    "place outside": lambda: figures.ct_slice(*volumes(), at_mm=(500.0, 0.0, 0.0)),
    "an empty mask of a wall": lambda: figures.front_wall(
        wall(), volumes()[1].with_values(np.full(volumes()[1].shape, -1))
    ),
    "no frames": lambda: figures.biomarker(wall(), volumes()[1], {}, (51.0, 35.0)),
    "no subjects": lambda: figures.anatomy_overview({}),
}


def test_ct_slice_draws_right_parts_left_and_contours_where_the_mask_is() -> None:
    volume, mask = volumes()
    axial = figures.ct_slice(volume, mask).axes[0]
    by_colour = {}
    for drawn in axial.collections:
        vertices = np.concatenate([path.vertices for path in drawn.get_paths() if len(path.vertices)])
        by_colour[tuple(np.round(drawn.get_edgecolor()[0][:3], 3))] = vertices
    right = by_colour[tuple(np.round(figures.PART_COLOUR[Part.RIGHT_3], 3))]
    left = by_colour[tuple(np.round(figures.PART_COLOUR[Part.LEFT_3], 3))]
    assert right[:, 0].max() < left[:, 0].min()
    inside = mask.to_mm(np.argwhere(mask.values == Part.RIGHT_3))
    np.testing.assert_allclose(-right[:, 0].max(), inside[:, 0].min() - 0.75, atol=1e-6)
    np.testing.assert_allclose(-right[:, 0].min(), inside[:, 0].max() + 0.75, atol=1e-6)
    np.testing.assert_allclose(right[:, 1].max(), inside[:, 1].max() + 0.75, atol=1e-6)


def test_the_legend_of_a_slice_names_only_what_is_there() -> None:
    shown = texts(figures.ct_slice(*volumes()))
    assert "sternum" in shown
    assert "cartilage 3" in shown
    assert "cartilage 4" not in shown


def test_the_front_wall_lies_under_the_outlines_of_its_parts() -> None:
    _, mask = volumes()
    ax = figures.front_wall(wall(), mask).axes[0]
    (image,) = ax.get_images()
    low, high, bottom, top = image.get_extent()
    vertices = np.concatenate([p.vertices for drawn in ax.collections for p in drawn.get_paths() if len(p.vertices)])
    inside = mask.to_mm(np.argwhere(mask.values >= 0))
    np.testing.assert_allclose(vertices[:, 0].max(), -inside[:, 0].min() + mask.spacing_mm[0] / 2, atol=1e-6)
    np.testing.assert_allclose(vertices[:, 1].max(), inside[:, 2].max() + mask.spacing_mm[2] / 2, atol=1e-6)
    assert bottom < top
    assert low < high


def test_image_pixels_lie_at_their_millimetres() -> None:
    volume, mask = volumes()
    values = np.array(volume.values)
    values[7, :, :] = 300  # one sagittal plane
    image = figures.ct_slice(volume.with_values(values), mask).axes[0].get_images()[0]
    low, high, *_ = image.get_extent()
    column = int(np.argmax(np.asarray(image.get_array())[3]))
    x = low + (column + 0.5) * (high - low) / volume.shape[0]
    np.testing.assert_allclose(x, -volume.to_mm([[7, 0, 0]])[0, 0], atol=1e-9)
