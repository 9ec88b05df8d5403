from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from study.alignment.chest import Alignment, align
from study.errors import StudyError
from study.methods import METHODS
from study.pipeline import register_aligned
from study.quality import QUALITY_LIMITS, Quality, measure_quality, quality_warnings
from study.registration import Registration
from study.types import Part, PointCloud, RigidTransform

GOOD = Quality(0.01, 0.0, 8.0, 0.1, 0.02)


@pytest.fixture(scope="module")
def itself(ct_clouds) -> Alignment:
    """A chest and its moved copy."""
    points = ct_clouds["ct2"].points
    T = RigidTransform.random(np.random.default_rng(3))
    return align(PointCloud(points, "ct"), PointCloud(T.apply(points), "us"))


def right_answer(alignment: Alignment) -> np.ndarray:
    return alignment.target.cloud.points


def test_the_right_answer_has_nothing_to_say_of_itself(itself):
    quality = measure_quality(itself, right_answer(itself))
    assert quality == Quality(0.0, 0.0, pytest.approx(0.0, abs=1e-6), 0.0, 0.0)
    assert quality_warnings(quality) == ()
    with pytest.raises(FrozenInstanceError):
        quality.residual_share = 0.0


def test_a_swapped_branch_lies_on_another_part(itself):
    """The right 3rd and 4th change places: surfaces still match, parts do not."""
    warped, parts = np.array(right_answer(itself)), itself.source.cloud.parts
    third, fourth = (np.flatnonzero(parts == part) for part in (Part.RIGHT_3, Part.RIGHT_4))
    n = min(len(third), len(fourth))
    warped[third[:n]], warped[fourth[:n]] = warped[fourth[:n]], warped[third[:n]]
    quality = measure_quality(itself, warped)
    assert quality.wrong_part_share == pytest.approx(2 * n / (parts > 0).sum(), rel=0.02)
    assert next(one.split(":")[0] for one in quality_warnings(quality)) == "wrong_part_share"


def test_what_nothing_was_carried_to_is_residual(itself):
    parts = itself.source.cloud.parts
    warped = np.array(right_answer(itself))
    warped[parts == Part.LEFT_5] = warped[parts == Part.STERNUM][0]
    quality = measure_quality(itself, warped)
    assert quality.residual_share == pytest.approx((parts == Part.LEFT_5).mean(), abs=0.04)
    assert quality.residual_share > 0.05


def test_a_fold_and_a_stretch_are_seen(itself):
    T = itself.target.T_cloud_chest
    local = T.inverse.apply(right_answer(itself))
    folded = T.apply(local * np.where(local[:, [0]] > 0, -1.0, 1.0) ** np.array([1, 0, 0]))
    assert measure_quality(itself, folded).folded_share == pytest.approx(0.5, abs=0.1)
    assert measure_quality(itself, T.apply(local * 2.5)).stretched_share == pytest.approx(1.0)
    assert measure_quality(itself, T.apply(local * 1.5)).stretched_share == 0.0


def test_motion_is_counted_from_the_coarse_alignment(itself):
    up = itself.target.T_cloud_chest.rotation[:, 1]
    assert measure_quality(itself, right_answer(itself) + 7 * up).further_motion_mm == pytest.approx(7.0, abs=1e-6)


@pytest.mark.parametrize("name", QUALITY_LIMITS)
def test_each_measure_warns_by_name_beyond_its_limit(name):
    limit, _ = QUALITY_LIMITS[name]
    assert quality_warnings(replace(GOOD, **{name: limit})) == ()
    (sentence,) = quality_warnings(replace(GOOD, **{name: 1.5 * limit}))
    assert sentence.startswith(f"{name}: {1.5 * limit:.3g}")
    assert f"expected {limit:g} or less" in sentence


def test_swapped_branches_are_no_convergence(itself, monkeypatch):
    class Swapping:
        name = "swapping"

        def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
            shift = np.where(source.parts == Part.RIGHT_3, -25.0, 0.0)[:, None] * frame.rotation[:, 1]
            return Registration(source.points, source.points + shift, RigidTransform(), True, 1, "done")

    frame = itself.target.T_cloud_chest
    result = register_aligned(itself, Swapping(), np.random.default_rng(0))
    assert not result.converged
    assert result.warnings[0].startswith("wrong_part_share")
    assert register_aligned(itself, METHODS["coarse"], np.random.default_rng(0)).warnings == ()


def test_sizes_that_no_chest_has_are_refused_before_the_method_runs(itself):
    T = itself.target.T_cloud_chest
    wide = replace(itself.target, cloud=itself.target.cloud.moved(RigidTransform()))
    points = T.apply(T.inverse.apply(wide.cloud.points) * [2.2, 1.0, 1.0])
    stretched = replace(wide, cloud=replace(wide.cloud, points=points))
    with pytest.raises(
        StudyError, match=r"us: expected a mean reach of the cartilages .* got .* mm; crop to the sternum"
    ):
        register_aligned(Alignment(itself.source, stretched), METHODS["coarse"], np.random.default_rng(0))
