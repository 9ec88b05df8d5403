"""The proposed method: dense skeleton graph (sec. III-B, III-C)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from study.alignment.frame import chest_frame
from study.errors import StudyError
from study.registration import Registration
from study.skeleton.graph import SkeletonGraph
from study.skeleton.som import MAX_FALL, SomParams, fit_som, late_fall
from study.skeleton.template import template_graph
from study.skeleton.warp import BlendWeights, Neighbours, blend, local_transforms
from study.types import PointCloud, RigidTransform


@dataclass(frozen=True, kw_only=True)
class SkeletonRegistration(Registration):
    """A registration that keeps its graphs.

    Attributes:
        template: the graph before the maps, drawn in the chest frame of the aligned CT cloud.
        g_ct: the graph on the CT cloud, in the US frame after coarse alignment.
        g_us: the same graph on the US cloud; node i belongs to node i of ``g_ct``.
    """

    template: SkeletonGraph
    g_ct: SkeletonGraph
    g_us: SkeletonGraph


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

    def __post_init__(self) -> None:
        least = {"nodes": 3, "hops": 1}  # three nodes fix a rotation, and one hop reaches that many
        if self.neighbours not in least:
            raise StudyError(
                f"skeleton_graph: expected neighbours nodes|hops, got {self.neighbours!r}; the paper counts nodes"
            )
        if not self.n_reg >= least[self.neighbours]:
            raise StudyError(
                f"skeleton_graph: expected n_reg >= {least[self.neighbours]} {self.neighbours}, got {self.n_reg}; "
                "fewer fix no rotation"
            )
        if not self.blend_k >= 1:
            raise StudyError(f"skeleton_graph: expected blend_k >= 1, got {self.blend_k}; 1 follows the nearest node")
        if self.blend_weights not in ("distance", "inverse_distance"):
            raise StudyError(
                f"skeleton_graph: expected blend_weights distance|inverse_distance, got {self.blend_weights!r}; "
                "Eq. 4 prints the former"
            )

    @classmethod
    def as_authors(cls) -> SkeletonGraphMethod:
        """Every choice of the authors' public code at once; the paper is silent on most, DEVIATIONS.md lists them all.

        Rate and radius compound; the CT map takes 5,000 epochs of 500 points, the US map 3,000 of 130, none of them on
        the directed graph; a local transform is of all nodes within 3 hops.
        """
        ct_som = SomParams(epochs=5000, samples=500, rate_schedule="compounding", radius_schedule="compounding")
        us_som = replace(ct_som, epochs=3000, samples=130, pretrain_epochs=0)
        return cls(ct_som, us_som, n_reg=3, neighbours="hops")

    @classmethod
    def tuned(cls) -> SkeletonGraphMethod:
        """The best row of ``results/tuning/skeleton_graph.csv``: the visible surface of development subjects."""
        som = SomParams(rate_schedule="linear", winners="own_part")
        return cls(som, som, n_reg=2, neighbours="hops", blend_weights="inverse_distance")

    @classmethod
    def tuned_whole(cls) -> SkeletonGraphMethod:
        """The best row of ``results/tuning/skeleton_graph_whole.csv``: the whole tube of the same subjects."""
        return replace(cls.tuned(), n_reg=1)

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> SkeletonRegistration:
        """Register labelled, coarsely aligned clouds.

        ``history`` is the quantisation error of the CT map, then of the US map, mm; converged means that neither fell
        any more when its schedule ended (`study.skeleton.som.late_fall`).

        Raises:
            StudyError: a part of the source is missing.
        """
        template = template_graph(chest_frame(source))
        g_ct, ct_history = fit_som(template, source, self.ct_som, rng)
        g_us, us_history = fit_som(g_ct, target, self.us_som, rng)
        hops = g_ct.hops(directed=False)
        rotations, translations = local_transforms(g_ct.nodes, g_us.nodes, hops, self.n_reg, self.neighbours)
        falls = late_fall(ct_history), late_fall(us_history)
        return SkeletonRegistration(
            source=source.points,
            warped=blend(source.points, g_ct.nodes, rotations, translations, self.blend_k, self.blend_weights),
            T_us_ct=RigidTransform(),
            converged=max(falls) < MAX_FALL,
            n_iterations=self.ct_som.epochs + self.us_som.epochs,
            stop_reason="schedules done; at their ends the maps' errors fell by {:.1%} and {:.1%}".format(*falls),
            history=(*ct_history, *us_history),
            template=template,
            g_ct=g_ct,
            g_us=g_us,
        )
