"""What a registration says about itself: measures that need no truth, and what they warn of (sec. IV's missing half).

The Hausdorff distance between two clouds stays small when whole branches are swapped or the cloud is torn to stripes.
These measures do not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from scipy.spatial import KDTree

from study.alignment.chest import Alignment
from study.geometry.points import nearest
from study.types import Floats, Part

FAR_MM = 5.0  # from the warped cloud: a US point that nothing was carried to
LINKS = 6  # neighbours of a point whose distances are compared
MOST_STRETCH = 2.0  # of a link, or its inverse
AROUND = 12  # neighbours of the local affine fit


@dataclass(frozen=True)
class Quality:
    """Measures of one registration, shares 0-1.

    Attributes:
        residual_share: US points farther than 5 mm from the warped CT cloud.
        wrong_part_share: warped points of the cartilages whose nearest US point is on another cartilage.
        further_motion_mm: mean distance that the method moved points after the coarse alignment.
        stretched_share: links between neighbours that became more than twice or less than half as long.
        folded_share: points around which the view from the front was turned over: the determinant of the local affine
            fit in the feature plane, the planar part of the warp's Jacobian, is 0 or less.
    """

    residual_share: float
    wrong_part_share: float
    further_motion_mm: float
    stretched_share: float
    folded_share: float


# Share or mm from which on an answer is suspect, and what then. They stand between right and wrong answers on
# development people; benchmarks/hostile.py prints both rates.
QUALITY_LIMITS: Mapping[str, tuple[float, str]] = MappingProxyType(
    {
        "residual_share": (0.15, "of the US points lie over 5 mm from the warped CT cloud: the clouds do not match"),
        "wrong_part_share": (0.1, "of the warped cartilages lie on another than their own: branches are swapped"),
        "further_motion_mm": (18.0, "mm is how far points moved after the coarse alignment: more than people differ"),
        "stretched_share": (0.4, "of neighbouring points are more than twice or less than half as far apart: torn"),
        "folded_share": (0.35, "of the cloud is folded over as seen from the front"),
    }
)
SWAPPED = "wrong_part_share"


def quality_warnings(quality: Quality) -> tuple[str, ...]:
    """A sentence for each measure beyond its limit, by name."""
    told = []
    for name, (limit, meaning) in QUALITY_LIMITS.items():
        value = getattr(quality, name)
        if value > limit:
            told.append(f"{name}: {value:.3g} {meaning} (expected {limit:g} or less)")
    return tuple(told)


def measure_quality(alignment: Alignment, warped: Floats) -> Quality:
    """Measure a warp of the CT cloud onto the US cloud.

    Args:
        alignment: the two labelled clouds and where the method started.
        warped: (n, 3) mm, row i is CT point i in the US frame.
    """
    source, target = alignment.source.cloud, alignment.target.cloud
    residual, _ = nearest(target.points, warped)
    _, partner = nearest(warped, target.points)
    own, other = source.parts, target.parts
    assert own is not None  # a chest is labelled
    assert other is not None
    both = (own > Part.STERNUM) & (other[partner] > Part.STERNUM)
    start = alignment.T_us_ct.apply(source.points)
    _, links = KDTree(source.points).query(source.points, k=AROUND + 1)
    return Quality(
        residual_share=float((residual > FAR_MM).mean()),
        wrong_part_share=float((own != other[partner])[both].mean()) if both.any() else 0.0,
        further_motion_mm=float(np.linalg.norm(warped - start, axis=1).mean()),
        stretched_share=_stretched_share(source.points, warped, links[:, 1 : LINKS + 1]),
        folded_share=_folded_share(
            alignment.source.T_cloud_chest.inverse.apply(source.points)[:, :2],
            alignment.target.T_cloud_chest.inverse.apply(warped)[:, :2],
            links[:, 1:],
        ),
    )


def _stretched_share(source: Floats, warped: Floats, links: Floats) -> float:
    before, after = (np.linalg.norm(points[links] - points[:, None], axis=2) for points in (source, warped))
    ratio = after / np.maximum(before, 1e-9)
    return float(((ratio > MOST_STRETCH) | (ratio < 1 / MOST_STRETCH)).mean())


def _folded_share(before: Floats, after: Floats, links: Floats) -> float:
    """Share of points (n, 2) whose local affine fit, before to after, turns the plane over."""
    x, y = (points[links] - points[links].mean(axis=1, keepdims=True) for points in (before, after))
    # The fit is B A⁻¹ with A = Σ x xᵀ > 0 and B = Σ y xᵀ: its determinant has the sign of det B.
    determinant = np.linalg.det(np.einsum("nki,nkj->nij", y, x))
    return float((determinant <= 0).mean())
