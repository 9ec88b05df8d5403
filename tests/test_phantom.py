"""The phantom is an anatomy of published sizes whose truth is exact."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.ndimage import binary_erosion, distance_transform_edt
from scipy.ndimage import label as components
from scipy.spatial import KDTree

from study import phantom
from study.deform import residual_mm
from study.errors import StudyError
from study.params import PHANTOM_SEED
from study.types import CARTILAGES, Part

SEED = 0


def subject(name: str) -> phantom.Subject:
    return phantom.draw_subject(name, SEED)


@pytest.fixture(scope="module")
def clouds() -> dict[str, phantom.PointCloud]:
    return {name: phantom.reference_cloud(subject(name), 4000, np.random.default_rng(0)) for name in phantom.SUBJECTS}


@pytest.fixture(scope="module")
def ct():
    return phantom.ct_volume(subject("ct1"), 2.0, np.random.default_rng(0))


@pytest.mark.parametrize("name", phantom.SUBJECTS)
def test_phi_is_invertible_and_folds_nowhere(name):
    person = subject(name)
    points = np.random.default_rng(0).uniform(phantom.ROI_LOW, phantom.ROI_HIGH, (20_000, 3))
    assert np.abs(person.phi.inverse(person.phi.apply(points)) - points).max() < 1e-6
    assert person.phi.jacobian_determinant(points).min() > 0.05


def test_the_truth_map_goes_there_and_back(clouds):
    points = clouds["ct2"].points
    there = phantom.truth_map(subject("ct2"), subject("patient"), points)
    assert np.abs(there - points).mean() > 2.0
    assert np.abs(phantom.truth_map(subject("patient"), subject("ct2"), there) - points).max() < 1e-6
    via = phantom.truth_map(subject("ct2"), subject("ct4"), points)
    assert np.abs(phantom.truth_map(subject("ct4"), subject("patient"), via) - there).max() < 1e-6


def test_the_truth_map_takes_surface_to_surface_part_by_part(clouds):
    mapped = phantom.truth_map(subject("ct3"), subject("patient"), clouds["ct3"].points)
    dense = phantom.reference_cloud(subject("patient"), 40_000, np.random.default_rng(1))
    for part in (Part.STERNUM, *CARTILAGES):
        distance, _ = KDTree(dense.only(part)).query(mapped[clouds["ct3"].parts == part])
        assert distance.max() < 3.5  # 40,000 points on such a surface leave holes of up to that
        assert distance.mean() < 0.8


def test_the_truth_map_takes_waypoints_to_waypoints():
    one, other = phantom.waypoints(subject("ct1")), phantom.waypoints(subject("patient"))
    mapped = phantom.truth_map(subject("ct1"), subject("patient"), one.points)
    assert np.abs(mapped - other.points).max() < 1e-6
    assert one.labels == other.labels


def test_the_reported_subjects_differ_as_people_do():
    """5-10 mm after rigid alignment is what the coarse alignment leaves; the mean over the cohort must lie there."""
    people = {name: phantom.draw_subject(name, PHANTOM_SEED) for name in phantom.SUBJECTS}
    patient = people.pop("patient")
    surface, waypoints = [], []
    for person in people.values():
        points = phantom.reference_cloud(person, 2000, np.random.default_rng(0)).points
        places = phantom.waypoints(person).points
        surface.append(residual_mm(points, phantom.truth_map(person, patient, points)))
        waypoints.append(residual_mm(places, phantom.waypoints(patient).points))
    assert len(surface) == 5
    assert 5 < np.mean(surface) < 10
    assert 5 < np.mean(waypoints) < 10
    assert min(surface) > 2


def test_sizes_are_the_published_ones():
    drawn = [phantom.measures(phantom.draw_subject(name, seed)) for seed in range(6) for name in phantom.SUBJECTS]
    assert len(drawn) == 36
    for key, (mean, sd) in {
        "cartilage_right_4_mm": (55.8, 9.8),
        "cartilage_left_4_mm": (55.8, 9.8),
        "cartilage_right_5_mm": (70.0, 10.8),
        "cartilage_left_5_mm": (70.0, 10.8),
        "manubrium_mm": (48.95, 6.0),  # women and men alike often
        "body_mm": (94.5, 14.0),
        "sternal_angle_deg": (163.0, 5.0),
    }.items():
        values = np.array([sizes[key] for sizes in drawn])
        # Draws end at 1.3 SD; bending and breathing add a little.
        assert np.abs(values - mean).max() < 2.2 * sd, key
        assert np.abs(values.mean() - mean) < 0.5 * sd, key
        assert values.std() > 0.4 * sd, key
    widths = [sizes["sternum_width_mm"] for sizes in drawn]
    assert 18 < min(widths) < max(widths) < 32
    for side in ("right", "left"):  # each level is longer than the one above
        lengths = np.array([[sizes[f"cartilage_{side}_{level}_mm"] for level in (2, 3, 4, 5)] for sizes in drawn])
        assert (np.diff(lengths, axis=1) > 0).mean() > 0.95


def test_what_no_publication_gives_is_what_the_open_cohort_has():
    """The constants are those of results/anatomy.csv: means and population SDs over people, sides averaged."""
    table = pd.read_csv(Path(__file__).parents[1] / "results" / "anatomy.csv")

    def over_people(quantity: str, parts: str) -> pd.Series:
        chosen = table[(table["quantity"] == quantity) & table["part"].str.fullmatch(parts)]
        return chosen.groupby("subject")["value"].mean()

    for level, (mean, sd) in phantom.MEASURED_LENGTH_MM.items():
        found = over_people("length", f".*_{level}")
        assert len(found) == 4
        assert (found.mean(), found.std(ddof=0)) == pytest.approx((mean, sd), abs=0.06)
    for level, mean in phantom.MEASURED_WIDTH_MM.items():
        assert over_people("width", f".*_{level}").mean() == pytest.approx(mean, abs=0.06)
    ((width, width_sd), thickness) = phantom.MEASURED_STERNUM_MM
    for (mean, sd), found in (
        (phantom.MEASURED_THICKNESS_MM, over_people("thickness", ".*_[2-5]")),
        ((width, width_sd), over_people("width", "sternum")),
        (phantom.MEASURED_HU, over_people("density_mean", "cartilages")),
    ):
        assert (found.mean(), found.std(ddof=0)) == pytest.approx((mean, sd), abs=0.06)
    assert over_people("thickness", "sternum").mean() == pytest.approx(thickness, abs=0.06)
    curvature = over_people("wall_curvature", "cartilages")
    mean, sd = phantom.WALL_PER_M
    assert curvature.min() < mean - phantom.MAX_SD * sd
    assert curvature.mean() < mean
    assert mean + phantom.MAX_SD * sd < curvature.max()


def test_the_same_name_and_seed_draw_the_same_person():
    points = np.random.default_rng(0).uniform(-50, 50, (100, 3))
    first, again = (phantom.draw_subject("ct3", 7).phi.apply(points) for _ in range(2))
    assert np.array_equal(first, again)
    assert np.abs(first - phantom.draw_subject("ct3", 8).phi.apply(points)).max() > 1
    assert np.abs(first - phantom.draw_subject("ct4", 7).phi.apply(points)).max() > 1


def test_clouds_and_volumes_repeat_with_their_rng(ct):
    one, same = (phantom.anterior_cloud(subject("patient"), 500, 0.5, 4, np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(one.points, same.points)
    hu, labels = phantom.ct_volume(subject("ct1"), 2.0, np.random.default_rng(0))
    assert np.array_equal(hu.values, ct[0].values)
    assert np.array_equal(labels.values, ct[1].values)


@pytest.mark.parametrize("name", phantom.SUBJECTS)
def test_the_frame_is_ras(clouds, name):
    cloud = clouds[name]
    middle = {part: cloud.only(part).mean(axis=0) for part in (Part.STERNUM, *CARTILAGES)}
    for level in (2, 3, 4, 5):
        right, left = middle[Part.cartilage("right", level)], middle[Part.cartilage("left", level)]
        assert right[0] > middle[Part.STERNUM][0] > left[0]
        if level < 5:
            assert right[2] > middle[Part.cartilage("right", level + 1)][2]
            assert left[2] > middle[Part.cartilage("left", level + 1)][2]
    # Bulging to the front: the far end of a cartilage lies behind its root.
    falls = []
    for part in CARTILAGES:
        points = cloud.only(part)
        lateral = np.abs(points[:, 0] - middle[Part.STERNUM][0])
        near, far = np.quantile(lateral, [0.15, 0.85])
        falls.append(points[lateral < near, 1].mean() - points[lateral > far, 1].mean())
    assert np.mean(falls) > 2  # 5 ± 4 mm on the open cohort


@pytest.mark.parametrize("name", phantom.SUBJECTS)
def test_cartilages_are_separate(clouds, name):
    """Neighbours are apart by a real intercostal gap, wider towards the ribs."""
    for side in ("right", "left"):
        for level in (2, 3, 4):
            upper, lower = (clouds[name].only(Part.cartilage(side, n)) for n in (level, level + 1))
            assert KDTree(upper).query(lower)[0].min() > 3


def test_the_fifth_cartilage_bends_most(clouds):
    for cloud in clouds.values():
        for side in ("right", "left"):
            bends = []
            for level in (2, 3, 4, 5):
                points = cloud.only(Part.cartilage(side, level))[:, [0, 2]]
                fit = np.polyfit(points[:, 0], points[:, 1], 1)
                bends.append(abs(np.degrees(np.arctan(fit[0]))))
            assert np.argmax(bends) == 3


@pytest.mark.parametrize("name", phantom.SUBJECTS)
def test_there_are_20_waypoints_in_the_gaps(clouds, name):
    places = phantom.waypoints(subject(name))
    assert len(places) == len(set(places.labels)) == 20
    counts = {key: sum(label.startswith(key) for label in places.labels) for key in ("R2-3", "L3-4", "R4-5")}
    assert counts == {"R2-3": 3, "L3-4": 3, "R4-5": 4}
    for label, place in zip(places.labels, places.points, strict=True):
        side, upper = {"R": "right", "L": "left"}[label[0]], int(label[1])
        near = [KDTree(clouds[name].only(Part.cartilage(side, level))).query(place)[0] for level in (upper, upper + 1)]
        others = [
            KDTree(clouds[name].only(part)).query(place)[0]
            for part in CARTILAGES
            if part not in (Part.cartilage(side, upper), Part.cartilage(side, upper + 1))
        ]
        assert min(near) > 2
        assert max(near) < min(others)
        assert max(near) < 25
    medial = [
        np.abs(places.points[places.labels.index(f"L2-3.{k}"), 0] - clouds[name].only(Part.STERNUM)[:, 0].mean())
        for k in (1, 2, 3)
    ]
    assert medial == sorted(medial)


def test_the_reference_cloud_is_as_asked_and_uniform(clouds):
    cloud = clouds["ct1"]
    assert len(cloud) == 4000
    assert set(np.unique(cloud.parts)) == {int(part) for part in (Part.STERNUM, *CARTILAGES)}
    spacing = KDTree(cloud.points).query(cloud.points, k=8)[0][:, -1]
    assert np.quantile(spacing, 0.99) < 2.5 * np.median(spacing)


def test_the_anterior_cloud_is_the_front_sheet():
    person = subject("patient")
    front = phantom.anterior_cloud(person, 3000, 0.0, 0, np.random.default_rng(0))
    depth = person.phi.inverse(front.points)[:, 1]
    assert depth.min() > 0.5  # in front of the middle of the wall
    noisy = phantom.anterior_cloud(person, 3000, 0.5, 0, np.random.default_rng(0))
    assert np.std(noisy.points - front.points) == pytest.approx(0.5, rel=0.05)
    torn = phantom.anterior_cloud(person, 3000, 0.0, 8, np.random.default_rng(0))
    hole = KDTree(torn.points).query(front.points)[0]
    assert (hole > 1.5).mean() > (KDTree(front.points).query(torn.points)[0] > 1.5).mean() + 0.02
    assert len(torn) == 3000


def test_the_ct_is_a_ct(ct):
    hu, labels = ct
    assert (hu.values.dtype, labels.values.dtype) == (np.int16, np.uint8)
    assert hu.shape == labels.shape
    assert np.allclose(hu.spacing_mm, 2.0)
    assert np.allclose(hu.affine, labels.affine)
    inside = {
        key: hu.values[binary_erosion(labels.values == key)] for key in (phantom.STERNUM_ID, phantom.CARTILAGE_ID)
    }
    assert all(len(values) > 500 for values in inside.values())
    assert 80 < np.median(inside[phantom.CARTILAGE_ID]) < 180
    ribs = hu.values[(labels.values >= 92) & (labels.values <= 115)]
    assert 250 < np.median(ribs) < 700
    values = hu.values[labels.values == 0]
    assert values.min() >= -1100
    for low, high in ((-1050, -950), (-900, -800), (-130, -70), (20, 80)):  # air, lung, fat, muscle
        assert ((values > low) & (values < high)).mean() > 0.02
    air = hu.values[hu.values < -930]
    assert np.std(air) == pytest.approx(phantom.NOISE_HU, rel=0.2)


@pytest.mark.parametrize("name", phantom.SUBJECTS)
def test_labels_are_those_of_the_open_ct(name):
    _, labels = phantom.ct_volume(subject(name), 3.0, np.random.default_rng(0))
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
    pieces, _ = components(labels.values == phantom.CARTILAGE_ID)
    lines = phantom.reference_cloud(subject("ct1"), 6000, np.random.default_rng(0))
    inside = distance_transform_edt(labels.values != phantom.CARTILAGE_ID, return_indices=True, return_distances=False)

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
    cloud = phantom.reference_cloud(subject("ct1"), 3000, np.random.default_rng(0))
    solid = labels.values > 0
    depth = distance_transform_edt(solid) + distance_transform_edt(~solid)
    i, j, k = np.round(labels.to_index(cloud.points)).astype(int).T
    assert (depth[i, j, k] * 2.0).max() < 4.5  # a voxel's diagonal is 3.5 mm
    assert (depth[i, j, k] * 2.0).mean() < 2.5


@pytest.mark.parametrize("name", ["ct6", "", "Patient"])
def test_an_unknown_subject_is_refused(name):
    with pytest.raises(StudyError, match=r"ct1, ct2.*patient"):
        phantom.draw_subject(name, 0)


@pytest.mark.parametrize("spacing_mm", [0.0, 10.0, np.nan])
def test_a_spacing_that_shows_no_cartilage_is_refused(spacing_mm):
    with pytest.raises(StudyError, match="spacing"):
        phantom.ct_volume(subject("ct1"), spacing_mm, np.random.default_rng(0))
