"""People between two people: the ends are the two, the way back is exact, and nothing folds beyond the second."""

import numpy as np
import pytest

from study import phantom
from study.errors import StudyError
from study.evaluation.disturbances import SEEDS
from study.geometry.points import fit_rigid
from study.phantom.between import between
from study.phantom.surface import canonical_surface

START, END = phantom.draw_subject("ct1", 521), phantom.draw_subject("patient", 521)
PLACES = np.random.default_rng(0).uniform([-80, -6, -100], [80, 6, 5], (300, 3))


def test_the_ends_are_the_two_people() -> None:
    np.testing.assert_allclose(between(START, END, 0).phi.apply(PLACES), START.phi.apply(PLACES), atol=1e-9)
    there, end = between(START, END, 1).phi.apply(PLACES), END.phi.apply(PLACES)
    T = fit_rigid(end, there)
    np.testing.assert_allclose(T.apply(end), there, atol=1e-6)
    assert phantom.residual_mm(START.phi.apply(PLACES), there) > 2  # they do differ


def test_half_the_way_is_half_the_difference_and_keeps_the_others_tissue() -> None:
    half, whole = (between(START, END, share) for share in (0.5, 1.0))
    middle = (START.phi.apply(PLACES) + whole.phi.apply(PLACES)) / 2
    np.testing.assert_allclose(half.phi.apply(PLACES), middle, atol=1e-9)
    assert (half.name, half.fat_mm) == (END.name, END.fat_mm)


def test_the_way_back_is_exact() -> None:
    for share in (0.5, 1.5):
        phi = between(START, END, share).phi
        np.testing.assert_allclose(phi.inverse(phi.apply(PLACES)), PLACES, atol=1e-6)


def test_nothing_folds_at_the_largest_size_that_is_tried() -> None:
    vertices = canonical_surface().vertices[::40]
    for seed in SEEDS:
        people = (phantom.draw_subject(name, seed) for name in ("ct1", "patient"))
        assert between(*people, 1.5).phi.jacobian_determinant(vertices).min() > 0, seed


@pytest.mark.parametrize("share", [-0.1, np.inf, np.nan])
def test_a_share_that_is_none_is_refused(share: float) -> None:
    with pytest.raises(StudyError, match="share of 0 or more"):
        between(START, END, share)
