"""Synthetic people, by the road of a real CT; the deformation between any two of them is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

from study import phantom
from study.ct.parts import parts_from_labels
from study.data.manifest import load_manifest
from study.datasets.cut import Cut
from study.datasets.dataset import Dataset, TruthMap
from study.datasets.people import Anatomy, anatomy_of
from study.params import PHANTOM_SEED, POPULATION_SEED
from study.phantom.sizes import MAX_SD
from study.seeds import named_rng


@dataclass(frozen=True)
class PhantomDataset(Dataset):
    """Several synthetic CTs and one synthetic patient, as the paper has five CTs and a volunteer.

    Attributes:
        cohort_seed: draws the people; ``PHANTOM_SEED`` is the reported cohort's.
        max_sd: how far people may lie from the mean, see `study.phantom.draw_subject`.
    """

    cohort_seed: int = PHANTOM_SEED
    max_sd: float = MAX_SD

    has_truth: ClassVar[bool] = True
    people: ClassVar[str] = "synthetic"

    def anatomy(self, name: str, origin: Anatomy | None = None) -> Anatomy:
        """See `Dataset.anatomy`: volume and labels, surface, cloud; the waypoints are exact."""
        self.require(name)
        drawn = self.draw(name)
        rng = named_rng(self.cohort_seed, f"ct/{name}")
        image, labels = phantom.ct_volume(drawn, self.params.phantom_spacing_mm, rng)
        mask = parts_from_labels(labels, load_manifest().label_ids("totalsegmentator_v2"))
        samples = named_rng(self.seed, f"{self.name}/{name}/anatomy")
        anatomy = anatomy_of(name, image, mask, self.params.ct_points, samples)
        return replace(anatomy, waypoints=phantom.waypoints(drawn))

    def cut(self, name: str) -> Cut:
        """See `Dataset.cut`."""
        self.require(name)
        return Cut("labels, exact", "made with the image")

    def truth(self, source: str | Anatomy, target: str | Anatomy) -> TruthMap:
        """See `Dataset.truth`."""
        names = (one if isinstance(one, str) else one.name for one in (source, target))
        here, there = (self.draw(name) for name in names)
        return partial(phantom.truth_map, here, there)

    def draw(self, name: str) -> phantom.SyntheticSubject:
        """One person of the cohort, as drawn.

        Raises:
            StudyError: an unknown name.
        """
        self.require(name)
        return phantom.draw_subject(name, self.cohort_seed, self.max_sd)


@dataclass(frozen=True)
class PopulationDataset(PhantomDataset):
    """Synthetic people over the whole published spread, each CT and patient; draws are cut nowhere.

    Some are so unusual that the coarse alignment refuses them: their cases are rows with the reason, and counted.
    """

    cohort_seed: int = POPULATION_SEED
    max_sd: float = float("inf")
