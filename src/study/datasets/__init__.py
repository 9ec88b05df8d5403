"""Data sets: one noun, `Dataset`, and the one look-up of the names that stand for one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from study.data.manifest import load_manifest
from study.data.schema import Manifest
from study.datasets.cohort import CohortDataset
from study.datasets.cut import Cut
from study.datasets.dataset import Dataset, TruthMap
from study.datasets.people import FRONT, Anatomy, Patient, anatomy_of, make_patient, read_anatomy, sweep_over
from study.datasets.phantoms import PhantomDataset, PopulationDataset
from study.datasets.planted import PlantedDataset, PlantedEveryDataset
from study.errors import StudyError
from study.params import StudyParams

__all__ = [
    "FRONT",
    "GENERATED",
    "Anatomy",
    "CohortDataset",
    "Cut",
    "Dataset",
    "Patient",
    "PhantomDataset",
    "PlantedDataset",
    "PlantedEveryDataset",
    "PopulationDataset",
    "TruthMap",
    "anatomy_of",
    "find_dataset",
    "for_evidence",
    "make_patient",
    "read_anatomy",
    "reported",
    "sweep_over",
]

# Cohorts of the manifest that are not read but made: their name decides by whom.
GENERATED: Mapping[str, type[Dataset]] = MappingProxyType(
    {
        "phantom": PhantomDataset,
        "planted": PlantedDataset,
        "population": PopulationDataset,
        "planted_every": PlantedEveryDataset,
    }
)


def find_dataset(
    name: str, params: StudyParams | None = None, seed: int = 0, manifest: Manifest | None = None
) -> Dataset:
    """The data set called ``name``.

    Args:
        name: a cohort of the manifest, or the path of a manifest file (``.yaml``) that holds one cohort.
        params: the profile; the full one when None.
        seed: of samples and sweeps.
        manifest: where the cohort stands; the shipped one when None.

    Raises:
        StudyError: no such cohort, several in a file of one's own, or a generated one that nothing here makes.
    """
    if manifest is None and name.endswith((".yaml", ".yml")):
        manifest = load_manifest(Path(name))
        if len(manifest.cohorts) != 1:
            raise StudyError(f"{name}: expected one cohort, got {', '.join(manifest.cohorts)}; give each its own file")
        name = next(iter(manifest.cohorts))
    manifest = manifest or load_manifest()
    kind: type[Dataset] = CohortDataset
    if manifest.cohort(name).kind == "generated":
        if name not in GENERATED:
            raise StudyError(
                f"{manifest.path.name}: expected a generated cohort among {', '.join(GENERATED)}, got {name!r}; "
                "give it files"
            )
        kind = GENERATED[name]
    return kind(name, params or StudyParams(), seed, manifest)


def reported(manifest: Manifest | None = None) -> list[str]:
    """Names of the data sets that the study reports, in the manifest's order."""
    return [name for name, cohort in (manifest or load_manifest()).cohorts.items() if cohort.reported]


def for_evidence(manifest: Manifest | None = None) -> list[str]:
    """Names of the data sets that `make evidence` runs, in the manifest's order; there may be none."""
    return [name for name, cohort in (manifest or load_manifest()).cohorts.items() if cohort.evidence]
