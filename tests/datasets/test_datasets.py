from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

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

from study import phantom
from study.data.manifest import load_manifest
from study.data.schema import Manifest
from study.datasets import (
    Anatomy,
    CohortDataset,
    Dataset,
    PlantedDataset,
    PlantedEveryDataset,
    PopulationDataset,
    find_dataset,
    make_patient,
    read_anatomy,
    reported,
    sweep_over,
)
from study.datasets import people as people_module
from study.datasets.planted import SIZES_MM, plant
from study.errors import StudyError
from study.naming import person_of
from study.params import PHANTOM_SEED, POPULATION_SEED, PROFILES, StudyParams
from study.seeds import named_rng
from study.types import PointCloud
from study.ultrasound.cloud import contour_points
from study.ultrasound.constant_shift import constant_shift_mm
from study.ultrasound.sweep_errors import SweepErrors


def pairs(name: str, params: StudyParams, manifest: Manifest | None = None) -> list[tuple[str, str]]:
    return find_dataset(name, params, manifest=manifest).pairs()


def load_anatomy(name: str, who: str, params: StudyParams, seed: int = 0, manifest: Manifest | None = None) -> Anatomy:
    return find_dataset(name, params, seed, manifest).anatomy(who)


@pytest.fixture(autouse=True)
def drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(phantom, "ct_volume", cached_ct_volume)


@pytest.fixture(scope="module")
def one() -> Anatomy:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(phantom, "ct_volume", cached_ct_volume)
        return load_anatomy("phantom", "ct1", SMALL)


def manifest_of(folder: Path, subjects: dict, cohort: str = "phantom", kind: str = "generated") -> Manifest:
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
    assert pairs("planted", PROFILES["full"]) == [("lidc-0001", name) for name in SIZES_MM]


def test_roles_and_limits(tmp_path: Path) -> None:
    roles = {"a": {"role": "ct"}, "b": {}, "c": {"role": "patient"}, "d": {"role": "ct"}}
    manifest = manifest_of(tmp_path, roles)
    everyone = replace(SMALL, max_sources=0, max_targets=0)
    assert pairs("phantom", everyone, manifest) == [("a", "b"), ("d", "b"), ("a", "c"), ("b", "c"), ("d", "c")]
    assert pairs("phantom", replace(everyone, max_sources=1), manifest) == [("a", "b"), ("a", "c")]
    assert pairs("phantom", replace(everyone, max_targets=1), manifest) == [("a", "b"), ("d", "b")]


@pytest.mark.parametrize(
    "subjects", [{"a": {}}, {"a": {"role": "ct"}, "b": {"role": "ct"}}, {"a": {"role": "patient"}}]
)
def test_nobody_to_pair_is_an_error(tmp_path: Path, subjects: dict) -> None:
    with pytest.raises(StudyError, match="two subjects or more"):
        pairs("phantom", SMALL, manifest_of(tmp_path, subjects))


def test_an_unknown_dataset_is_refused_with_the_known_ones() -> None:
    with pytest.raises(StudyError, match=r"phantom, planted, open, .*got 'opne'"):
        pairs("opne", SMALL)


@pytest.mark.parametrize("name", ["planted", "phantom"])
def test_ones_own_scans_never_have_a_known_truth_whatever_their_name(tmp_path: Path, name: str) -> None:
    mine = find_dataset(name, SMALL, manifest=load_manifest(own_manifest(tmp_path, cohort=name)))
    assert isinstance(mine, CohortDataset)
    assert not mine.has_truth
    assert mine.truth("ct1", "ct2") is None


def test_a_generated_cohort_that_nothing_makes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"among phantom, planted, population, planted_every, got 'robots'"):
        find_dataset("robots", manifest=manifest_of(tmp_path, {"a": {}, "b": {}}, cohort="robots"))


def test_a_manifest_file_stands_for_its_one_cohort(tmp_path: Path) -> None:
    path = own_manifest(tmp_path)
    assert find_dataset(str(path), SMALL).name == "mine"
    raw = yaml.safe_load(path.read_text())
    raw["cohorts"]["more"] = raw["cohorts"]["mine"]
    path.write_text(yaml.safe_dump(raw))
    with pytest.raises(StudyError, match="expected one cohort, got mine, more"):
        find_dataset(str(path), SMALL)


def test_the_manifest_says_what_is_reported() -> None:
    assert reported() == ["phantom", "planted", "open"]
    assert [find_dataset(name).has_truth for name in reported()] == [True, True, False]


def test_names_and_origins() -> None:
    planted = find_dataset("planted", replace(SMALL, max_targets=2))
    assert planted.names() == ["lidc-0001", "planted1", "planted2"]
    assert [planted.origin(name) for name in planted.names()] == [None, "lidc-0001", "lidc-0001"]
    assert planted.file_cohort == "open"
    assert find_dataset("open").file_cohort == "open"
    with pytest.raises(StudyError, match="got 'ct9'"):
        planted.origin("ct9")


# --- more people, more sweeps ----------------------------------------------------------------------------------------


def test_the_population_is_a_design_in_which_everybody_is_both_equally_often() -> None:
    people = find_dataset("population")
    found = people.pairs()
    assert len(found) == len(set(found)) == 72
    who = Counter((source, person_of(target)) for source, target in found)
    assert set(who.values()) == {2}  # sweeps
    assert all(source != target and (target, source) not in who for source, target in who)
    assert set(Counter(source for source, _ in who).values()) == {3}
    assert set(Counter(target for _, target in who).values()) == {3}
    assert set(people.names()) == set(people.with_ct()) == set(phantom.POPULATION)
    assert people.has_truth
    quick = pairs("population", PROFILES["quick"])
    assert len(quick) == 4
    assert {person_of(target) for _, target in quick} == {"p01"}


def test_population_people_are_drawn_from_the_whole_spread() -> None:
    people = find_dataset("population", SMALL)
    assert isinstance(people, PopulationDataset)
    points = np.zeros((1, 3))
    whole = phantom.draw_subject("p03", POPULATION_SEED, np.inf)
    assert np.array_equal(people.draw("p03").phi.apply(points), whole.phi.apply(points))
    truth = people.truth("p03", "p04")
    other = phantom.draw_subject("p04", POPULATION_SEED, np.inf)
    assert np.allclose(truth(phantom.waypoints(whole).points), phantom.waypoints(other).points, atol=1e-6)
    with pytest.raises(StudyError, match="got 'ct1'"):
        people.draw("ct1")


def test_a_cohort_says_how_many_atlases_and_sweeps(tmp_path: Path) -> None:
    raw = {"kind": "generated", "sweeps": 2, "atlases": 2, "subjects": {name: {} for name in "abcde"}}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump({"cohorts": {"phantom": raw}}))
    people = find_dataset("phantom", manifest=load_manifest(tmp_path / "own.yaml"))
    assert [pair for pair in people.pairs() if person_of(pair[1]) == "d"] == [
        ("e", "d"), ("b", "d"), ("e", "d#1"), ("b", "d#1"),
    ]  # fmt: skip
    assert set(Counter(source for source, _ in people.pairs()).values()) == {4}
    with pytest.raises(StudyError, match=r"one of 2 sweep\(s\), numbered from 0, got 'd#2'"):
        people.patient("d#2")
    with pytest.raises(StudyError, match="got 'f'"):
        people.patient("f#1")
    for field in ("sweeps", "atlases"):
        (tmp_path / "bad.yaml").write_text(yaml.safe_dump({"cohorts": {"phantom": {**raw, field: -1}}}))
        with pytest.raises(StudyError, match=field):
            load_manifest(tmp_path / "bad.yaml")


def test_open_sweeps_are_the_people_of_open_and_their_first_sweep_is_its(
    one: Anatomy, monkeypatch: pytest.MonkeyPatch
) -> None:
    swept, single = find_dataset("open_sweeps"), find_dataset("open")
    assert len(swept.pairs()) == 3 * len(single.pairs())
    assert set(single.pairs()) < set(swept.pairs())
    assert swept.names() == single.names()
    assert swept.file_cohort == single.file_cohort == "open"
    assert swept.manifest.cohort("open_sweeps").subjects == swept.manifest.cohort("open").subjects
    person = replace(one, name="lung1")
    small = find_dataset("open_sweeps", SMALL)
    first, second, again = (small.patient(name, person) for name in ("lung1", "lung1#1", "lung1#1"))
    alone = make_patient(person, SMALL)
    assert (first.name, second.name) == ("lung1", "lung1#1")
    assert np.array_equal(first.cloud.points, alone.cloud.points)
    assert np.array_equal(first.T_us_ras.matrix, alone.T_us_ras.matrix)
    assert np.array_equal(second.cloud.points, again.cloud.points)
    assert not np.allclose(first.T_us_ras.matrix, second.T_us_ras.matrix)
    hands = []
    whole = people_module.sweep_over

    def sweep(anatomy: Anatomy, frame: Any, rng: np.random.Generator, errors: Any) -> Any:
        hands.append(rng.bit_generator.state["state"]["state"])
        return whole(anatomy, frame, rng, errors)

    monkeypatch.setattr(people_module, "sweep_over", sweep)
    for name in ("lung1", "lung1#1", "lung1#2", "lung1"):
        small.patient(name, person)
    assert len(set(hands)) == 3  # another hand, not only another frame
    assert hands[0] == hands[3]
    assert small.pair(replace(one, name="lung2"), second).name == "lung2/lung1#1"


def test_the_clouds_of_one_person_are_the_same_in_both_cohorts(tmp_path: Path) -> None:
    path = own_manifest(tmp_path, names=("ct1",))
    raw = yaml.safe_load(path.read_text())
    raw["cohorts"]["more"] = {**raw["cohorts"]["mine"], "people_of": "mine", "sweeps": 2}
    raw["cohorts"]["other"] = raw["cohorts"]["mine"]
    path.write_text(yaml.safe_dump(raw))
    mine, more, other = (
        load_anatomy(cohort, "ct1", SMALL, manifest=load_manifest(path)).cloud.points
        for cohort in ("mine", "more", "other")
    )
    assert np.array_equal(mine, more)
    assert not np.array_equal(mine, other)


def test_every_real_ct_has_planted_patients_of_its_own(one: Anatomy) -> None:
    people = find_dataset("planted_every")
    assert isinstance(people, PlantedEveryDataset)
    names = list(load_manifest().cohort("open").subjects)
    assert people.pairs() == [(name, f"{name}+{kind}") for name in names for kind in SIZES_MM]
    assert people.origin("lung1+planted2") == "lung1"
    assert people.origin("lung1") is None
    assert people.with_ct() == names
    for unknown in ("lung1+planted9", "lung9", "planted1", "lung9+planted1", "lung1+"):
        with pytest.raises(StudyError, match="got"):
            people.origin(unknown)
    person = replace(one, name="lung1")
    first = people.anatomy("lung1+planted2", person)
    other = people.anatomy("lung2+planted2", person)
    truth = people.truth(person, first)
    assert first.name == "lung1+planted2"
    assert np.array_equal(first.cloud.points, truth(person.cloud.points))
    assert not np.allclose(first.cloud.points, other.cloud.points)  # each has draws of its own
    assert np.array_equal(plant(one, "planted2").cloud.points, plant(one, "planted2").cloud.points)


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
    truth = find_dataset("phantom", SMALL).truth(one, "patient")
    assert truth is not None
    other = phantom.draw_subject("patient", PHANTOM_SEED)
    surface = phantom.reference_cloud(other, 20000, np.random.default_rng(0)).points
    assert KDTree(surface).query(truth(one.cloud.points))[0].mean() < 1.3
    assert np.allclose(truth(one.waypoints.points), phantom.waypoints(other).points, atol=1e-6)


def test_between_two_people_no_truth_is_known(one: Anatomy) -> None:
    assert find_dataset("open", SMALL).truth(one, "lung1") is None


def test_a_planted_patient_is_its_source_moved_by_the_known_map(one: Anatomy, monkeypatch: pytest.MonkeyPatch) -> None:
    planted = plant(one, "planted3")
    people = find_dataset("planted", SMALL)
    truth = people.truth(one, planted)
    assert truth is not None
    assert np.array_equal(planted.mesh.vertices, truth(one.mesh.vertices))
    assert np.array_equal(planted.cloud.points, truth(one.cloud.points))
    assert np.array_equal(planted.waypoints.points, truth(one.waypoints.points))
    assert planted.image is None
    moved = np.linalg.norm(planted.mesh.vertices - one.mesh.vertices, axis=1)
    assert moved.mean() > 2.0
    with pytest.raises(StudyError, match="expected a planted patient"):
        people.truth(planted, one)
    # Alone, the same patient comes from its source by name.
    read = []
    whole = PlantedDataset.anatomy

    def load(self: Dataset, name: str, origin: Anatomy | None = None) -> Anatomy:
        read.append((self.name, name))
        return replace(one, name=name) if name == "lidc-0001" else whole(self, name, origin)

    monkeypatch.setattr(PlantedDataset, "anatomy", load)
    alone = people.anatomy("planted3")
    assert read == [("planted", "planted3"), ("planted", "lidc-0001")]
    assert np.array_equal(alone.cloud.points, planted.cloud.points)


def test_a_pair_knows_the_truth_where_there_is_one(one: Anatomy) -> None:
    people = find_dataset("phantom", SMALL)
    patient = people.patient("patient")
    pair = people.pair(one, patient)
    assert (pair.name, pair.has_truth) == ("ct1/patient", True)
    truth = people.truth(one, "patient")
    assert truth is not None
    assert pair.true_points is not None
    assert np.array_equal(pair.true_points, patient.T_us_ras.apply(truth(one.cloud.points)))
    assert np.array_equal(pair.waypoints_ct, one.waypoints.points)
    alike = find_dataset("open", SMALL).pair(one, patient)
    assert not alike.has_truth
    assert np.array_equal(alike.waypoints_us, pair.waypoints_us)


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
    files = find_dataset("mine", SMALL, manifest=manifest).files("ct1")
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


def test_a_patients_points_know_when_they_were_seen_up_to_the_method(one: Anatomy) -> None:
    patient = make_patient(one, SMALL)
    sweep = sweep_over(one, patient.T_us_ras, named_rng(0, f"{one.name}/sweep"))
    contour, frames, *_ = contour_points(sweep)
    _, near = KDTree(contour).query(patient.cloud.points)
    taken_s = sweep.frame_times_s[frames[near]] - sweep.latency_s
    assert patient.cloud.times is not None
    assert np.abs(patient.cloud.times - taken_s).max() < 0.15  # of 30 s; a cube of 0.75 mm is crossed in 0.04
    assert patient.labelled.times is not None
    assert np.array_equal(patient.labelled.times, patient.cloud.times)
    pair = find_dataset("phantom", SMALL).pair(one, patient)
    target = pair.alignment.target.cloud
    assert target.times is not None
    assert np.array_equal(target.points, patient.cloud.points)
    assert np.array_equal(target.times, patient.cloud.times)


@pytest.mark.parametrize("errors", [None, SweepErrors.only("calibration"), SweepErrors.none()])
def test_a_patient_knows_the_constant_part_of_its_sweeps_errors(one: Anatomy, errors: SweepErrors | None) -> None:
    patient = make_patient(one, SMALL, errors=errors)
    sweep = sweep_over(one, patient.T_us_ras, named_rng(0, f"{one.name}/sweep"), errors)
    assert np.array_equal(patient.shift_mm, constant_shift_mm(sweep, errors or SweepErrors()))
    assert (np.linalg.norm(patient.shift_mm) > 0.4) == (errors != SweepErrors.none())
