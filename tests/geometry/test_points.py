"""Rigid fits, axes and pixels against planted motions and independent solutions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles_som import rigid_literal

from study.errors import StudyError
from study.geometry.points import (
    close_gaps,
    farthest_points,
    fit_rigid,
    fit_rigid_batch,
    foremost_in_cells,
    largest_component,
    nearest,
    pixelise,
    principal_axes,
    sample_spacing_mm,
)
from study.types import RigidTransform

SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(SEEDS, st.integers(3, 40))
def test_a_planted_motion_is_recovered(seed, n):
    rng = np.random.default_rng(seed)
    points, motion = rng.normal(scale=50, size=(n, 3)), RigidTransform.random(rng)
    fitted = fit_rigid(points, motion.apply(points))
    assert fitted.apply(points) == pytest.approx(motion.apply(points), abs=1e-8)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(SEEDS, st.integers(3, 40), st.sampled_from(["volume", "plane"]))
def test_a_mirrored_cloud_is_never_fitted_by_a_reflection(seed, n, shape):
    rng = np.random.default_rng(seed)
    points = rng.normal(scale=50, size=(n, 3)) * ([1, 1, 1] if shape == "volume" else [1, 1, 0])
    mirrored = points * [-1, 1, 1]
    assert np.linalg.det(fit_rigid(points, mirrored).rotation) == pytest.approx(1)


def test_the_fit_of_noisy_pairs_is_horns():
    rng = np.random.default_rng(0)
    for n in (3, 4, 25):
        source = rng.normal(scale=30, size=(n, 3))
        target = source * [-1, 1, 1] + rng.normal(scale=10, size=(n, 3))
        fitted = fit_rigid(source, target)
        rotation, translation = rigid_literal(source, target)
        assert fitted.rotation == pytest.approx(rotation, abs=1e-9)
        assert fitted.translation == pytest.approx(translation, abs=1e-8)


def test_weights_count_as_repeated_points():
    rng = np.random.default_rng(1)
    source, target = rng.normal(size=(2, 6, 3))
    times = np.array([1, 2, 3, 1, 0, 2])
    weighted = fit_rigid(source, target, times.astype(float))
    repeated = fit_rigid(np.repeat(source, times, axis=0), np.repeat(target, times, axis=0))
    assert weighted.matrix == pytest.approx(repeated.matrix, abs=1e-9)


def test_a_batch_is_many_single_fits_and_padding_changes_none():
    rng = np.random.default_rng(2)
    source, target = rng.normal(size=(2, 5, 7, 3))
    weights = np.ones((5, 7))
    weights[:, 5:] = 0
    rotations, translations = fit_rigid_batch(source, target, weights / weights.sum(axis=1, keepdims=True))
    assert np.linalg.det(rotations) == pytest.approx(np.ones(5))
    for b in range(5):
        single = fit_rigid(source[b, :5], target[b, :5])
        assert rotations[b] == pytest.approx(single.rotation, abs=1e-9)
        assert translations[b] == pytest.approx(single.translation, abs=1e-9)


def test_a_fit_without_enough_pairs_is_an_error():
    with pytest.raises(StudyError, match="expected at least 3 pairs for a rigid fit, got 2"):
        fit_rigid(np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(StudyError, match=r"expected paired \(n, 3\) points, got \(3, 3\) and \(4, 3\)"):
        fit_rigid(np.zeros((3, 3)), np.zeros((4, 3)))


def test_nearest_is_brute_force():
    rng = np.random.default_rng(3)
    queries, cloud = rng.normal(size=(40, 3)), rng.normal(size=(90, 3))
    distances, index = nearest(queries, cloud)
    table = np.linalg.norm(queries[:, None] - cloud[None], axis=2)
    assert np.array_equal(index, table.argmin(axis=1))
    assert distances == pytest.approx(table.min(axis=1))


def test_principal_axes_are_right_handed_and_fall_in_spread():
    rng = np.random.default_rng(4)
    motion = RigidTransform.random(rng)
    points = motion.apply(rng.normal(size=(5000, 3)) * [30.0, 10.0, 2.0])
    centre, axes = principal_axes(points)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert ((points - centre) @ axes.T).std(axis=0) == pytest.approx([30, 10, 2], rel=0.05)
    # 5,000 draws place an axis to within 1/sqrt(5000) of the ratio of spreads: 0.01 rad.
    assert np.abs(np.sum(axes * motion.rotation.T, axis=1)) == pytest.approx(np.ones(3), abs=1e-3)


def test_a_moved_cloud_has_the_moved_principal_axes():
    rng = np.random.default_rng(8)
    points = rng.gamma(2.0, size=(500, 3)) * [30.0, 10.0, 2.0]
    centre, axes = principal_axes(points)
    for _ in range(20):
        motion = RigidTransform.random(rng)
        moved_centre, moved_axes = principal_axes(motion.apply(points))
        assert moved_axes == pytest.approx(axes @ motion.rotation.T, abs=1e-9)
        assert moved_centre == pytest.approx(motion.apply(centre[None])[0], abs=1e-9)


def test_every_point_lies_in_its_pixel():
    points = np.random.default_rng(5).uniform(-37, 55, (300, 2))
    image, pixels, origin = pixelise(points, 3.0, pad=2)
    assert np.abs(pixels * 3.0 + origin - points).max() <= 1.5 + 1e-9
    assert image[tuple(pixels.T)].all()
    assert image.sum() == len(np.unique(pixels, axis=0))
    assert image[2:-2, 2:-2].sum() == image.sum()


def test_closing_fills_small_gaps_only_and_removes_nothing():
    image = np.ones((60, 60), dtype=bool)
    image[20:24, 20:24] = False  # a hole of 4 pixels
    image[35:55, 10:50] = False  # one of 20
    closed = close_gaps(image, 3)
    assert closed[20:24, 20:24].all()
    assert not closed[42:48, 20:40].any()
    assert closed[image].all()
    assert close_gaps(image, 0) is image


@pytest.mark.parametrize("shape", [(30, 30), (14, 14, 14)])
def test_the_largest_component_is_the_largest_flood(shape):
    rng = np.random.default_rng(9)
    mask = rng.random(shape) < {2: 0.5, 3: 0.25}[len(shape)]
    steps = [sign * step for step in np.eye(len(shape), dtype=int) for sign in (1, -1)]
    left, pieces = set(map(tuple, np.argwhere(mask))), []
    while left:
        piece, edge = set(), [min(left)]
        while edge:
            at = edge.pop()
            if at in left:
                left.remove(at)
                piece.add(at)
                edge += [tuple(np.add(at, step)) for step in steps]
        pieces.append(piece)
    assert len(pieces) > 5
    assert set(map(tuple, np.argwhere(largest_component(mask)))) == max(pieces, key=len)


def test_a_single_piece_or_none_is_its_own_largest_component():
    one, none = np.ones((3, 4), dtype=bool), np.zeros((3, 4), dtype=bool)
    assert largest_component(one) is one
    assert largest_component(none) is none
    both = np.array([True, True, False, True, True])
    assert np.array_equal(largest_component(both), [True, True, False, False, False])


def test_the_foremost_of_each_cell_is_found():
    local = np.random.default_rng(10).uniform(-20, 20, (400, 3))
    cell, foremost = foremost_in_cells(local, 5.0)
    names = [(int(np.floor(x / 5.0)), int(np.floor(y / 5.0))) for x, y, _ in local]
    numbers = {name: k for k, name in enumerate(sorted(set(names)))}
    assert len(foremost) == len(numbers) > 50
    assert np.array_equal(cell, [numbers[name] for name in names])
    expected = [max(z for name, (_, _, z) in zip(names, local, strict=True) if name == one) for one in sorted(numbers)]
    assert np.array_equal(foremost, expected)


def test_no_points_or_no_cell_have_no_foremost():
    for points, cell_mm in ((np.zeros((0, 3)), 5.0), (np.zeros((2, 3)), 0.0)):
        with pytest.raises(StudyError, match="expected points and a cell above 0 mm"):
            foremost_in_cells(points, cell_mm)


def test_spacing_of_a_grid_is_its_pitch():
    grid = 2.5 * np.stack(np.meshgrid(range(8), range(8), indexing="ij"), axis=-1).reshape(-1, 2)
    assert sample_spacing_mm(grid) == pytest.approx(2.5)


def test_farthest_points_are_even_and_pose_free():
    rng = np.random.default_rng(6)
    points = np.concatenate([rng.uniform(0, 100, (1900, 3)) * [0.1, 1, 1], rng.uniform(0, 100, (100, 3))])
    chosen = farthest_points(points, 60)
    assert len(set(chosen)) == 60
    apart = np.linalg.norm(points[chosen][:, None] - points[chosen][None], axis=2) + 1e9 * np.eye(60)
    cover = nearest(points, points[chosen])[0].max()
    assert cover <= apart.min() + 1e-9  # the greedy cover: no point is farther than two chosen ones are apart
    motion = RigidTransform.random(rng)
    assert np.array_equal(farthest_points(motion.apply(points), 60), chosen)
    assert sorted(farthest_points(points[:5], 60)) == [0, 1, 2, 3, 4]
