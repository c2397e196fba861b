"""Isosurfaces of volumes: accuracy, orientation, handedness, slabs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drivers.meshes.mesh_file import mesh_findings
from service.compute.surfaces.isosurface import surface
from service.core.errors import ComputeError
from service.core.geometry import Array, apply, transform

CENTRE = np.array([14.3, 21.6, 17.2])  # i, j, k


def ball(radius: float = 9.0) -> NDArray[np.int16]:
    k, j, i = np.indices((36, 44, 30), dtype=np.float64)
    distance = np.sqrt((i - CENTRE[0]) ** 2 + (j - CENTRE[1]) ** 2 + (k - CENTRE[2]) ** 2)
    return np.rint(-1000 + 1150 * np.clip(0.5 + (radius - distance) / 2, 0, 1)).astype(np.int16)


def affine(mirrored: bool = False) -> Array:
    T = transform(Rotation.from_euler("xyz", [0.5, -0.7, 1.9]), np.array([0.1, -0.2, 0.3]))
    T[:3, :3] = T[:3, :3] @ np.diag([4e-4, 4e-4, -6e-4 if mirrored else 6e-4])
    return T


def signed_volume(vertices: Array, faces: NDArray[np.int32]) -> float:
    p = vertices[faces]
    return float(np.sum(p[:, 0] * np.cross(p[:, 1], p[:, 2])) / 6)


@pytest.mark.parametrize("mirrored", [False, True])
def test_sphere_is_accurate_and_faces_outwards(mirrored: bool) -> None:
    T = affine(mirrored)
    vertices, faces = surface(ball(), T, -425.0)
    voxel = apply(np.linalg.inv(T).astype(np.float64), vertices)
    assert np.max(np.abs(np.linalg.norm(voxel - CENTRE, axis=1) - 9.0)) < 0.06
    volume = signed_volume(vertices - vertices.mean(axis=0), faces)
    assert volume == pytest.approx(4 / 3 * np.pi * 9.0**3 * 4e-4 * 4e-4 * 6e-4, rel=0.01)
    findings = mesh_findings(vertices, faces.astype(np.int64))
    assert (findings["holes"], findings["components"], findings["non_manifold_edges"]) == (0, 1, 0)


def test_an_asymmetric_body_is_not_mirrored() -> None:
    volume = np.full((20, 20, 20), -1000, dtype=np.int16)
    volume[3:6, 3:9, 3:15] = 200  # longest along i
    volume[3:12, 3:6, 3:6] = 200
    vertices, _ = surface(volume, np.diag([1.0, 1.0, 1.0, 1.0]), -400)
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [12, 6, 9], atol=0.2)


def test_slabs_give_the_same_closed_surface() -> None:
    volume = ball()
    whole_vertices, whole_faces = surface(volume, affine(), -425.0)
    vertices, faces = surface(volume, affine(), -425.0, slab_voxels=5 * 44 * 30)
    assert (len(vertices), len(faces)) == (len(whole_vertices), len(whole_faces))
    assert mesh_findings(vertices, faces.astype(np.int64))["holes"] == 0
    assert signed_volume(vertices, faces) == pytest.approx(signed_volume(whole_vertices, whole_faces), rel=1e-6)


def test_values_that_equal_the_threshold_give_no_collapsed_faces() -> None:
    volume = np.zeros((12, 12, 12), dtype=np.int16)
    volume[3:9, 3:9, 3:9] = 100
    volume[4:8, 4:8, 4:8] = 200
    vertices, faces = surface(volume, np.eye(4), 100)
    assert mesh_findings(vertices, faces.astype(np.int64))["degenerate_faces"] == 0


def test_no_surface_is_an_error() -> None:
    with pytest.raises(ComputeError, match="-1000 to 150 HU"):
        surface(ball(), np.eye(4), 500)
    with pytest.raises(ComputeError, match="shape"):
        surface(np.zeros((1, 5, 5), dtype=np.int16), np.eye(4), 0)
