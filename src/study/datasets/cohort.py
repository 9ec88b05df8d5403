"""Real people, read from the files that a manifest names; each in turn is the patient of all others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from study.data.fetch import fetch, fetch_all
from study.data.schema import Manifest, SubjectEntry
from study.data.store import path_of
from study.datasets.cut import Cut, cut_of, cut_parts, grown_parts
from study.datasets.dataset import Dataset
from study.datasets.people import Anatomy, anatomy_of
from study.errors import StudyError
from study.files.volumes import read_volume
from study.seeds import named_rng
from study.types import Volume


@dataclass(frozen=True)
class CohortDataset(Dataset):
    """People whose CTs are files; what one looks like inside another is not known."""

    has_truth: ClassVar[bool] = False
    people: ClassVar[str] = "real"

    def anatomy(self, name: str, origin: Anatomy | None = None) -> Anatomy:
        """See `Dataset.anatomy`; files are fetched where they are missing."""
        self.require(name)
        image, mask = read_subject(self.manifest, self.manifest.cohort(self.name).subjects[name])
        rng = named_rng(self.seed, f"{self.file_cohort}/{name}/anatomy")
        return anatomy_of(name, image, mask, self.params.ct_points, rng)

    def truth(self, source: str | Anatomy, target: str | Anatomy) -> None:
        """Not known between two real people."""
        return None

    def cut(self, name: str) -> Cut:
        """See `Dataset.cut`."""
        self.require(name)
        return cut_of(self.manifest, self.manifest.cohort(self.name).subjects[name])

    def grown(self, name: str, image: Volume) -> Volume | None:
        """See `Dataset.grown`."""
        self.require(name)
        return grown_parts(self.manifest, self.manifest.cohort(self.name).subjects[name], image)

    def fetch(self, name: str, progress: bool = False) -> None:
        """See `Dataset.fetch`."""
        self.require(name)
        fetch_subject(self.manifest, self.name, name, progress)

    def files(self, name: str) -> dict[str, Path]:
        """See `Dataset.files`; a landmark file under its path in the manifest."""
        self.require(name)
        return files_of(self.manifest, self.manifest.cohort(self.name).subjects[name])


def fetch_subject(manifest: Manifest, cohort: str, name: str, progress: bool = False) -> None:
    """Fetch and verify the files of one subject of a cohort.

    Raises:
        StudyError: a file that cannot be had.
    """
    whole = manifest.cohort(cohort)
    alone = whole.model_copy(update={"subjects": {name: whole.subjects[name]}})
    fetch_all(manifest.model_copy(update={"cohorts": {name: alone}}), name, progress=progress)


def files_of(manifest: Manifest, subject: SubjectEntry) -> dict[str, Path]:
    """The files of a subject that are here, by key; a landmark file under its path in the manifest."""
    paths = {file.key: path_of(file) for file in manifest.files_of_subject(subject)}
    landmarks = manifest.landmarks_path(subject)
    if landmarks is not None:
        paths[str(subject.landmarks)] = landmarks
    return {key: path for key, path in paths.items() if path.exists()}


def read_subject(manifest: Manifest, subject: SubjectEntry) -> tuple[Volume, Volume]:
    """The CT and its mask of parts, from labels, rib labels or landmarks (sec. II-C.1).

    Raises:
        StudyError: no CT or nothing to cut it by, a file that cannot be had or read, or no such anatomy in it.
    """
    if subject.ct is None:
        raise StudyError(f"{manifest.path.name}: expected a ct for every subject of a file cohort, got none")
    image = read_volume(fetch(manifest.file(subject.ct)))
    return image, cut_parts(manifest, subject, image)
