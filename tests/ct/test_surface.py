"""The surface of a mask and the cloud on it, on a ball."""

from __future__ import annotations

import hashlib
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial import KDTree

from study.ct.surface import points_for_spacing, sample_cloud, surface
from study.errors import StudyError
from study.types import Mesh, RigidTransform, Volume


def ball(radius: float = 20.0) -> Volume:
    """A ball off the origin, on a turned, anisotropic grid; its right half is called RIGHT_2."""
    frame = RigidTransform.random(np.random.default_rng(5), shift_mm=20.0)
    shape = (70, 70, 26)
    grid = np.moveaxis(np.indices(shape), 0, -1) * (0.7, 0.8, 2.5) - (24.0, 28.0, 32.0)
    values = np.where(np.linalg.norm(grid, axis=-1) < radius, np.where(grid[..., 0] > 0, 1, 0), -1).astype(np.int8)
    return Volume(values, np.array([0.7, 0.8, 2.5]), frame, "ball")


def volume_mm3(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_surface_is_closed_faces_outwards_and_keeps_size_and_place() -> None:
    volume = ball()
    mesh = surface(volume)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}
    assert volume_mm3(mesh) == pytest.approx(4 / 3 * np.pi * 20.0**3, rel=0.03)  # positive: normals point outwards
    centre = volume.T_ras_index.apply(np.array([24.0, 28.0, 32.0]))
    radii = np.linalg.norm(mesh.vertices - centre, axis=1)
    assert abs(radii - 20.0).max() < 1.3  # half of the thickest slice
    side = (mesh.vertices - centre) @ volume.T_ras_index.rotation[:, 0]
    assert (mesh.parts[side > 1] == 1).all()
    assert (mesh.parts[side < -1] == 0).all()
    with pytest.raises(StudyError, match="empty mask"):
        surface(volume.with_values(np.full(volume.shape, -1, np.int8)))


def test_cloud_is_even_labelled_and_repeatable() -> None:
    mesh = surface(ball())
    n = points_for_spacing(mesh, 3.0)
    cloud = sample_cloud(mesh, n, np.random.default_rng(1))
    assert len(cloud) == n
    gaps = KDTree(cloud.points).query(cloud.points, k=2)[0][:, 1]
    assert gaps.min() > 1.5
    assert gaps.mean() == pytest.approx(3.0, rel=0.05)
    _, index = KDTree(mesh.vertices).query(cloud.points)
    assert (cloud.parts == mesh.parts[index]).all()
    again = sample_cloud(mesh, n, np.random.default_rng(1))
    other = sample_cloud(mesh, n, np.random.default_rng(2))
    assert (again.points == cloud.points).all()
    assert not (other.points == cloud.points).all()
    with pytest.raises(StudyError, match="at least 50"):
        sample_cloud(mesh, 10, np.random.default_rng(1))
    with pytest.raises(StudyError, match="positive spacing"):
        points_for_spacing(mesh, 0.0)


PROGRAM = """
import hashlib, numpy as np
from study.ct import sample_cloud
from study.types import Mesh
corners = np.array([[0, 0, 0], [60, 0, 0], [0, 60, 0], [0, 0, 60]], float)
faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
cloud = sample_cloud(Mesh(corners, faces, np.zeros(4)), 200, np.random.default_rng(7))
print(hashlib.sha256(cloud.points.tobytes()).hexdigest())
"""


def test_cloud_is_the_same_in_another_process() -> None:
    runs = [
        subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, encoding="utf-8", check=True).stdout
        for _ in range(2)
    ]
    assert runs[0] == runs[1]
    assert len(runs[0].strip()) == hashlib.sha256().digest_size * 2
