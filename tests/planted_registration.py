"""Registrations whose answer is known everywhere, without running a method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from study.registration import FieldRegistration, Registration
from study.types import Floats, RigidTransform

SOURCE = np.random.default_rng(5).uniform([-70, 140, 1120], [110, 160, 1280], size=(3000, 3))
T_US_CT = RigidTransform.random(np.random.default_rng(1))


@dataclass(frozen=True)
class Bend:
    """A smooth bend of up to 6 mm, after the rigid part."""

    T: RigidTransform

    def apply(self, points: Floats) -> Floats:
        x, _, z = self.T.inverse.apply(points).T
        bend = np.column_stack([3 * np.sin(z / 60), 6 * np.cos(x / 70), 2 * np.sin(x / 80)])
        return points + bend @ self.T.rotation.T


def planted(*, field: bool = True) -> Registration:
    """The bend of ``SOURCE``, as a method with a field returns it, or as one without."""
    bend = Bend(T_US_CT)
    warped = bend.apply(T_US_CT.apply(SOURCE))
    about = {"method": "planted", "front": T_US_CT.rotation[:, 1], "parts": np.arange(len(SOURCE)) % 9}
    about["target"] = warped + 0.5 * T_US_CT.rotation[:, 1]
    if field:
        return FieldRegistration(SOURCE, warped, T_US_CT, True, 1, "planted", **about, field=bend)
    return Registration(SOURCE, warped, T_US_CT, True, 1, "planted", **about)
