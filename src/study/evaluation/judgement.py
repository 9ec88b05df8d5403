"""One registration of one pair, with what several metrics share computed once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from study.errors import StudyError
from study.evaluation.distances import (
    CloudDistances,
    directed_distances_mm,
    point_errors_mm,
    waypoint_errors_mm,
)
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
    def visible_surface(self) -> CloudDistances:
        """From the visible part of the warped CT cloud to the US cloud and back: like for like, no truth needed.

        A CT cloud shows tubes and a sternum all round, ultrasound their fronts. The whole warped cloud can match the
        US cloud only by laying backs on fronts, and so `surface` rewards that and punishes the truth. Its visible part
        has a partner everywhere that the sweep went. Which part that is was decided on the CT (`Pair.visible`), not on
        where a method put it: a method that turns a back to the front gains nothing by it.

        Tuned methods register just that part, the others the whole; both are judged on the same points. What remains
        unlike are the strips that the sweep missed, and the rims, where two people's fronts end at different places.
        """
        forth = self.surface.forth[self.pair.visible]
        seen = self.registration.warped[self.pair.visible]
        return CloudDistances(forth, directed_distances_mm(self.pair.alignment.target.cloud.points, seen))

    @cached_property
    def moved(self) -> Floats:
        """The CT's waypoints (k, 3) mm, carried into the US frame (sec. III-D).

        Raises:
            StudyError: a waypoint with too few points around it.
        """
        return self.registration.transfer(self.pair.waypoints_ct, self.radius_mm)

    @cached_property
    def visible_moved(self) -> Floats:
        """The waypoints (k, 3) mm of the CT's visible half, carried into the US frame (sec. III-D).

        By the same sphere and the same warped cloud as `moved`, all of it: the path that the method would give.

        Raises:
            StudyError: a waypoint with too few points around it, too few visible points on a cartilage.
        """
        return self.registration.transfer(self.pair.visible_waypoints_ct, self.radius_mm)

    @property
    def normal(self) -> Floats:
        """(3,) normal of the patient's feature plane, US frame."""
        return self.pair.alignment.target.T_cloud_chest.rotation[:, 2]

    @cached_property
    def quality(self) -> Quality:
        """What the registration says about itself, without the truth."""
        return self.registration.quality or measure_quality(self.pair.alignment, self.registration.warped)

    def protocol_errors_mm(self, *, in_plane: bool = False, in_depth: bool = False) -> Floats:
        """Distance (k,) of the carried waypoints from those the protocol defines on the US cloud (sec. IV-B)."""
        return self._errors_mm(self.moved, self.pair.waypoints_us, in_plane, in_depth)

    def visible_protocol_errors_mm(self, *, in_plane: bool = False, in_depth: bool = False) -> Floats:
        """The protocol (sec. IV-B) with both clouds' waypoints cut from what a probe can see: no truth needed.

        The paper cuts the CT's waypoints from whole cartilages and the patient's from their fronts, which lie half a
        thickness apart, so that a perfect registration scores that half. Here both are cut from fronts.
        """
        return self._errors_mm(self.visible_moved, self.pair.waypoints_us, in_plane, in_depth)

    def true_waypoint_errors_mm(self, *, in_plane: bool = False, in_depth: bool = False) -> Floats:
        """Distance (k,) of the carried waypoints from where they truly belong, in the tracker's frame: end to end.

        Where the probe ends up if another frame than this probe's executes the path: the constant shift of the
        sweep's calibration and speed of sound is in it, though no method can see it.

        Raises:
            StudyError: nothing is known of the pair's truth.
        """
        return self._errors_mm(self.moved, _known(self.pair, self.pair.true_waypoints), in_plane, in_depth)

    def registered_waypoint_errors_mm(self, *, in_plane: bool = False, in_depth: bool = False) -> Floats:
        """Distance (k,) of the carried waypoints from where the sweep showed their true places: as registered.

        Where the probe ends up if the probe that swept executes the path: it shares the constant shift
        (`Pair.shift_mm`), which therefore is taken out. It is also what a method can be blamed for.

        Raises:
            StudyError: nothing is known of the pair's truth, or of its sweep's errors.
        """
        goal = _known(self.pair, self.pair.true_waypoints)
        if self.pair.shift_mm is None:
            raise StudyError(f"{self.pair.name}: expected a simulated sweep, got one whose shift nobody knows")
        return self._errors_mm(self.moved, goal + self.pair.shift_mm, in_plane, in_depth)

    def _errors_mm(self, carried: Floats, goal: Floats, in_plane: bool, in_depth: bool) -> Floats:
        """All of an error, or its part in the patient's feature plane or across it."""
        if in_plane and in_depth:
            raise StudyError("expected an error in the plane or in depth, got both; leave both out for all of it")
        return waypoint_errors_mm(carried, goal, self.normal if in_plane or in_depth else None, depth=in_depth)

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
