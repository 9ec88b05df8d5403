"""One pair of the phantom whose deformation is known, small and aligned once."""

from dataclasses import replace

import numpy as np
import pytest

from study import phantom
from study.evaluation.pair import Pair, align_pair
from study.registration import Registration
from study.types import PointCloud, RigidTransform

T_US_RAS = RigidTransform.random(np.random.default_rng(11))


@pytest.fixture(scope="session")
def T_us_ras() -> RigidTransform:
    """RAS+ to the patient's tracker."""
    return T_US_RAS


@pytest.fixture(scope="session")
def real_pair(ct_clouds: dict[str, PointCloud], us_cloud: PointCloud) -> Pair:
    """ct1 and the patient in a tracker's frame, as if they were two real people."""
    labelled = us_cloud.moved(T_US_RAS)
    waypoints = phantom.waypoints(phantom.draw_subject("ct1", 0)).points
    bare = replace(labelled, parts=None)
    return align_pair(ct_clouds["ct1"], bare, waypoints, labelled, names=("ct1", "patient"))


@pytest.fixture(scope="session")
def pair(real_pair: Pair) -> Pair:
    """The same with what is known of the answer."""
    people = [phantom.draw_subject(name, 0) for name in ("ct1", "patient")]
    points, waypoints = (
        T_US_RAS.apply(phantom.truth_map(*people, places))
        for places in (real_pair.alignment.source.cloud.points, real_pair.waypoints_ct)
    )
    # The cloud has noise but no calibration: as the registered frame of a sweep with no constant error is.
    return replace(real_pair, true_points=points, true_waypoints=waypoints, shift_mm=np.zeros(3))


@pytest.fixture(scope="session")
def registration(pair: Pair) -> Registration:
    """The truth, off by some millimetres that differ from place to place."""
    source, T_us_ct = pair.alignment.source.cloud.points, pair.alignment.T_us_ct
    off = 3.0 * np.sin(source / 40.0) + np.random.default_rng(5).normal(size=source.shape)
    return Registration(source, pair.true_points + off, T_us_ct, True, 1, "planted")
