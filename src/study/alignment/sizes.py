"""Whether what was found can be a chest, and two chests those of two people (sec. III-A).

The coarse alignment finds eight branches in many things. Its sizes and proportions tell a cut sternum with cartilages
2-5 from one with ribs, with other levels, upside down or scaled; limits are those of development people
(benchmarks/chest_limits.py prints them with the rates of right and wrong clouds on either side).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from study.alignment.chest import Alignment, Chest
from study.alignment.frame import chest_frame
from study.alignment.sternum import CROP
from study.errors import StudyError
from study.types import CARTILAGES, Part


@dataclass(frozen=True)
class Limit:
    """Between which values a measure is that of a chest.

    Attributes:
        title: what is measured.
        unit: ``"mm"`` or ``""``.
        low, high: outside, a warning.
        hint: what is the matter where it is outside.
    """

    title: str
    unit: str
    low: float
    high: float
    hint: str

    def excess(self, value: float) -> float:
        """How far outside, in widths of the range; 0 inside."""
        return max(self.low - value, value - self.high, 0.0) / (self.high - self.low)

    def told(self, who: str, value: float) -> str:
        """Expected, got, what to do."""
        return f"{who}: expected {self.title} of {self.range}, got {value:.3g}; {self.hint}"

    @property
    def range(self) -> str:
        """``"38 to 116 mm"``."""
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()


_SCALE = f"{CROP}; check that the units are mm"
_LEVELS = f"{CROP}; is a level missing, another taken for it, or head taken for foot?"
_SIDES = "does the cloud miss the outer part of a cartilage on one side?"
_PAIR = "check that both are in mm and cropped alike; two people differ less"

# The range of development people, widened by half of its width on either side: the phantoms are drawn from published
# spreads, but cut at 1.3 SD and bent out of one canonical wall.
LIMITS: Mapping[str, Limit] = MappingProxyType(
    {
        "span": Limit("a span from the 2nd to the 5th attachments", "mm", 38.0, 116.0, _SCALE),
        "reach": Limit("a mean reach of the cartilages beside the sternum", "mm", 30.0, 71.0, _SCALE),
        "width": Limit("a sternum between the attachments with a width", "mm", 19.0, 38.0, _SCALE),
        "upper_gap": Limit("a share of that span between 2nd and 3rd attachment", "", 0.327, 0.424, _LEVELS),
        "lower_gap": Limit("a share of that span between 4th and 5th attachment", "", 0.249, 0.333, _LEVELS),
        "reach_2": Limit("a reach of the 2nd cartilages over the mean", "", 0.57, 0.97, _LEVELS),
        "reach_5": Limit("a reach of the 5th cartilages over the mean", "", 0.97, 1.52, _LEVELS),
        "asymmetry": Limit("a largest log ratio between the reaches of both sides", "", 0.0, 0.33, _SIDES),
        "bulge": Limit("an arch of the cartilages to the front", "mm", -0.9, 6.3, CROP),
        "fill": Limit("a density of points between the attachments over that on them", "", 0.0, 0.4, CROP),
        "above": Limit("a sternum that ends above the 2nd attachments by", "mm", -2.6, 26.5, CROP),
    }
)
PAIR_LIMITS: Mapping[str, Limit] = MappingProxyType(
    {  # logarithms of US over CT
        "span": Limit("a log ratio of both clouds' spans", "", -0.6, 0.6, _PAIR),
        "reach": Limit("a log ratio of both clouds' reaches", "", -0.45, 0.45, _PAIR),
        "size": Limit("a mean log ratio of both clouds' spans, reaches and sternum widths", "", -0.35, 0.35, _PAIR),
    }
)
MAX_COVER = 0.36  # log ratio of one cartilage's reach in both clouds, beside that of all
REFUSE = 0.2  # widths of a range outside it: no chest has a size in mm so far off
TOO_MANY = 3  # signs of any kind; real people, whose proportions vary more than the phantoms', show up to two


def chest_sizes(chest: Chest) -> dict[str, float]:
    """Sizes (mm) and proportions of a chest that was found, by the names of `LIMITS`."""
    frame = chest_frame(chest.cloud)
    roots = np.array([[frame.root_mm[Part.cartilage(side, k)] for k in (2, 3, 4, 5)] for side in ("right", "left")])
    reach = np.array([[frame.reach_mm[Part.cartilage(side, k)] for k in (2, 3, 4, 5)] for side in ("right", "left")])
    heights, reaches = roots.mean(axis=0), reach.mean(axis=0)
    span, mean_reach = float(heights[0] - heights[3]), float(reaches.mean())
    gaps = -np.diff(heights) / span
    sternum = chest.T_cloud_chest.inverse.apply(chest.cloud.only(Part.STERNUM))[:, 1]
    return {
        "span": span,
        "reach": mean_reach,
        "width": frame.width_mm,
        "upper_gap": float(gaps[0]),
        "lower_gap": float(gaps[2]),
        "reach_2": float(reaches[0] / mean_reach),
        "reach_5": float(reaches[3] / mean_reach),
        "asymmetry": float(np.abs(np.log(np.maximum(reach[0], 1e-3) / np.maximum(reach[1], 1e-3))).max()),
        "bulge": chest.bulge_mm,
        "fill": chest.search.roots.fill,
        "above": float(np.percentile(sternum, 99) - heights[0]),
    }


def size_warnings(alignment: Alignment) -> tuple[str, ...]:
    """What makes two chests suspect, a sentence each: by themselves, and beside each other.

    Raises:
        StudyError: a chest with a size far outside its limits, or with three signs that it is none.
    """
    told: list[str] = []
    try:
        source, target = chest_sizes(alignment.source), chest_sizes(alignment.target)
    except StudyError as error:  # a part is missing, as in an alignment by hand: nothing to measure, and that is told
        return (str(error),)
    for chest, sizes in ((alignment.source, source), (alignment.target, target)):
        told += _signs(chest.cloud.name, sizes)
    ratio = {name: float(np.log(target[name] / source[name])) for name in ("span", "reach", "width")}
    ratio["size"] = float(np.mean(list(ratio.values())))
    both = f"{alignment.target.cloud.name} over {alignment.source.cloud.name}"
    told += [limit.told(both, ratio[name]) for name, limit in PAIR_LIMITS.items() if limit.excess(ratio[name]) > 0]
    return (*told, *_uncovered(alignment, ratio["reach"]))


def _signs(who: str, sizes: Mapping[str, float]) -> list[str]:
    """A sentence for each size of a chest outside its limits.

    Raises:
        StudyError: sizes that leave nothing to warn of.
    """
    excess = {name: limit.excess(sizes[name]) for name, limit in LIMITS.items()}
    told = [LIMITS[name].told(who, sizes[name]) for name in excess if excess[name] > 0]
    if len(told) >= TOO_MANY or any(excess[name] > REFUSE and LIMITS[name].unit == "mm" for name in excess):
        first = next(name for name in excess if excess[name] > 0)
        limit = LIMITS[first]
        raise StudyError(f"{who}: expected {limit.title} of {limit.range}, got {sizes[first]:.3g}; {limit.hint}")
    return told


def _uncovered(alignment: Alignment, log_ratio: float) -> list[str]:
    """A sentence for each cartilage that reaches far less in the US cloud than the others do."""
    source, target = (chest_frame(chest.cloud).reach_mm for chest in (alignment.source, alignment.target))
    return [
        f"{alignment.target.cloud.name}: expected the whole of {part.name.lower()}, got {target[part]:.0f} mm of it "
        f"beside the sternum against {source[part]:.0f} mm in {alignment.source.cloud.name}; is its outer part covered?"
        for part in CARTILAGES
        if np.log(max(target[part], 1e-3) / max(source[part], 1e-3)) - log_ratio < -MAX_COVER
    ]
