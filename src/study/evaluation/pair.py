"""A pair to register and judge: two clouds, and what is known of the right answer (sec. IV)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

from study.alignment.chest import Alignment, Chest, find_chest
from study.alignment.frame import chest_frame
from study.errors import StudyError
from study.evaluation.waypoints import intercostal_waypoints
from study.methods import METHODS
from study.methods.visible_surface import faces_front
from study.registration import Registration
from study.types import Bools, Floats, Ints, PointCloud

# In place of a method: the known deformation itself, carried and measured as a method's answer is. What it scores is
# what a perfect registration would, under this protocol.
TRUTH = "truth"


def in_order(methods: Iterable[str]) -> list[str]:
    """Each method once: as ``METHODS`` lists them, then the others by name, `TRUTH` last; so in tables and figures."""
    known = list(METHODS)

    def place(name: str) -> tuple[bool, int, str]:
        return name == TRUTH, known.index(name) if name in known else len(known), name

    return sorted(set(methods), key=place)


@dataclass(frozen=True)
class Pair:
    """A CT and a patient, coarsely aligned, with what is known of the answer; the same for every method.

    Attributes:
        source: name of the CT.
        target: name of the patient.
        alignment: the two clouds and the motion that overlays their sternums.
        waypoints_ct: (k, 3) mm in the CT cloud's frame.
        waypoints_us: (k, 3) mm in the US cloud's frame, by the paper's protocol.
        true_points: where the CT's points truly lie, (n, 3) mm in the US frame; None between two real people.
        true_waypoints: the same of the CT's waypoints, (k, 3) mm.
        parts_ct: (n,) parts of the CT cloud as segmented; None where only the coarse alignment's are known.
        shift_mm: (3,) mm, US frame, the constant part of the sweep's errors, which moves the whole US cloud and which
            no method can see; None where the sweep was not simulated.
    """

    source: str
    target: str
    alignment: Alignment
    waypoints_ct: Floats
    waypoints_us: Floats
    true_points: Floats | None = None
    true_waypoints: Floats | None = None
    parts_ct: Ints | None = None
    shift_mm: Floats | None = None

    @property
    def name(self) -> str:
        """``"ct1/patient"``: what seeds the draws of its registrations."""
        return f"{self.source}/{self.target}"

    @property
    def has_truth(self) -> bool:
        """Whether the right answer is known."""
        return self.true_points is not None

    @cached_property
    def visible(self) -> Bools:
        """Points (n,) of the CT cloud that a probe could see: decided on the CT, the same for every method."""
        cloud = self.alignment.source.cloud
        return faces_front(cloud.points, chest_frame(cloud))

    @cached_property
    def visible_waypoints_ct(self) -> Floats:
        """The CT's waypoints (k, 3) mm by the paper's protocol, cut from the visible part of its cloud (sec. IV-B).

        Raises:
            StudyError: too few visible points on a cartilage.
        """
        cloud = self.alignment.source.cloud
        parts = cloud.parts if self.parts_ct is None else self.parts_ct
        assert parts is not None  # a chest is labelled
        seen = PointCloud(cloud.points[self.visible], f"{cloud.name} (visible)", parts[self.visible])
        return intercostal_waypoints(seen).points

    def with_target(self, chest: Chest) -> Pair:
        """The same people with another ultrasound cloud of the patient, its chest found."""
        return replace(self, alignment=Alignment(self.alignment.source, chest))


def align_pair(
    source: PointCloud,
    target: PointCloud,
    waypoints_ct: Floats,
    labelled: PointCloud,
    *,
    names: tuple[str, str],
    chests: tuple[Chest, Chest] | None = None,
) -> Pair:
    """A pair without a known truth: coarse alignment, and waypoints of the patient by the paper's protocol.

    Args:
        source: CT cloud; its parts, where it has any, are those that the paper segments by hand.
        target: US cloud.
        waypoints_ct: (k, 3) mm in the CT cloud's frame.
        labelled: the US cloud with the parts that the paper segments by hand.
        names: of the CT and the patient.
        chests: of both clouds where they are found already.

    Raises:
        StudyError: what the coarse alignment or the protocol refuses.
    """
    ct, us = chests or (find_chest(source), find_chest(target))
    waypoints_us = intercostal_waypoints(labelled).points
    return Pair(*names, Alignment(ct, us), waypoints_ct, waypoints_us, parts_ct=source.parts)


def perfect(pair: Pair) -> Registration:
    """The known deformation as if a method had found it.

    Raises:
        StudyError: nothing is known of the pair's truth.
    """
    if pair.true_points is None:
        raise StudyError(f"{pair.name}: expected a pair whose deformation is known, got two real people")
    source = pair.alignment.source.cloud.points
    return Registration(source, pair.true_points, pair.alignment.T_us_ct, True, 0, "the truth itself", method=TRUTH)
