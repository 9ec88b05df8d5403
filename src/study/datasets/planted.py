"""Real CTs, each registered to itself under smooth deformations that are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar

from study.datasets.cohort import fetch_subject, files_of, read_subject
from study.datasets.cut import Cut, cut_of
from study.datasets.dataset import Dataset, TruthMap
from study.datasets.people import Anatomy, anatomy_of
from study.errors import StudyError
from study.naming import PLANTED, person_of, planted_name
from study.phantom.planted import planted_deformation
from study.seeds import named_rng

COHORT = "open"  # whose files the CT is read from
SIZES_MM: Mapping[str, float] = MappingProxyType(  # mean distance after a rigid fit, as between people
    {"planted1": 5.0, "planted2": 6.0, "planted3": 7.0, "planted4": 8.0, "planted5": 9.0}
)


@dataclass(frozen=True)
class PlantedDataset(Dataset):
    """One real CT; its patients are that person under deformations of the kinds and sizes found between people."""

    has_truth: ClassVar[bool] = True
    people: ClassVar[str] = "real"

    @property
    def file_cohort(self) -> str:
        """See `Dataset.file_cohort`."""
        return COHORT

    def origin(self, name: str) -> str | None:
        """See `Dataset.origin`."""
        self.require(name)
        return self.sources()[0] if name in SIZES_MM else None

    def anatomy(self, name: str, origin: Anatomy | None = None) -> Anatomy:
        """See `Dataset.anatomy`."""
        one = self.origin(name)
        if one is not None:
            return plant(origin or self.anatomy(one), name)
        image, mask = read_subject(self.manifest, self.manifest.cohort(COHORT).subjects[name])
        rng = named_rng(self.seed, f"{self.name}/{name}/anatomy")
        return anatomy_of(name, image, mask, self.params.ct_points, rng)

    def cut(self, name: str) -> Cut:
        """See `Dataset.cut`; a planted patient is cut as the CT that it is a deformation of."""
        return cut_of(self.manifest, self.manifest.cohort(COHORT).subjects[self.origin(name) or name])

    def truth(self, source: str | Anatomy, target: str | Anatomy) -> TruthMap:
        """See `Dataset.truth`.

        Raises:
            StudyError: a target that is not a planted patient.
        """
        there = self.anatomy(target) if isinstance(target, str) else target
        if there.planted is None:
            raise StudyError(f"{self.name}: expected a planted patient as the target, got {there.name!r}")
        return there.planted.apply

    def fetch(self, name: str, progress: bool = False) -> None:
        """See `Dataset.fetch`."""
        fetch_subject(self.manifest, COHORT, self.origin(name) or name, progress)

    def files(self, name: str) -> dict[str, Path]:
        """See `Dataset.files`."""
        return files_of(self.manifest, self.manifest.cohort(COHORT).subjects[self.origin(name) or name])


@dataclass(frozen=True)
class PlantedEveryDataset(PlantedDataset):
    """Several real CTs; the patients of each are that person under deformations of its own, ``lung1+planted3``."""

    def require(self, name: str) -> None:
        """See `Dataset.require`; a planted patient is known by its person and its deformation."""
        super().require(person_of(name))
        known = [planted_name(person_of(name), deformation) for deformation in SIZES_MM]
        if name not in (person_of(name), *known):
            raise StudyError(f"{self.name}: expected a patient among {', '.join(known)}, got {name!r}")

    def origin(self, name: str) -> str | None:
        """See `Dataset.origin`."""
        self.require(name)
        return None if name == person_of(name) else person_of(name)

    def targets(self) -> list[str]:
        """See `Dataset.targets`: every deformation of every person."""
        names = [planted_name(person, deformation) for person in self.sources() for deformation in SIZES_MM]
        return names[: self.params.max_targets or None]

    def atlases(self, target: str) -> list[str]:
        """See `Dataset.atlases`: the CT that the patient is a deformation of."""
        return [person_of(target)]


def plant(source: Anatomy, name: str) -> Anatomy:
    """The patient ``name``: an anatomy under its known smooth deformation; it has no image of its own."""
    size_mm = SIZES_MM[name.rpartition(PLANTED)[2]]
    deform = planted_deformation(source.mesh.vertices, size_mm, named_rng(0, f"planted/{name}"))
    mesh = replace(source.mesh, vertices=deform.apply(source.mesh.vertices), name=name)
    cloud = replace(source.cloud, points=deform.apply(source.cloud.points), name=f"ct:{name}")
    waypoints = replace(source.waypoints, points=deform.apply(source.waypoints.points))
    return Anatomy(name, mesh, cloud, waypoints, planted=deform)
