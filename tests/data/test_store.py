from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import yaml
from http_archive import (
    FAST,
    RIBFRAC_PATH,
    ArchiveServer,
    Write,
    noise,
    ribfrac_zip,
)

from study.data.fetch import fetch
from study.data.manifest import load_manifest
from study.data.store import data_dir, data_list, verify, verify_all
from study.errors import StudyError


def test_the_first_fetch_sets_the_hash_and_later_ones_are_held_to_it(
    write: Write, server: ArchiveServer, folder: Path
) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    file = manifest.file("ct")
    path = fetch(file, web=FAST)
    (entry,) = yaml.safe_load((folder / "data_lock.yaml").read_text(encoding="utf-8")).values()
    assert entry["sha256"] == hashlib.sha256(noise(1)).hexdigest()
    path.unlink()
    server.files[RIBFRAC_PATH] = ribfrac_zip({421: noise(2)})
    with pytest.raises(StudyError, match=rf"expected sha256 {entry['sha256']}, got .*recorded on .*data_lock\.yaml"):
        fetch(file, web=FAST)
    assert not path.exists()
    (folder / "data_lock.yaml").unlink()
    assert fetch(file, web=FAST).read_bytes() == noise(2)


def test_a_broken_lock_file_is_named(write: Write, folder: Path) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    folder.mkdir(exist_ok=True)
    for text in ("[1", "- a", "a: 1", "a: {sha256: 1}"):
        (folder / "data_lock.yaml").write_text(text)
        with pytest.raises(StudyError, match=r"data_lock\.yaml: expected"):
            fetch(manifest.file("ct"), web=FAST)


def test_a_damaged_file_is_reported_removed_and_fetched_again(write: Write) -> None:
    manifest = write(ribfrac_zip({421: noise(1)}), "RibFrac421-image.nii.gz")
    file = manifest.file("ct")
    with pytest.raises(StudyError, match="expected a file at"):
        verify(file)
    path = fetch(file, web=FAST)
    path.write_bytes(noise(2))
    (told,) = verify_all(manifest, "one")["status"]
    assert "expected sha256" in told
    assert hashlib.sha256(noise(2)).hexdigest() in told
    assert not path.exists()
    assert fetch(file, web=FAST).read_bytes() == noise(1)
    path.write_bytes(noise(2))
    assert fetch(file, web=FAST).read_bytes() == noise(1)
    assert list(verify_all(manifest, "one")["status"]) == ["verified"]


def test_data_folder_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert data_dir() == tmp_path / "data"
    monkeypatch.setenv("STUDY_DATA_DIR", "")
    assert "study" in data_dir().parts
    assert data_dir().is_absolute()


def test_the_list_has_a_row_for_every_file_of_every_subject() -> None:
    table = data_list(load_manifest())
    assert len(table) == 2 * 6 + 10 + 3 * 27  # open and open_sweeps share their files
    assert set(table.loc[table["dataset"] == "ribseg", "status"]) == {"absent", "to be put in place"}
    assert (table[["licence", "title", "source"]] != "").all(axis=None)
    assert len(data_list(load_manifest(), "open")) == 6
    assert len(data_list(load_manifest(), "phantom")) == 0
    with pytest.raises(StudyError, match=r"expected a cohort out of .*open, .*ribseg"):
        data_list(load_manifest(), "opne")


def test_the_open_cohort_is_what_the_manifest_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real files, when this machine has fetched them already; hashes are of the real packages."""
    monkeypatch.delenv("STUDY_DATA_DIR")
    manifest = load_manifest()
    table = data_list(manifest, "open")
    if not (table["status"] == "ready").all():
        pytest.skip("cohort `open` is not in the cache folder; run `study data fetch --dataset open`")
    for file in manifest.files_of("open").values():
        assert verify(file).stat().st_size == file.bytes
