"""Reading `data_manifest.yaml`: every fault is named by its key and its line before anything is fetched."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from study.data.schema import MANIFEST_NAME, Cohort, LocalSource, Manifest, PypiSource, SubjectEntry
from study.errors import StudyError
from study.files.places import shipped

YAML_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same YAML, read ten times faster where libyaml is

Fault = tuple[tuple[Any, ...], str]


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
    text = _read(own)
    try:
        root = yaml.compose(text, Loader=YAML_LOADER)
        raw = yaml.load(text, Loader=YAML_LOADER)
    except yaml.YAMLError as error:
        raise StudyError(f"{own.name}: expected YAML, got {' '.join(str(error).split())}") from error
    faults = _repeated_keys(root)
    if not isinstance(raw, dict):
        raise StudyError(f"{own.name}: expected the keys files, cohorts and label_maps, got {type(raw).__name__}")
    if path is not None and isinstance(maps := raw.setdefault("label_maps", {}), dict):
        raw["label_maps"] = yaml.load(_read(default_manifest_path()), Loader=YAML_LOADER)["label_maps"] | maps
    try:
        manifest = Manifest.model_validate(raw)
    except ValidationError as error:
        faults += [_fault(detail) for detail in error.errors(include_url=False)]
    else:
        manifest = manifest.read_from(own)
        faults += list(_loose_ends(manifest))
    if faults:
        count = f"{len(faults)} faults: " if len(faults) > 1 else ""
        told = "; ".join(f"{'.'.join(map(str, at)) or 'top level'}{_line(root, at)}: {what}" for at, what in faults)
        raise StudyError(f"{own.name}: {count}{told}")
    return manifest


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
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


def _repeated_keys(node: yaml.Node | None, at: tuple[Any, ...] = ()) -> list[Fault]:
    """Keys that stand twice in one mapping, of which YAML would silently keep the last."""
    faults: list[Fault] = []
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            if key.value in seen:
                faults.append(((*at, key.value), "expected the key once, got it twice"))
            seen.add(key.value)
            faults += _repeated_keys(value, (*at, key.value))
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            faults += _repeated_keys(value, (*at, index))
    return faults


def _line(node: yaml.Node | None, at: tuple[Any, ...]) -> str:
    """``" (line 41)"`` of the deepest key on the way to ``at`` that stands in the file."""
    line = 0
    for step in at:
        pairs: list[tuple[Any, yaml.Node, yaml.Node]] = []
        if isinstance(node, yaml.MappingNode):
            pairs = [(key.value, key, value) for key, value in node.value]
        elif isinstance(node, yaml.SequenceNode):
            pairs = [(str(index), value, value) for index, value in enumerate(node.value)]
        match = next(((mark, value) for name, mark, value in pairs if name == str(step)), None)
        if match is None:
            break
        line, node = match[0].start_mark.line + 1, match[1]
    return f" (line {line})" if line else ""
