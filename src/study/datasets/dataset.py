"""One noun for every data set: who is the atlas, who the patient, where they come from, what is known of the truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from study.alignment.chest import Chest
from study.data.schema import Manifest
from study.datasets.cut import Cut
from study.datasets.people import Anatomy, Patient, make_patient
from study.errors import StudyError
from study.evaluation.pair import Pair, align_pair
from study.naming import split_sweep, sweep_name
from study.params import StudyParams
from study.seeds import named_rng
from study.types import Floats, Volume
from study.ultrasound.sweep_errors import SweepErrors

TruthMap = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Dataset(ABC):
    """People to register to each other.

    Attributes:
        name: its cohort in the manifest.
        params: how many of them, and how finely.
        seed: of samples and sweeps; combined with names, never with order.
        manifest: who belongs to it.
    """

    name: str
    params: StudyParams
    seed: int
    manifest: Manifest

    has_truth: ClassVar[bool]
    people: ClassVar[str]  # "real people", ...: what a reader should know of the CTs

    @property
    def title(self) -> str:
        """What the manifest says of it."""
        return self.manifest.cohort(self.name).title or self.name

    @property
    def file_cohort(self) -> str:
        """The manifest's cohort that its people and their files belong to."""
        return self.manifest.cohort(self.name).people_of or self.name

    def sources(self) -> list[str]:
        """Who can be the CT."""
        subjects = self.manifest.cohort(self.name).subjects
        return [name for name, subject in subjects.items() if subject.role in ("ct", "any")]

    def targets(self) -> list[str]:
        """Who can be the patient, as many as ``params`` asks for."""
        subjects = self.manifest.cohort(self.name).subjects
        names = [name for name, subject in subjects.items() if subject.role in ("patient", "any")]
        return names[: self.params.max_targets or None]

    def pairs(self) -> list[tuple[str, str]]:
        """The (CT, patient) pairs, patient by patient and sweep by sweep; nobody is paired with themselves.

        A patient's name says the sweep, see `study.naming.sweep_name`.

        Raises:
            StudyError: nobody to pair.
        """
        chosen: list[tuple[str, str]] = []
        for target in self.targets():
            atlases = self.atlases(target)[: self.params.max_sources or None]
            for sweep in range(self.manifest.cohort(self.name).sweeps):
                chosen += [(source, sweep_name(target, sweep)) for source in atlases]
        if not chosen:
            raise StudyError(
                f"dataset {self.name!r}: expected two subjects or more, one of them a patient; got none to pair"
            )
        return chosen

    def atlases(self, target: str) -> list[str]:
        """Whose CTs are registered to a patient: all others, or as many as the cohort asks for, evenly around a circle.

        Around the circle of people each patient has the CTs at the same few distances, so that in a cohort in which
        everybody is both, everybody is a CT as often as a patient.
        """
        sources, wanted = self.sources(), self.manifest.cohort(self.name).atlases
        start = sources.index(target) + 1 if target in sources else 0
        others = [name for name in (*sources[start:], *sources[:start]) if name != target]
        if not wanted or wanted >= len(others):
            return [source for source in sources if source != target]
        return [others[round(k * len(others) / wanted)] for k in range(wanted)]

    def names(self) -> list[str]:
        """Everybody who takes part in a pair, each once, the CTs first; a patient once for all sweeps."""
        sources, targets = zip(*self.pairs(), strict=True)
        return list(dict.fromkeys([*sources, *(split_sweep(target)[0] for target in targets)]))

    def with_ct(self) -> list[str]:
        """Everybody with a CT of their own, in the manifest's order."""
        return [name for name in self.manifest.cohort(self.name).subjects if self.origin(name) is None]

    def origin(self, name: str) -> str | None:
        """Whose known deformation this person is; None for a person of their own."""
        self.require(name)
        return None

    @abstractmethod
    def anatomy(self, name: str, origin: Anatomy | None = None) -> Anatomy:
        """One person's surface and cloud (sec. II-C.1).

        Args:
            name: one of `names`.
            origin: the anatomy of `origin`, where it is at hand.

        Raises:
            StudyError: an unknown name, a failed download, or an image without the anatomy.
        """

    def anatomies(self, names: Iterable[str]) -> tuple[dict[str, Anatomy], dict[str, str]]:
        """Several people's anatomies by name, and why each of the others is left out."""
        people: dict[str, Anatomy] = {}
        left_out: dict[str, str] = {}
        for name in names:
            try:
                people[name] = self.anatomy(name)
            except StudyError as error:
                left_out[name] = str(error)
        return people, left_out

    @abstractmethod
    def cut(self, name: str) -> Cut:
        """How one person's sternum and cartilages were told from the rest of the CT.

        Raises:
            StudyError: an unknown name, or a landmark file that cannot be read.
        """

    def grown(self, name: str, image: Volume) -> Volume | None:
        """The parts of one person grown from the CT and rib labels alone; None where no labels tell them better.

        Args:
            name: one of `names`.
            image: that person's CT.

        Raises:
            StudyError: an unknown name, or a file that cannot be had.
        """
        self.require(name)
        return None

    def patient(self, name: str, anatomy: Anatomy | None = None, errors: SweepErrors | None = None) -> Patient:
        """What a virtual sweep sees of one person (sec. II-C.2).

        Args:
            name: a patient of `pairs`.
            anatomy: that person's, where it is at hand.
            errors: what goes wrong; every source at its default size when None.

        Raises:
            StudyError: an unknown name, or a sweep that the cohort does not have.
        """
        person, sweep = split_sweep(name)
        self.require(person)
        n_sweeps = self.manifest.cohort(self.name).sweeps
        if not 0 <= sweep < n_sweeps:
            raise StudyError(f"{self.name}: expected one of {n_sweeps} sweep(s), numbered from 0, got {name!r}")
        return make_patient(anatomy or self.anatomy(person), self.params, self.seed, errors, sweep)

    @abstractmethod
    def truth(self, source: str | Anatomy, target: str | Anatomy) -> TruthMap | None:
        """Where each place (n, 3) mm of one person truly is in another, both RAS+; None between two real people."""

    def pair(self, source: Anatomy, patient: Patient, chests: tuple[Chest, Chest] | None = None) -> Pair:
        """A CT and a patient, coarsely aligned, with what is known of the answer.

        Args:
            source: the CT's anatomy.
            patient: the patient.
            chests: of the CT's and the patient's cloud, where they are found already.

        Raises:
            StudyError: what the coarse alignment or the paper's protocol refuses.
        """
        pair = align_pair(
            source.cloud,
            patient.cloud,
            source.waypoints.points,
            patient.labelled,
            names=(source.name, patient.name),
            chests=chests,
        )
        pair = replace(pair, shift_mm=patient.shift_mm)
        truth = self.truth(source, patient.anatomy)
        if truth is None:
            return pair
        points, waypoints = (
            patient.T_us_ras.apply(truth(places)) for places in (source.cloud.points, source.waypoints.points)
        )
        return replace(pair, true_points=points, true_waypoints=waypoints)

    def load_pair(self, source: str, target: str) -> Pair:
        """`pair` of two names."""
        return self.pair(self.anatomy(source), self.patient(target))

    def fetch(self, name: str, progress: bool = False) -> None:
        """Fetch and verify the files that a person is read from; nothing for a generated one.

        Raises:
            StudyError: an unknown name, or a file that cannot be had.
        """
        self.require(name)

    def files(self, name: str) -> dict[str, Path]:
        """The files a person is read from that are here, by key."""
        self.require(name)
        return {}

    def rng(self, name: str) -> np.random.Generator:
        """Draws that depend on the seed and on what is computed, not on when."""
        return named_rng(self.seed, name)

    def require(self, name: str) -> None:
        """Refuse a name that the data set does not have.

        Raises:
            StudyError: that name.
        """
        subjects = self.manifest.cohort(self.name).subjects
        if name not in subjects:
            raise StudyError(f"{self.name}: expected a subject among {', '.join(subjects)}, got {name!r}")
