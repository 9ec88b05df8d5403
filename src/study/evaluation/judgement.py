"""One registration of one pair, with what several metrics share computed once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from study.errors import StudyError
from study.evaluation.distances import CloudDistances, point_errors_mm, waypoint_errors_mm
from study.evaluation.pair import Pair
from study.quality import Quality, measure_quality
from study.registration import Registration
from study.types import Floats


@dataclass(frozen=True)
class Judgement:
    """A registration against what is known of its pair (sec. IV).

    Attributes:
        pair: the clouds, their waypoints, and the truth where it is known.
        registration: what a method made of it.
        radius_mm: sphere of the path transfer (sec. III-D).
    """

    pair: Pair
    registration: Registration
    radius_mm: float = 20.0

    @cached_property
    def surface(self) -> CloudDistances:
        """From the warped CT cloud to the US cloud and back."""
        return CloudDistances.between(self.registration.warped, self.pair.alignment.target.cloud.points)

    @cached_property
    def moved(self) -> Floats:
        """The CT's waypoints (k, 3) mm, carried into the US frame (sec. III-D).

        Raises:
            StudyError: a waypoint with too few points around it.
        """
        return self.registration.transfer(self.pair.waypoints_ct, self.radius_mm)

    @property
    def normal(self) -> Floats:
        """(3,) normal of the patient's feature plane, US frame."""
        return self.pair.alignment.target.T_cloud_chest.rotation[:, 2]

    @cached_property
    def quality(self) -> Quality:
        """What the registration says about itself, without the truth."""
        return self.registration.quality or measure_quality(self.pair.alignment, self.registration.warped)

    def protocol_errors_mm(self, *, in_plane: bool = False) -> Floats:
        """Distance (k,) of the carried waypoints from those the protocol defines on the US cloud (sec. IV-B)."""
        return waypoint_errors_mm(self.moved, self.pair.waypoints_us, self.normal if in_plane else None)

    def true_waypoint_errors_mm(self, *, in_plane: bool = False) -> Floats:
        """Distance (k,) of the carried waypoints from where they truly belong.

        Raises:
            StudyError: nothing is known of the pair's truth.
        """
        goal = _known(self.pair, self.pair.true_waypoints)
        return waypoint_errors_mm(self.moved, goal, self.normal if in_plane else None)

    @cached_property
    def true_point_errors_mm(self) -> Floats:
        """Distance (n,) of every warped point from its true place.

        Raises:
            StudyError: nothing is known of the pair's truth.
        """
        return point_errors_mm(self.registration.warped, _known(self.pair, self.pair.true_points))


def _known(pair: Pair, places: Floats | None) -> Floats:
    if places is None:
        raise StudyError(
            f"{pair.name}: expected a pair whose deformation is known, got two real people; "
            "use the measures that need no truth"
        )
    return places
