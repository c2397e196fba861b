"""Which points of a surface a view sees, and the share of the area that several views see."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh, covered_shares, depth_map, seen_points
from service.core.geometry import Array, transform

CAMERA = CameraModel(320, 240, 300.0, 300.0, 159.5, 119.5, k1=-0.05)


def above(height_m: float) -> Array:
    """A camera over the origin that looks straight down."""
    return transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, height_m]))


def below(height_m: float) -> Array:
    return transform(np.eye(3), np.array([0.0, 0.0, -height_m]))


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=0.05)


@pytest.mark.parametrize("distance_m", [0.2, 1.0])
def test_a_view_sees_the_cap_of_a_ball_that_geometry_says(ball: trimesh.Trimesh, distance_m: float) -> None:
    """A point p is before the horizon where p · n > r² / distance for a camera at that distance from the centre."""
    points = np.asarray(ball.vertices)
    mesh = RayMesh(points, np.asarray(ball.faces))
    for pose, side in ((above(distance_m), 1.0), (below(distance_m), -1.0)):
        seen = seen_points(points, CAMERA, pose, depth_map(mesh, CAMERA, pose))
        beyond_m = side * points[:, 2] - 0.05**2 / distance_m
        assert seen[beyond_m > 0.010].all()
        assert not seen[beyond_m < -0.005].any()


def test_what_lies_behind_something_or_outside_of_the_picture_is_not_seen() -> None:
    cover = trimesh.creation.box((0.1, 0.1, 0.01), trimesh.transformations.translation_matrix((0, 0, 0.1)))
    table = trimesh.creation.box((2.0, 2.0, 0.01))
    vertices = np.vstack([cover.vertices, table.vertices])
    faces = np.vstack([cover.faces, np.asarray(table.faces) + len(cover.vertices)])
    pose = above(0.5)
    depth_m = depth_map(RayMesh(vertices, faces), CAMERA, pose)
    points = np.array([[0, 0, 0.105], [0, 0, 0.005], [0.15, 0, 0.005], [0.15, 0, -0.005], [0.9, 0, 0.005]])
    assert seen_points(points, CAMERA, pose, depth_m).tolist() == [True, False, True, False, False]
    behind = np.array([[0, 0, 0.9]])
    assert not seen_points(behind, CAMERA, pose, depth_m).any()


def test_shares_are_of_the_area(ball: trimesh.Trimesh) -> None:
    points, faces = np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int64)
    counts = np.where(points[:, 2] > 0.03, 4, np.where(points[:, 2] > -0.025, 1, 0))  # a cap is 2 π r h
    shares = covered_shares(counts, points, faces, (1, 2, 4, 5))
    assert np.allclose(shares, (0.75, 0.2, 0.2, 0.0), atol=0.02)
