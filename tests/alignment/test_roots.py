"""Eight pieces are eight cartilages only where they leave the sternum in pairs, apart from each other."""

from dataclasses import replace

import numpy as np
import pytest

from study.alignment.chest import find_chest
from study.alignment.roots import MAX_TOUCH, check_roots, measure_roots
from study.errors import StudyError
from study.types import Part, PointCloud


def test_branches_that_face_gaps_are_refused(ct_clouds):
    cloud = ct_clouds["ct4"]
    torn = PointCloud(cloud.points[cloud.parts != Part.RIGHT_5], "torn")
    with pytest.raises(
        StudyError, match=r"four cartilages a side that leave the sternum in pairs.* mm; crop to .* is a branch"
    ):
        find_chest(torn)


def test_two_halves_of_one_cartilage_are_not_two(ct_clouds):
    """Eight labels in the right places are not eight cartilages where two of them share one."""
    chest = find_chest(PointCloud(ct_clouds["ct4"].points, "ct4"))
    branches, local = chest.search.branches, chest.search.local
    whole = measure_roots(branches, local)
    assert whole == chest.search.roots
    assert whole.touch < MAX_TOUCH / 2
    # The upper half of one branch goes to the next one above it.
    split = branches.branch.copy()
    mine = split == 6
    split[mine & (local[:, 1] > np.median(local[mine, 1]))] = 7
    halves = measure_roots(replace(branches, branch=split), local)
    assert halves.touch > MAX_TOUCH
    with pytest.raises(StudyError, match=r"split: expected cartilages apart from each other .* is a branch missing"):
        check_roots(halves, "split")
