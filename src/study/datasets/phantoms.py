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
from study.params import PHANTOM_SEED
from study.seeds import named_rng


@dataclass(frozen=True)
class PhantomDataset(Dataset):
    """Several synthetic CTs and one synthetic patient, as the paper has five CTs and a volunteer.

    Attributes:
        cohort_seed: draws the people; ``PHANTOM_SEED`` is the reported cohort's.
    """

    cohort_seed: int = PHANTOM_SEED

    has_truth: ClassVar[bool] = True
    people: ClassVar[str] = "synthetic"

    def anatomy(self, name: str, origin: Anatomy | None = None) -> Anatomy:
        """See `Dataset.anatomy`: volume and labels, surface, cloud; the waypoints are exact."""
        self.require(name)
        drawn = phantom.draw_subject(name, self.cohort_seed)
        rng = named_rng(self.cohort_seed, f"ct/{name}")
        image, labels = phantom.ct_volume(drawn, self.params.phantom_spacing_mm, rng)
        mask = parts_from_labels(labels, load_manifest().label_ids("totalsegmentator_v2"))
        samples = named_rng(self.seed, f"phantom/{name}/anatomy")
        anatomy = anatomy_of(name, image, mask, self.params.ct_points, samples)
        return replace(anatomy, waypoints=phantom.waypoints(drawn))

    def cut(self, name: str) -> Cut:
        """See `Dataset.cut`."""
        self.require(name)
        return Cut("labels, exact", "made with the image")

    def truth(self, source: str | Anatomy, target: str | Anatomy) -> TruthMap:
        """See `Dataset.truth`."""
        names = (one if isinstance(one, str) else one.name for one in (source, target))
        here, there = (phantom.draw_subject(name, self.cohort_seed) for name in names)
        return partial(phantom.truth_map, here, there)
