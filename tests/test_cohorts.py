from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from phantom_files import (
    SMALL,
    cached_ct_volume,
    nifti,
    own_manifest,
    ribseg_labels,
    scan,
)
from scipy.spatial import KDTree

from study import cohorts, phantom
from study.cohorts import (
    PLANTED_SIZES_MM,
    Anatomy,
    files_of_subject,
    load_anatomy,
    make_patient,
    pairs,
    plant,
    read_anatomy,
    truth_map,
)
from study.data.manifest import Manifest, load_manifest
from study.errors import StudyError
from study.params import PHANTOM_SEED, PROFILES
from study.types import PointCloud


@pytest.fixture(autouse=True)
def drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(phantom, "ct_volume", cached_ct_volume)


@pytest.fixture(scope="module")
def one() -> Anatomy:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(phantom, "ct_volume", cached_ct_volume)
        return load_anatomy("phantom", "ct1", SMALL)


def manifest_of(folder: Path, subjects: dict, cohort: str = "mine", kind: str = "generated") -> Manifest:
    raw = {"cohorts": {cohort: {"kind": kind, "subjects": subjects}}}
    (folder / "own.yaml").write_text(yaml.safe_dump(raw))
    return load_manifest(folder / "own.yaml")


# --- who is registered to whom ---------------------------------------------------------------------------------------


def test_the_phantom_has_five_cts_and_one_patient() -> None:
    assert pairs("phantom", PROFILES["full"]) == [(f"ct{k}", "patient") for k in range(1, 6)]
    assert pairs("phantom", PROFILES["quick"]) == [("ct1", "patient"), ("ct2", "patient")]


def test_each_real_subject_is_the_patient_of_all_others() -> None:
    found = pairs("open", PROFILES["full"])
    names = list(load_manifest().cohort("open").subjects)
    assert len(found) == len(set(found)) == len(names) * (len(names) - 1)
    assert {target for _, target in found} == set(names)
    assert all(source != target for source, target in found)


def test_planted_patients_share_one_source() -> None:
    assert pairs("planted", PROFILES["full"]) == [("lidc-0001", name) for name in PLANTED_SIZES_MM]


def test_roles_and_limits(tmp_path: Path) -> None:
    roles = {"a": {"role": "ct"}, "b": {}, "c": {"role": "patient"}, "d": {"role": "ct"}}
    manifest = manifest_of(tmp_path, roles)
    everyone = replace(SMALL, max_sources=0, max_targets=0)
    assert pairs("mine", everyone, manifest) == [("a", "b"), ("d", "b"), ("a", "c"), ("b", "c"), ("d", "c")]
    assert pairs("mine", replace(everyone, max_sources=1), manifest) == [("a", "b"), ("a", "c")]
    assert pairs("mine", replace(everyone, max_targets=1), manifest) == [("a", "b"), ("d", "b")]


@pytest.mark.parametrize(
    "subjects", [{"a": {}}, {"a": {"role": "ct"}, "b": {"role": "ct"}}, {"a": {"role": "patient"}}]
)
def test_nobody_to_pair_is_an_error(tmp_path: Path, subjects: dict) -> None:
    with pytest.raises(StudyError, match="two subjects or more"):
        pairs("mine", SMALL, manifest_of(tmp_path, subjects))


def test_an_unknown_dataset_is_refused_with_the_known_ones() -> None:
    with pytest.raises(StudyError, match=r"open, phantom, .*got 'opne'"):
        pairs("opne", SMALL)


@pytest.mark.parametrize("name", ["planted", "phantom"])
def test_ones_own_scans_cannot_take_a_name_whose_truth_is_known(tmp_path: Path, name: str) -> None:
    manifest = load_manifest(own_manifest(tmp_path, cohort=name))
    with pytest.raises(StudyError, match=f"another name for a cohort of one's own, got '{name}'"):
        pairs(name, SMALL, manifest)


# --- anatomies -------------------------------------------------------------------------------------------------------


def test_the_phantom_goes_the_road_of_a_ct_and_has_exact_waypoints(one: Anatomy) -> None:
    drawn = phantom.draw_subject("ct1", PHANTOM_SEED)
    assert np.array_equal(one.waypoints.points, phantom.waypoints(drawn).points)
    assert one.image is not None
    assert one.mask is not None
    assert len(one.cloud) == SMALL.ct_points
    surface = phantom.reference_cloud(drawn, 20000, np.random.default_rng(0))
    off_mm = KDTree(surface.points).query(one.cloud.points)[0]
    assert off_mm.mean() < 1.2  # half a voxel of 2.5 mm


def test_the_seed_draws_the_samples_and_nothing_else(one: Anatomy) -> None:
    again = load_anatomy("phantom", "ct1", SMALL)
    other = load_anatomy("phantom", "ct1", SMALL, seed=1)
    assert np.array_equal(again.cloud.points, one.cloud.points)
    assert not np.array_equal(other.cloud.points, one.cloud.points)
    assert np.array_equal(other.mesh.vertices, one.mesh.vertices)


@pytest.mark.parametrize("dataset", ["phantom", "open", "planted"])
def test_an_unknown_subject_is_refused_with_the_known_ones(dataset: str) -> None:
    with pytest.raises(StudyError, match=rf"{dataset}: expected a subject among .*, got 'ct9'"):
        load_anatomy(dataset, "ct9", SMALL)


def test_a_phantom_truth_takes_one_surface_to_the_other(one: Anatomy) -> None:
    truth = truth_map("phantom", one, "patient")
    assert truth is not None
    other = phantom.draw_subject("patient", PHANTOM_SEED)
    surface = phantom.reference_cloud(other, 20000, np.random.default_rng(0)).points
    assert KDTree(surface).query(truth(one.cloud.points))[0].mean() < 1.3
    assert np.allclose(truth(one.waypoints.points), phantom.waypoints(other).points, atol=1e-6)


def test_between_two_people_no_truth_is_known(one: Anatomy) -> None:
    assert truth_map("open", one, "lung1") is None


def test_a_planted_patient_is_its_source_moved_by_the_known_map(one: Anatomy, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = truth_map("planted", one, "planted3")
    assert truth is not None
    planted = plant(one, "planted3")
    assert np.array_equal(planted.mesh.vertices, truth(one.mesh.vertices))
    assert np.array_equal(planted.cloud.points, truth(one.cloud.points))
    assert np.array_equal(planted.waypoints.points, truth(one.waypoints.points))
    assert planted.image is None
    moved = np.linalg.norm(planted.mesh.vertices - one.mesh.vertices, axis=1)
    assert moved.mean() > 2.0
    # Alone, the same patient comes from its source by name.
    read = []
    whole = cohorts.load_anatomy

    def load(dataset: str, name: str, *rest: object) -> Anatomy:
        read.append((dataset, name))
        return replace(one, name=name) if name == "lidc-0001" else whole(dataset, name, *rest)

    monkeypatch.setattr(cohorts, "load_anatomy", load)
    alone = cohorts.load_anatomy("planted", "planted3", SMALL)
    assert read == [("planted", "planted3"), ("planted", "lidc-0001")]
    assert np.array_equal(alone.cloud.points, planted.cloud.points)


# --- files of one's own ----------------------------------------------------------------------------------------------


def test_relative_files_belong_to_the_manifest_not_to_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, one: Anatomy
) -> None:
    path = own_manifest(tmp_path / "study_of_mine")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    manifest = load_manifest(Path("..") / "study_of_mine" / path.name)
    found = load_anatomy("mine", "ct1", SMALL, manifest=manifest)
    assert np.allclose(found.mesh.vertices, one.mesh.vertices, atol=1e-3)  # a NIfTI header is single precision
    files = files_of_subject("mine", "ct1", manifest)
    assert sorted(files) == ["ct1_ct", "ct1_labels"]
    assert all(file.is_file() and file.is_relative_to(path.parent) for file in files.values())


def test_a_ct_of_ones_own_needs_labels_or_landmarks_and_labels_that_hold_the_ribs(tmp_path: Path) -> None:
    image, labels = scan("ct1")
    ct = nifti(image, tmp_path / "ct.nii.gz")
    rng = np.random.default_rng(0)
    with pytest.raises(StudyError, match="got neither"):
        read_anatomy(ct, 2000, rng)
    with pytest.raises(StudyError, match="got both"):
        read_anatomy(ct, 2000, rng, labels=ct, landmarks=ct)
    # A rib label map goes to the growth, which asks for ribs 2-5; here the labels hold none of the left side.
    one_side = ribseg_labels(labels)
    one_side = replace(one_side, values=np.where(one_side.values > 12, 0, one_side.values))
    ribs = nifti(one_side, tmp_path / "ribs.nii.gz")
    ids = load_manifest().label_ids("ribseg_v2")
    with pytest.raises(StudyError, match="none of rib_left_2, rib_left_3, rib_left_4, rib_left_5"):
        read_anatomy(ct, 2000, rng, labels=ribs, ids=ids)
    # The same without a word on how to read them.
    with pytest.raises(StudyError, match="label ids of"):
        read_anatomy(ct, 2000, rng, labels=ribs)


# --- the patient -----------------------------------------------------------------------------------------------------


def test_a_patient_is_seen_from_the_front_in_a_frame_of_its_own(one: Anatomy) -> None:
    patient = make_patient(one, SMALL)
    back = patient.T_us_ras.inverse.apply(patient.cloud.points)
    assert KDTree(one.mesh.vertices).query(back)[0].mean() < 3.0
    assert patient.cloud.front is not None
    front = patient.T_us_ras.inverse.rotation @ patient.cloud.front
    assert front[1] > 0.9  # RAS+: anterior
    assert patient.cloud.parts is None
    assert patient.labelled.parts is not None
    assert np.array_equal(patient.labelled.points, patient.cloud.points)
    assert len(np.unique(patient.labelled.parts)) == 9
    assert isinstance(patient.cloud, PointCloud)
    other = make_patient(one, SMALL, seed=1)
    assert not np.allclose(other.T_us_ras.matrix, patient.T_us_ras.matrix)
    again = make_patient(one, SMALL)
    assert np.array_equal(again.cloud.points, patient.cloud.points)
