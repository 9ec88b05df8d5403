"""The surface is found in B-mode-like frames whose truth is known, and is not invented where there is none."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from small_sweeps import flat_sweep

from study.errors import StudyError
from study.files.plus import read_plus
from study.ultrasound import bone_surface
from study.ultrasound.bmode import BONE, CARTILAGE, Echo, simulate_bmode
from study.ultrasound.bone_surface import BoneFinder, BoneSurface, find_bone_surface, mask_sweep

REAL = Path(__file__).parents[3] / "shared" / "data" / "plus" / "BoneUltrasound_L14.igs.mha"
SPACING = (0.2, 0.2)


def arcs(n=6):
    """Masks (n, 175, 255) of arcs at several depths, the later ones over half the width only."""
    x = (np.arange(255) - 127) * SPACING[0]
    masks = np.zeros((n, 175, 255), dtype=bool)
    for i in range(n):
        depth = 11 + 1.5 * i + (x / (22 + i)) ** 2 * 6
        columns = np.flatnonzero((depth < 33) & (x > (-60 if i < 3 else -8)))
        top = np.ceil(depth[columns] / SPACING[1]).astype(int)
        for below in range(5):
            masks[i, top + below, columns] = True
    return masks


def compared(echo, seed=0):
    """Errors (mm) where both have a contour, the share found, the share that is false, and the result."""
    masks = arcs()
    found = find_bone_surface(simulate_bmode(masks, SPACING, np.random.default_rng(seed), echo=echo), SPACING)
    seen, rows = masks.any(axis=1), found.rows
    error = (rows - (masks.argmax(axis=1) - 0.5)) * SPACING[1]
    shown = np.isfinite(rows)
    return error[shown & seen], (shown & seen).sum() / seen.sum(), (shown & ~seen).sum() / shown.sum(), found


@pytest.mark.parametrize(("echo", "share"), [(BONE, 0.85), (CARTILAGE, 0.7)])
def test_a_known_surface_is_found(echo, share):
    error, found, false, surface = compared(echo)
    assert abs(error.mean()) < 0.1, "a bias of half a pixel at most: it would move the cloud"
    assert np.abs(error).mean() < 0.2
    assert (np.abs(error) > 1).mean() < 0.01
    assert found > share
    assert false < 0.02
    assert not surface.poor.any()


def test_quality_falls_with_the_echo_and_poor_frames_are_dropped():
    strong, weak = (compared(echo)[3] for echo in (BONE, CARTILAGE))
    assert strong.quality.min() > weak.quality.max()
    faint = compared(replace(CARTILAGE, surface_db=9.0))[3]
    assert faint.poor.any()
    assert np.isnan(faint.rows[faint.poor]).all()
    assert not faint.masks(175, 5)[faint.poor].any()
    assert (faint.quality[faint.poor] < BoneFinder.min_quality).all()


def test_nothing_is_found_where_there_is_none():
    empty = np.zeros((6, 175, 255), dtype=bool)
    soft = simulate_bmode(empty, SPACING, np.random.default_rng(5))
    assert np.isfinite(find_bone_surface(soft, SPACING).rows).mean() < 0.01
    black = find_bone_surface(np.zeros((1, 175, 255), np.uint8), SPACING)
    assert np.isnan(black.rows).all()
    assert np.isnan(black.quality).all()
    assert not black.poor.any()


def test_the_gain_does_not_matter():
    images = simulate_bmode(arcs(2), SPACING, np.random.default_rng(0))
    loud, quiet = (find_bone_surface(one, SPACING).rows for one in (images, images // 2))
    both = np.isfinite(loud) & np.isfinite(quiet)
    assert both.mean() > 0.95 * np.isfinite(loud).mean()
    assert np.abs(loud - quiet)[both].max() < 1


def test_finer_pixels_give_the_same_place():
    """As a scanner shows them: thinned for the search, in rows of the image for the answer."""
    images = simulate_bmode(arcs(2), SPACING, np.random.default_rng(0))
    coarse = find_bone_surface(images, SPACING).rows
    fine = find_bone_surface(images.repeat(2, axis=1).repeat(3, axis=2), (SPACING[0] / 3, SPACING[1] / 2)).rows
    at = (fine[:, 1::3] - 0.5) / 2  # centres of the pixels that were doubled
    both = np.isfinite(coarse) & np.isfinite(at)
    assert both.mean() > 0.9 * np.isfinite(coarse).mean()
    assert np.abs(coarse - at)[both].mean() < 0.3


def score(path, likelihood, finder, spacing):
    """What a path is worth, by its definition."""
    sx, sy = spacing
    reach = int(np.ceil(1.7 * sx / sy))
    total, last = 0.0, -1
    for column, row in enumerate(path):
        if row >= 0:
            total += (likelihood[row, column] - finder.least) * sx
            if last >= 0 and abs(row - last) <= reach:
                total -= min(finder.slope * ((row - last) * sy / sx) ** 2 * sx, 2 * finder.turn_on)
            else:
                total -= finder.turn_on * (2 if last >= 0 else 1)
        elif last >= 0:
            total -= finder.turn_on
        last = row
    return total - (finder.turn_on if last >= 0 else 0)


@pytest.mark.parametrize("seed", range(8))
def test_dynamic_programming_finds_the_best_of_all_paths(seed):
    rng = np.random.default_rng(seed)
    likelihood = rng.random((4, 6)) * (rng.random((4, 6)) < 0.6)
    spacing, finder = (1.0, 1.5), BoneFinder(least=0.3, turn_on=0.2, slope=0.15)
    best = max(score(path, likelihood, finder, spacing) for path in product(range(-1, 4), repeat=6))
    found = bone_surface._strongest_path(likelihood, finder, spacing)
    assert score(found, likelihood, finder, spacing) == pytest.approx(best, abs=1e-12)


def test_masks_begin_at_the_surface():
    rows = np.array([[10.0, 10.5, 10.9, np.nan]])
    masks = BoneSurface(rows, np.ones(1), np.zeros(1, bool)).masks(20, 3)
    edge = masks.argmax(axis=1) - 0.5
    assert np.abs(edge[0, :3] - rows[0, :3]).max() <= 0.5
    assert masks.sum(axis=1).tolist() == [[3, 3, 3, 0]]


def test_a_sweep_gets_masks():
    plain = flat_sweep()
    images = simulate_bmode(plain.masks, plain.pixel_spacing_mm, np.random.default_rng(0), echo=Echo(20, 14, -24))
    counted: list[int] = []
    masked, surface = mask_sweep(
        replace(plain, masks=None, images=images), progress=lambda frames: (counted.append(i) or i for i in frames)
    )
    assert counted == list(range(60))
    assert masked.masks.shape == plain.masks.shape
    assert np.abs(np.nanmean(surface.rows) - 39.5) < 0.5
    with pytest.raises(StudyError, match="got masks only"):
        mask_sweep(plain)
    with pytest.raises(StudyError, match="pixel_spacing_mm"):
        mask_sweep(replace(plain, masks=None, images=images, pixel_spacing_mm=None))
    with pytest.raises(StudyError, match="check the pixel spacing"):
        find_bone_surface(images, (0.001, 0.001))
    with pytest.raises(StudyError, match="frames, rows, columns"):
        find_bone_surface(images[0], SPACING)


def test_the_bone_of_the_shared_recording_is_followed():
    """Looked at once: the top of the bone lies at rows 268 to 275 in all 21 frames, the fascia above at 50 to 90."""
    if not REAL.exists():
        pytest.skip(f"no PLUS example at {REAL}: it is not part of the repository (PlusLibData, BSD-3)")
    surface = find_bone_surface(read_plus(REAL).images[::10], (0.08, 0.08))
    assert not surface.poor.any()
    assert (np.isfinite(surface.rows).mean(axis=1) > 0.3).all()
    assert (np.nanmin(surface.rows, axis=1) > 255).all()
    assert (np.nanmin(surface.rows, axis=1) < 285).all()
