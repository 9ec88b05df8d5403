"""How far two segmentations of one CT agree: Dice, and the distance between their surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from study.ct.parts import on_grid
from study.ct.surface import surface
from study.geometry.rays import surface_distance_mm
from study.types import Floats, Part, Volume


@dataclass(frozen=True)
class Agreement:
    """Two segmentations of sternum and cartilages, all nine parts as one.

    Attributes:
        dice: twice the voxels they share over the voxels of both, 0-1.
        distances_mm: (n,) mm, from each vertex of either surface to the other surface.
        places: (n, 3) mm, RAS+, those vertices.
    """

    dice: float
    distances_mm: Floats
    places: Floats

    @property
    def worst_place(self) -> Floats:
        """(3,) mm, where the surfaces lie furthest apart."""
        place: Floats = self.places[self.distances_mm.argmax()]
        return place


def compare_parts(found: Volume, reference: Volume, like: Volume) -> Agreement:
    """Lay two segmentations over each other.

    Args:
        found: `Part` values, on any grid with the axes of ``like``.
        reference: the same.
        like: on whose voxels they are counted; mostly the CT.

    Raises:
        StudyError: axes that are not parallel, or no surface.
    """
    one, other = (on_grid(mask, like).values != Part.UNKNOWN for mask in (found, reference))
    ours, theirs = surface(found), surface(reference)
    return Agreement(
        dice=float(2 * (one & other).sum() / (one.sum() + other.sum())),
        distances_mm=np.concatenate(
            [surface_distance_mm(ours.vertices, theirs), surface_distance_mm(theirs.vertices, ours)]
        ),
        places=np.concatenate([ours.vertices, theirs.vertices]),
    )
