"""Reading `data_manifest.yaml`: every fault is named by its key and its line before anything is fetched."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import urlsplit

import yaml
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from study.data.schema import (
    MANIFEST_NAME,
    Cohort,
    DataFile,
    LocalSource,
    Manifest,
    PypiSource,
    SubjectEntry,
    ZipSource,
)
from study.errors import StudyError
from study.files.places import shipped
from study.files.yaml_text import Fault, located, read_yaml, repeated_keys


def default_manifest_path() -> Path:
    """The study's own manifest: the repository's in a checkout, else the installed package's copy."""
    return shipped(MANIFEST_NAME)


def load_manifest(path: Path | str | None = None) -> Manifest:
    """Read and check a manifest; the repository's by default.

    A manifest of one's own may use the label maps of the repository's.

    Raises:
        StudyError: no such file, not YAML, or what it says breaks the schema; every fault is named by its key.
    """
    own = default_manifest_path() if path is None else Path(path).expanduser().resolve()
    raw, root = _read(own)
    faults = repeated_keys(root)
    if not isinstance(raw, dict):
        raise StudyError(
            f"{own.name}: expected the keys files, cohorts and label_maps, got {type(raw).__name__}; write them as"
            f" {MANIFEST_NAME} does"
        )
    if path is not None and isinstance(maps := raw.setdefault("label_maps", {}), dict):
        raw["label_maps"] = _read(default_manifest_path())[0]["label_maps"] | maps
    try:
        manifest = Manifest.model_validate(raw)
    except ValidationError as error:
        faults += [_fault(detail) for detail in error.errors(include_url=False)]
    else:
        manifest = manifest.read_from(own)
        faults += [*_loose_ends(manifest), *_collisions(manifest)]
    if faults:
        raise located(faults, root, own.name)
    return manifest


def _read(path: Path) -> tuple[Any, yaml.Node | None]:
    try:
        return read_yaml(path)
    except OSError as error:
        raise StudyError(f"{path}: expected a readable manifest, got {error}; check the path") from error


def _loose_ends(manifest: Manifest) -> Iterable[Fault]:
    """What the schema of single values can't see: references, and what a kind of source must state."""
    for key, file in manifest.files.items():
        at: tuple[Any, ...] = ("files", key)
        wanted: tuple[str, ...] = () if isinstance(file.source, LocalSource) else ("title", "licence", "citation")
        if isinstance(file.source, PypiSource):
            wanted += ("bytes", "sha256")
        yield from (((*at, name), "expected a value, got none") for name in wanted if getattr(file, name) is None)
        if file.is_family and (file.sha256 or file.bytes):
            yield (*at, "sha256"), "expected none for a family of files, got one"
    for name, cohort in manifest.cohorts.items():
        for key, subject in cohort.subjects.items():
            at = ("cohorts", name, "subjects", key)
            yield from ((at + where, what) for where, what in _subject_faults(manifest, cohort, subject))


def _collisions(manifest: Manifest) -> Iterable[Fault]:
    """Files that would take each other's place in the data folder."""
    members = {_place(file): key for key, file in manifest.files.items()}
    zips: dict[str, tuple[str, str]] = {}  # file name of an archive: its address, and the first key
    for key, file in manifest.files.items():
        archive, member = _place(file)
        for parent in member.parents:
            if (archive, parent) in members:
                other = members[archive, parent]
                yield ("files", key, "source", "member"), f"expected a path beside that of files.{other}, got one in it"
        if isinstance(file.source, ZipSource):
            url, other = zips.setdefault(PurePosixPath(urlsplit(archive).path).name, (archive, key))
            if url != archive and not (file.source.archive_sha256 or file.source.archive_md5):
                what = f"expected archive_sha256, because the archive of files.{other} has the same name, got none"
                yield ("files", key, "source"), what


def _place(file: DataFile) -> tuple[str, PurePosixPath]:
    """The archive of a file and the path in it."""
    source = file.source
    match source:
        case PypiSource():
            archive = f"{source.archive} {source.sha256}"
        case ZipSource():
            archive = source.url
        case LocalSource():
            archive = source.path
    return archive, PurePosixPath(source.member or "")


def _subject_faults(manifest: Manifest, cohort: Cohort, subject: SubjectEntry) -> Iterable[Fault]:
    def reference(at: tuple[Any, ...], key: str, table: Mapping[str, Any], noun: str) -> Iterable[Fault]:
        if key not in table:
            yield at, f"expected a key of `{noun}`, got {key!r}"

    if cohort.kind == "generated":
        given = [name for name in ("ct", "labels", "rib_labels", "landmarks") if getattr(subject, name)]
        yield from (((name,), "expected no files in a generated cohort, got one") for name in given)
        return
    if subject.ct is None:
        yield ("ct",), "expected a value, got none"
    else:
        yield from reference(("ct",), subject.ct, manifest.files, "files")
        yield from _role_fault(manifest, ("ct",), subject.ct, "ct")
    for name in ("labels", "rib_labels"):
        labels = getattr(subject, name)
        if labels:
            yield from reference((name, "file"), labels.file, manifest.files, "files")
            yield from _role_fault(manifest, (name, "file"), labels.file, name)
            yield from reference((name, "map"), labels.map, manifest.label_maps, "label_maps")
    for index, key in enumerate(subject.tables):
        yield from reference(("tables", index), key, manifest.files, "files")
        yield from _role_fault(manifest, ("tables", index), key, "table")
    if not (subject.labels or subject.rib_labels or subject.landmarks):
        yield (), "expected labels, rib_labels or landmarks, got none; without one no cartilage can be found"


def _role_fault(manifest: Manifest, at: tuple[Any, ...], key: str, role: str) -> Iterable[Fault]:
    if key in manifest.files and manifest.files[key].role != role:
        yield at, f"expected a file with role {role!r}, got {key!r} with role {manifest.files[key].role!r}"


def _fault(detail: ErrorDetails) -> Fault:
    """One of pydantic's errors in this project's words, at the key as it stands in the file."""
    at = list(detail["loc"])
    if "source" in at[:-1] and at[at.index("source") + 1] in ("pypi", "zip", "local"):
        del at[at.index("source") + 1]  # the tag of the union is no key of the file
    kind, got = detail["type"], detail["input"]
    if kind == "missing":
        return tuple(at), "expected a value, got none"
    if kind == "extra_forbidden":
        return tuple(at), "expected no such key, got it; check its spelling"
    if kind == "union_tag_not_found":
        return (*at, "kind"), "expected pypi, zip or local, got none"
    if kind == "union_tag_invalid":
        return (*at, "kind"), f"expected pypi, zip or local, got {got.get('kind')!r}"
    if at and at[-1] == "[key]":
        at = at[:-1]
    words = detail["msg"].replace("Input should be", "expected", 1)
    words = words if words.startswith("expected") else f"expected {words[:1].lower()}{words[1:]}"
    shown = repr(got) if not isinstance(got, dict | list) else f"a {type(got).__name__} of {len(got)}"
    return tuple(at), f"{words}, got {shown}"
