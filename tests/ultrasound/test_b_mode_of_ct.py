"""The picture for the eye: bone shadows, cartilage lets the pleura shine, and the frame lies where the probe is."""

from __future__ import annotations

import numpy as np

from study.types import RigidTransform, Volume
from study.ultrasound import b_mode_like, ct_frame

PIXEL_MM = 0.4
SHAPE = (88, 60)


def chest_wall(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Fat, muscle, a band 8 mm thick from 12 mm on, muscle, and lung from 26 mm on."""
    depth = np.arange(SHAPE[0])[:, None] * PIXEL_MM * np.ones(SHAPE[1])
    band = (depth > 12) & (depth < 20)
    hu = np.where(depth < 6, -100.0, 55.0)
    hu = np.where(band, 700.0 if kind == "bone" else 95.0, hu)
    hu = np.where(depth > 26, -850.0, hu)
    return hu, band & (kind == "cartilage")


def test_bone_hides_the_pleura_and_cartilage_does_not() -> None:
    depths = {"band": (14, 18), "line": (24, 28), "muscle": (7, 11)}
    rows = {name: slice(int(a / PIXEL_MM), int(b / PIXEL_MM)) for name, (a, b) in depths.items()}
    seen = {kind: b_mode_like(*chest_wall(kind), PIXEL_MM, np.random.default_rng(0)) for kind in ("bone", "cartilage")}
    for picture in seen.values():
        assert picture.shape == SHAPE
        assert 0 <= picture.min() < picture.max() <= 1
    assert seen["cartilage"][rows["line"]].max(axis=0).mean() > 0.6
    assert seen["bone"][rows["line"]].max() < 0.3
    assert seen["cartilage"][rows["band"]].mean() < seen["cartilage"][rows["muscle"]].mean() - 0.1


def test_the_same_rng_gives_the_same_picture() -> None:
    one, other = (b_mode_like(*chest_wall("bone"), PIXEL_MM, np.random.default_rng(1)) for _ in range(2))
    assert (one == other).all()


def test_a_frame_of_a_ct_is_what_lies_in_its_plane() -> None:
    ramp = np.broadcast_to(np.arange(20.0)[:, None, None], (20, 12, 8)).copy()
    volume = Volume(ramp, np.array([2.0, 1.0, 1.0]))
    T_ras_image = RigidTransform(np.eye(3), np.array([4.0, 1.0, 3.0]))  # x of the image is R
    found = ct_frame(volume, T_ras_image, (4, 5), 2.0)
    np.testing.assert_allclose(found, np.broadcast_to(2.0 + np.arange(5), (4, 5)))
