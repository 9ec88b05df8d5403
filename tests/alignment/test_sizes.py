from dataclasses import replace

import numpy as np
import pytest

from study import phantom
from study.alignment.chest import Alignment, find_chest
from study.alignment.sizes import LIMITS, PAIR_LIMITS, chest_sizes, size_warnings
from study.errors import StudyError
from study.types import PointCloud


@pytest.fixture(scope="module")
def chests(ct_clouds, us_cloud):
    return {name: find_chest(PointCloud(ct_clouds[name].points, name)) for name in ("ct1", "ct2", "patient")}


def squeezed(chest, factors):
    """The same parts at other sizes, in chest coordinates."""
    T = chest.T_cloud_chest
    points = T.apply(T.inverse.apply(chest.cloud.points) * factors)
    return replace(chest, cloud=replace(chest.cloud, points=points))


def test_sizes_are_those_of_the_person(chests):
    sizes = chest_sizes(chests["ct1"])
    assert set(sizes) == set(LIMITS)
    known = phantom.measures(phantom.draw_subject("ct1", 0))
    assert sizes["width"] == pytest.approx(known["sternum_width_mm"], abs=6.0)
    for name, value in chest_sizes(squeezed(chests["ct1"], [1.3, 1.1, 1.0])).items():
        factor = {"span": 1.1, "reach": 1.3, "width": 1.3, "above": 1.1}.get(name, 1.0)
        assert value == pytest.approx(factor * sizes[name], abs=0.6 if name == "above" else 0.02), name


def test_people_are_not_suspect_to_each_other(chests):
    assert size_warnings(Alignment(chests["ct1"], chests["patient"])) == ()
    assert size_warnings(Alignment(chests["patient"], chests["ct2"])) == ()


@pytest.mark.parametrize(("factors", "told"), [([1.8, 1, 1], "reach"), ([1, 0.45, 1], "span"), ([1, 2.2, 1], "span")])
def test_what_no_chest_measures_is_refused_and_the_crop_named(chests, factors, told):
    odd = squeezed(chests["patient"], factors)
    with pytest.raises(StudyError, match=rf"patient: expected a (mean )?{told} .* got .* mm; crop to the sternum"):
        size_warnings(Alignment(chests["ct1"], odd))


def test_a_little_outside_is_a_warning(chests):
    limit = LIMITS["reach"]
    reach = chest_sizes(chests["ct1"])["reach"]
    odd = squeezed(chests["ct1"], [(limit.high + 2.0) / reach, 1, 1])
    told = size_warnings(Alignment(odd, odd))
    assert sum("ct1: expected a mean reach" in one for one in told) == 2  # as CT and as US


def test_two_chests_that_are_not_of_one_scale_are_suspect(chests):
    small, large = (squeezed(chests["ct1"], [f, f, f]) for f in (0.85, 1.25))
    assert any("ct1 over ct1" in one for one in size_warnings(Alignment(small, large)))
    assert PAIR_LIMITS["size"].high < np.log(1.25 / 0.85)


def test_a_cartilage_covered_by_half_is_named(chests):
    chest = chests["ct1"]
    local = chest.T_cloud_chest.inverse.apply(chest.cloud.points)
    parts = chest.cloud.parts
    fifth = parts == parts.max()  # the left 5th
    seen = ~(fifth & (np.abs(local[:, 0]) > 45))
    half = replace(chest, cloud=replace(chest.cloud, points=chest.cloud.points[seen], parts=parts[seen]))
    told = size_warnings(Alignment(chest, half))
    assert any("expected the whole of left_5" in one for one in told)
