"""The proposed method: dense skeleton graph (sec. III-B, III-C)."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from study.coarse import chest_frame
from study.som import MAX_FALL, SomParams, fit_som, late_fall, quantisation_error_mm
from study.template import template_graph
from study.types import PointCloud, Registration, RigidTransform
from study.warp import BlendWeights, Neighbours, blend, local_transforms


@dataclass(frozen=True)
class SkeletonGraphMethod:
    """Directed SOM twice, local rigid transforms, weighted blend.

    Attributes:
        ct_som: schedule of the map from the template to the CT cloud.
        us_som: schedule of the map from the CT graph to the US cloud.
        n_reg: N_reg of Eq. 3.
        neighbours: what N_reg counts.
        blend_k: N of Eq. 4.
        blend_weights: weights of Eq. 4.
    """

    name: ClassVar[str] = "skeleton_graph"
    ct_som: SomParams = field(default_factory=SomParams)
    us_som: SomParams = field(default_factory=SomParams)
    n_reg: int = 3
    neighbours: Neighbours = "nodes"
    blend_k: int = 3
    blend_weights: BlendWeights = "distance"

    @classmethod
    def tuned(cls) -> SkeletonGraphMethod:
        """The best row of ``results/tuning/skeleton_graph.csv``, found on development subjects."""
        som = SomParams(rate_schedule="linear", winners="own_part")
        return cls(som, som, n_reg=2, neighbours="hops", blend_weights="inverse_distance")

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> Registration:
        """Register labelled, coarsely aligned clouds.

        ``history`` is the quantisation error of the CT map, then of the US map, mm; converged means that neither fell
        any more when its schedule ended (`study.som.late_fall`).

        Raises:
            StudyError: a part of the source is missing.
        """
        start = time.perf_counter()
        template = template_graph(chest_frame(source))
        g_ct, ct_history = fit_som(template, source, self.ct_som, rng)
        g_us, us_history = fit_som(g_ct, target, self.us_som, rng)
        hops = g_ct.hops(directed=False)
        rotations, translations = local_transforms(g_ct.nodes, g_us.nodes, hops, self.n_reg, self.neighbours)
        falls = late_fall(ct_history), late_fall(us_history)
        warped = blend(source.points, g_ct.nodes, rotations, translations, self.blend_k, self.blend_weights)
        return Registration(
            source=source.points,
            warped=warped,
            T_us_ct=RigidTransform(),
            converged=max(falls) < MAX_FALL,
            n_iterations=self.ct_som.epochs + self.us_som.epochs,
            stop_reason="schedules done; at their ends the maps' errors fell by {:.1%} and {:.1%}".format(*falls),
            history=(*ct_history, *us_history),
            seconds=time.perf_counter() - start,
            method=self.name,
            extras={"g_ct": g_ct, "g_us": g_us, "quantisation_mm": quantisation_error_mm(g_us.nodes, target.points)},
        )
