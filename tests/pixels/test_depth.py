"""Depth and normals against planes and spheres whose depth is known exactly, for distorted cameras and pinholes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh, pixel_rays, seen, seen_rows
from service.compute.images.views import DEPTH_UNIT_MM, coded_depth
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, apply, inverse, look_at

PINHOLE = CameraModel(60, 40, 71.0, 70.0, 28.3, 20.4)
DISTORTED = CameraModel(60, 40, 71.0, 70.0, 28.3, 20.4, -0.12, 0.06, 8e-4, -5e-4)
RATIONAL = CameraModel(60, 40, 71.0, 70.0, 28.3, 20.4, 0.2, 0.02, 8e-4, -5e-4, 0.01, 0.3, 0.02, 0.005)
CAMERAS = [pytest.param(PINHOLE, id="pinhole"), pytest.param(DISTORTED, id="distorted"),
           pytest.param(RATIONAL, id="rational")]  # fmt: skip
T_WORLD_CAMERA = look_at(np.array([0.1, -0.2, 0.7]), np.array([0.02, 0.01, 0.0]), np.array([0.0, 1.0, 0.0]))


def square(half_m: float) -> RayMesh:
    """The plane z = 0 of the world as two triangles."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half_m
    return RayMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def cap(radius_m: float, half_angle_rad: float, n: int) -> tuple[RayMesh, float]:
    """The top of a sphere at the origin, finely tessellated, and how far its faces lie inside the sphere at most."""
    angle = np.tan(np.linspace(-half_angle_rad, half_angle_rad, n))
    x, y = np.meshgrid(angle, angle)
    points = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    points *= radius_m / np.linalg.norm(points, axis=1, keepdims=True)
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (d, c, b))])
    edge_m = np.linalg.norm(points[faces[:, 1]] - points[faces[:, 2]], axis=1).max()
    return RayMesh(points, faces), float(edge_m**2 / (6 * radius_m))


def pixel_grid(camera: CameraModel) -> Array:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)


def exact_rays(camera: CameraModel) -> Array:
    """(H, W, 3) rays with z = 1 through the pixel centres, by the camera's own inverse."""
    xy = camera.normalise(pixel_grid(camera))
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1).reshape(camera.height, camera.width, 3)


def plane_depth(camera: CameraModel, T: Transform) -> Array:
    """Depth of the plane z = 0 of the world."""
    return -T[2, 3] / (exact_rays(camera) @ T[2, :3])


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_depth_of_a_plane_is_exact_at_every_pixel_centre(camera: CameraModel) -> None:
    image = seen(square(5.0), camera, T_WORLD_CAMERA)
    assert image.valid.all()
    assert np.abs(image.depth_m / plane_depth(camera, T_WORLD_CAMERA) - 1).max() < 1e-6
    towards = T_WORLD_CAMERA[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    assert np.abs(image.normal - towards).max() < 1e-6


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_hit_projects_back_to_its_pixel(camera: CameraModel) -> None:
    surface = square(5.0)
    for rows in seen_rows(surface, camera, T_WORLD_CAMERA):
        xy = pixel_rays(camera).xy(rows.first, rows.first + len(rows.depth_m))
        z = rows.depth_m.astype(np.float64)[..., None]
        world = apply(T_WORLD_CAMERA, np.concatenate([xy * z, z], axis=2).reshape(-1, 3))
        assert np.abs(world[:, 2]).max() < 1e-6  # on the plane
        pixels = camera.project(apply(inverse(T_WORLD_CAMERA), world))
        expected = pixel_grid(camera)[rows.first * camera.width :][: len(pixels)]
        assert np.abs(pixels - expected).max() < 1e-3


def test_the_depth_of_a_sphere() -> None:
    camera = CameraModel(60, 40, 300.0, 300.0, 29.5, 19.5, -0.1, 0.02)
    radius_m = 0.12
    surface, inside_m = cap(radius_m, 0.9, 260)
    T = look_at(np.array([0.05, -0.1, 0.6]), np.array([0.0, 0.0, radius_m]), np.array([0.0, 1.0, 0.0]))
    image = seen(surface, camera, T)
    rays, centre = exact_rays(camera), inverse(T)[:3, 3]
    a, b = np.sum(rays * rays, axis=2), rays @ centre
    expected = (b - np.sqrt(b * b - a * (centre @ centre - radius_m**2))) / a
    behind_m = image.depth_m - expected
    normal = (rays * expected[..., None] - centre) / radius_m
    assert image.valid.all()
    # The faces lie inside the sphere; a slanted ray travels further to them.
    assert behind_m.min() > -1e-6 * expected.max()
    assert behind_m.max() < 1.5 * inside_m + 1e-6 * expected.max()
    assert np.degrees(np.arccos(np.clip(np.sum(normal * image.normal, axis=2), -1, 1))).max() < 0.5


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_edge_of_a_plane_is_where_its_corners_project(camera: CameraModel) -> None:
    """A pixel sees the square if its centre lies inside it: an error of half a pixel would move the edge."""
    half_m = 0.2
    image = seen(square(half_m), camera, T_WORLD_CAMERA)
    depth = plane_depth(camera, T_WORLD_CAMERA)
    at = apply(T_WORLD_CAMERA, exact_rays(camera) * depth[..., None])[..., :2]
    inside = np.abs(at).max(axis=2) < half_m
    clear = np.abs(np.abs(at).max(axis=2) - half_m) > 1e-6
    assert 100 < np.count_nonzero(inside) < inside.size - 100
    assert (image.valid == inside)[clear].all()
    assert not image.normal[~image.valid].any()


@settings(max_examples=25, deadline=None)
@given(
    eye=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(0.2, 1.5)),
    offset_m=st.floats(-50.0, 50.0),
    k1=st.floats(-0.15, 0.15),
)
def test_any_plane_from_anywhere_far_from_the_origin(
    eye: tuple[float, float, float], offset_m: float, k1: float
) -> None:
    camera = CameraModel(31, 21, 60.0, 61.0, 14.0, 11.0, k1, 0.0, 1e-3, 0.0)
    away = np.array([offset_m, -offset_m, offset_m])
    corners = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]]) + away
    T = look_at(np.array(eye), np.array([0.05, 0.02, 0.0]), np.array([0.0, 1.0, 0.1]))
    moved = T.copy()
    moved[:3, 3] += away
    depth = seen(RayMesh(corners, np.array([[0, 2, 1], [0, 2, 3]])), camera, moved).depth_m
    expected = plane_depth(camera, T)
    near = (expected > 0) & (expected < 4.0)
    assert np.abs(depth[near] / expected[near] - 1).max() < 1e-6


def test_the_nearest_surface_is_seen_whichever_way_its_faces_turn() -> None:
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = np.concatenate([corners, corners + np.array([0, 0, 0.1])])
    faces = np.array([[0, 1, 2], [0, 2, 3], [6, 5, 4], [7, 6, 4]])
    T = look_at(np.array([0.0, 0.0, 0.6]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    image = seen(RayMesh(vertices, faces), PINHOLE, T)
    assert np.abs(image.depth_m - 0.5).max() < 1e-6
    assert np.abs(image.normal - [0, 0, -1]).max() < 1e-6


def test_faces_without_area_do_not_matter() -> None:
    vertices = np.array([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0], [0, 0, 0.3]])
    faces = np.array([[4, 4, 4], [0, 1, 2], [0, 4, 0], [0, 2, 3]])
    image = seen(RayMesh(vertices, faces), PINHOLE, T_WORLD_CAMERA)
    assert np.abs(image.depth_m / plane_depth(PINHOLE, T_WORLD_CAMERA) - 1).max() < 1e-6


def test_a_mesh_without_faces_is_refused() -> None:
    with pytest.raises(DataError, match="no face with an area"):
        RayMesh(np.zeros((3, 3)), np.empty((0, 3), dtype=np.int64))


def test_a_distortion_that_folds_within_the_image_is_refused() -> None:
    with pytest.raises(ComputeError, match="cannot be inverted"):
        pixel_rays(CameraModel(60, 40, 30.0, 30.0, 29.5, 19.5, -0.5))


def test_coded_depth_is_within_half_a_tenth_of_a_millimetre() -> None:
    depth_m = seen(square(0.2), PINHOLE, T_WORLD_CAMERA).depth_m
    again = coded_depth(depth_m) * (1e-3 * DEPTH_UNIT_MM)
    assert np.abs(again - depth_m).max() <= 0.5001e-4
    assert ((again > 0) == (depth_m > 0)).all()
    with pytest.raises(DataError, match=r"7.00 m does not fit into 16 bits"):
        coded_depth(np.full((2, 2), 7.0, dtype=np.float32))
