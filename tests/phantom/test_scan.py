"""The CT of a subject looks like a CT and its labels like those of the open CTs."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, distance_transform_edt
from scipy.ndimage import label as components

from study.errors import StudyError
from study.phantom.clouds import reference_cloud
from study.phantom.scan import CARTILAGE_ID, NOISE_HU, STERNUM_ID, ct_volume
from study.phantom.subject import SUBJECTS, SyntheticSubject, draw_subject
from study.types import CARTILAGES, Part

SEED = 0


def subject(name: str) -> SyntheticSubject:
    return draw_subject(name, SEED)


@pytest.fixture(scope="module")
def ct():
    return ct_volume(subject("ct1"), 2.0, np.random.default_rng(0))


def test_the_ct_is_a_ct(ct):
    hu, labels = ct
    assert (hu.values.dtype, labels.values.dtype) == (np.int16, np.uint8)
    assert hu.shape == labels.shape
    assert np.allclose(hu.spacing_mm, 2.0)
    assert np.allclose(hu.affine, labels.affine)
    inside = {key: hu.values[binary_erosion(labels.values == key)] for key in (STERNUM_ID, CARTILAGE_ID)}
    assert all(len(values) > 500 for values in inside.values())
    assert 80 < np.median(inside[CARTILAGE_ID]) < 180
    ribs = hu.values[(labels.values >= 92) & (labels.values <= 115)]
    assert 250 < np.median(ribs) < 700
    values = hu.values[labels.values == 0]
    assert values.min() >= -1100
    for low, high in ((-1050, -950), (-900, -800), (-130, -70), (20, 80)):  # air, lung, fat, muscle
        assert ((values > low) & (values < high)).mean() > 0.02
    air = hu.values[hu.values < -930]
    assert np.std(air) == pytest.approx(NOISE_HU, rel=0.2)


@pytest.mark.parametrize("name", SUBJECTS)
def test_labels_are_those_of_the_open_ct(name):
    _, labels = ct_volume(subject(name), 3.0, np.random.default_rng(0))
    for key in (116, 117, *range(92, 98), *range(104, 110)):
        assert (labels.values == key).sum() > 20, key
    i = np.argwhere(labels.values == 104)[:, 0].mean()
    assert i > np.argwhere(labels.values == 92)[:, 0].mean()  # right ribs at larger i
    # Nothing of levels 2-5 may touch the border of the image.
    wanted = np.isin(labels.values, (116,))
    inner = np.zeros_like(wanted)
    inner[1:-1, 1:-1, 1:] = True
    assert not (wanted & ~inner).any()


def test_the_fifth_cartilage_hangs_on_the_arch(ct):
    """As in real label maps: 2-4 are pieces of their own, the 5th is one with the arch of 6-10."""
    _, labels = ct
    pieces, _ = components(labels.values == CARTILAGE_ID)
    lines = reference_cloud(subject("ct1"), 6000, np.random.default_rng(0))
    inside = distance_transform_edt(labels.values != CARTILAGE_ID, return_indices=True, return_distances=False)

    def piece(part: Part) -> int:
        index = np.round(labels.to_index(lines.only(part))).astype(int).T
        i, j, k = inside[:, index[0], index[1], index[2]]
        return int(np.bincount(pieces[i, j, k]).argmax())

    found = {part: piece(part) for part in CARTILAGES}
    assert len({found[part] for part in CARTILAGES if part.level < 5}) == 6
    for side in ("right", "left"):
        z = np.argwhere(pieces == found[Part.cartilage(side, 5)])[:, 2] * 2.0
        assert np.ptp(z) > 60  # a 5th cartilage alone spans 30-50 mm


def test_cloud_and_labels_show_the_same_surface(ct):
    _, labels = ct
    cloud = reference_cloud(subject("ct1"), 3000, np.random.default_rng(0))
    solid = labels.values > 0
    depth = distance_transform_edt(solid) + distance_transform_edt(~solid)
    i, j, k = np.round(labels.to_index(cloud.points)).astype(int).T
    assert (depth[i, j, k] * 2.0).max() < 4.5  # a voxel's diagonal is 3.5 mm
    assert (depth[i, j, k] * 2.0).mean() < 2.5


@pytest.mark.parametrize("spacing_mm", [0.0, 10.0, np.nan])
def test_a_spacing_that_shows_no_cartilage_is_refused(spacing_mm):
    with pytest.raises(StudyError, match="spacing"):
        ct_volume(subject("ct1"), spacing_mm, np.random.default_rng(0))


def test_volumes_repeat_with_their_rng(ct):
    hu, labels = ct_volume(subject("ct1"), 2.0, np.random.default_rng(0))
    assert np.array_equal(hu.values, ct[0].values)
    assert np.array_equal(labels.values, ct[1].values)
