"""How a person's sternum and cartilages were cut out of the CT (sec. II-C.1): by labels, rib labels or landmarks."""

from __future__ import annotations

from dataclasses import dataclass

from study.ct.growth import parts_from_landmarks, parts_from_ribs
from study.ct.parts import parts_from_labels
from study.data.fetch import fetch
from study.data.schema import Labels, Manifest, SubjectEntry
from study.errors import StudyError
from study.files.landmarks import read_landmarks
from study.files.volumes import read_labels, read_masks
from study.types import Volume

NOT_YET = "not yet"


@dataclass(frozen=True)
class Cut:
    """What stood in for the paper's cut by hand.

    Attributes:
        by: ``"labels"``, ``"labels, exact"``, ``"rib labels"``, ``"landmarks"``; ``"not yet"`` where neither is there.
        made_by: who or what made those.
        hard_to_see: places that were uncertain, in words.
    """

    by: str
    made_by: str
    hard_to_see: str = ""

    @property
    def is_done(self) -> bool:
        """Whether there is anything to cut by."""
        return self.by != NOT_YET


def cut_of(manifest: Manifest, subject: SubjectEntry) -> Cut:
    """How a subject of a file cohort is cut, without reading its images.

    Raises:
        StudyError: a landmark file that cannot be read.
    """
    path = manifest.landmarks_path(subject)
    if subject.labels:
        file = manifest.file(subject.labels.file)
        return Cut("labels", next(iter(file.oddities), file.title or file.key))
    if subject.rib_labels:
        file = manifest.file(subject.rib_labels.file)
        return Cut("rib labels", file.title or file.key)
    if path is not None and path.is_file():
        landmarks = read_landmarks(path)
        return Cut("landmarks", landmarks.made_by, "; ".join(landmarks.hard_to_see))
    return Cut(NOT_YET, f"waits for {subject.landmarks}")


def cut_parts(manifest: Manifest, subject: SubjectEntry, image: Volume) -> Volume:
    """The `Part` volume of a subject of a file cohort.

    Raises:
        StudyError: nothing to cut by, a file that cannot be had or read, or no such anatomy in it.
    """
    landmarks = manifest.landmarks_path(subject)
    if subject.labels is not None:
        return parts_from_labels(*_labels(manifest, subject.labels, image))
    if subject.rib_labels is not None:
        return parts_from_ribs(image, *_labels(manifest, subject.rib_labels, image))
    if landmarks is not None:
        return parts_from_landmarks(image, read_landmarks(landmarks))
    raise StudyError(
        f"{manifest.path.name}: expected labels, rib_labels or landmarks for {subject.title or subject.ct!r}, "
        "got none; without them cartilage cannot be told from muscle"
    )


def grown_parts(manifest: Manifest, subject: SubjectEntry, image: Volume) -> Volume | None:
    """The parts as growth finds them from the CT and the ribs among its labels; None where cartilage is not labelled.

    Growth never sees the labels of cartilage, so that the two can be compared.

    Raises:
        StudyError: a file that cannot be had or read, or no ribs in it.
    """
    if subject.labels is None:
        return None
    return parts_from_ribs(image, *_labels(manifest, subject.labels, image))


def _labels(manifest: Manifest, labels: Labels, image: Volume) -> tuple[Volume, dict[str, int]]:
    """A label volume on the grid of the CT, and its ids by structure."""
    file = manifest.file(labels.file)
    if file.is_family:
        paths = {mask.key.partition("/")[2]: fetch(mask) for mask in manifest.masks(labels).values()}
        return read_masks(paths, image)
    return read_labels(fetch(file), image), manifest.label_ids(labels.map)
