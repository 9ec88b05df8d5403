"""The paper's idea with its weak steps mended: the same graph and the same two maps, and a field from its nodes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from study.alignment.frame import chest_frame
from study.methods.skeleton_graph import SkeletonRegistration
from study.registration import FieldRegistration
from study.skeleton.batch_som import BatchSomParams, fit_batch_som
from study.skeleton.spline import NodeSpline
from study.skeleton.template import template_graph
from study.types import PointCloud, RigidTransform


@dataclass(frozen=True, kw_only=True)
class RepairedRegistration(SkeletonRegistration, FieldRegistration):
    """A registration that keeps its graphs and the field drawn through their nodes."""


@dataclass(frozen=True)
class SkeletonGraphRepaired:
    """Directed by parts, in millimetres along the graph, smooth between the nodes.

    What differs from `SkeletonGraphMethod`: a point is won by nodes of its own part only; all points at a time, not
    drawn ones (`study.skeleton.batch_som`), with a neighbourhood along the graph in mm or, which is better on
    development people, in hops as the paper's; a smooth field in place of local rigid motions that tear between three
    nodes, and waypoints carried by it. The field also smooths the second map while it runs: nodes slide along a
    cartilage together or not at all.

    Attributes:
        ct_som: schedule of the map from the template to the CT cloud.
        us_som: schedule of the map from the CT graph to the US cloud.
        spline: the field from the nodes' displacements.
        smooth_every_epoch: the field holds the second map together; otherwise it is drawn at its end only.
    """

    name: ClassVar[str] = "skeleton_graph_repaired"

    ct_som: BatchSomParams = field(default_factory=BatchSomParams)
    us_som: BatchSomParams = field(default_factory=BatchSomParams)
    spline: NodeSpline = field(default_factory=NodeSpline)
    smooth_every_epoch: bool = True

    @classmethod
    def tuned(cls) -> SkeletonGraphRepaired:
        """The best row of ``results/tuning/skeleton_graph_repaired.csv``, whose neighbours are hops, as the paper's."""
        som = BatchSomParams(lengths="hops")
        return cls(som, som)

    def register(self, source: PointCloud, target: PointCloud, rng: np.random.Generator) -> RepairedRegistration:
        """Register labelled, coarsely aligned clouds; nothing is drawn from ``rng``.

        ``history`` is the mean distance from the points to their winners in the CT map, then in the US map, mm;
        converged means that the nodes of both came to rest.

        Raises:
            StudyError: a part of the source is missing, a target without labels.
        """
        template = template_graph(chest_frame(source))
        ct_map = fit_batch_som(template, source, self.ct_som)
        g_ct = template.with_nodes(ct_map.nodes)
        smoother = self.spline.smoother(g_ct.nodes) if self.smooth_every_epoch else None
        us_map = fit_batch_som(g_ct, target, self.us_som, smoother)
        displaced = self.spline.field(g_ct.nodes, us_map.nodes)
        n_iterations = len(ct_map.history) + len(us_map.history)
        return RepairedRegistration(
            source=source.points,
            warped=displaced.apply(source.points),
            T_us_ct=RigidTransform(),
            converged=ct_map.moved_mm <= self.ct_som.at_rest_mm and us_map.moved_mm <= self.us_som.at_rest_mm,
            n_iterations=n_iterations,
            stop_reason=f"nodes moved {ct_map.moved_mm:.2g} and {us_map.moved_mm:.2g} mm in the maps' last epochs",
            history=(*ct_map.history, *us_map.history),
            template=template,
            g_ct=g_ct,
            g_us=g_ct.with_nodes(displaced.apply(g_ct.nodes)),
            field=displaced,
        )
