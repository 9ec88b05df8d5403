"""A smooth displacement of space from those of the nodes, in place of local rigid fits (sec. III-C)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import RBFInterpolator

from study.errors import StudyError
from study.types import Floats

Kernel = Literal["thin_plate_spline", "linear"]


@dataclass(frozen=True)
class NodeSpline:
    """A spline that may miss the nodes' displacements where that makes it smoother; affine motions cost nothing.

    Attributes:
        kernel: scipy's name of the radial function; neither has a length, which one phantom would have to tell.
        smoothing: weight of its bending against the squared misses; 0 meets every node. It has the unit of the kernel,
            mm² or mm.
    """

    kernel: Kernel = "thin_plate_spline"
    smoothing: float = 3000.0

    def __post_init__(self) -> None:
        if self.kernel not in ("thin_plate_spline", "linear"):
            raise StudyError(f"spline: expected kernel thin_plate_spline|linear, got {self.kernel!r}; see NodeSpline")
        if not 0 <= self.smoothing < np.inf:
            raise StudyError(f"spline: expected smoothing >= 0, got {self.smoothing}; 0 meets every node")

    def field(self, nodes: Floats, moved: Floats) -> NodeField:
        """The field that takes nodes (m, 3) mm near to where they ``moved`` (m, 3) mm."""
        return NodeField(self._through(nodes, moved - nodes))

    def smoother(self, nodes: Floats) -> Floats:
        """(m, m): the field's displacements at the nodes (m, 3) mm are this times the given ones."""
        smooth: Floats = self._through(nodes, np.eye(len(nodes)))(nodes)
        return smooth

    def _through(self, nodes: Floats, values: Floats) -> RBFInterpolator:
        return RBFInterpolator(nodes, values, kernel=self.kernel, smoothing=self.smoothing, degree=1)


@dataclass(frozen=True)
class NodeField:
    """A `study.registration.Field`.

    Attributes:
        displacement: (k, 3) mm at places (k, 3) mm.
    """

    displacement: RBFInterpolator

    def apply(self, points: Floats) -> Floats:
        """Where points (k, 3) mm come to lie."""
        moved: Floats = points + self.displacement(points)
        return moved
