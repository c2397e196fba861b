"""Undistorted images, masks of spheres and posts, crops and splits."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.render import (
    Cylinder,
    RayMesh,
    WorldSphere,
    depth_map,
    marker_mask,
    pixel_rays,
    posts_below,
    seen,
)
from service.compute.images.resample import pinhole_of, undistorted
from service.compute.images.views import ImageCrop, marker_free_crops, splits
from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Array, apply, inverse, look_at

CAMERA = CameraModel(180, 120, 220.0, 221.0, 88.0, 61.0, -0.15, 0.05, 1e-3, -5e-4)
T = look_at(np.array([0.1, -0.2, 0.7]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
UP = np.array([0.0, 0.0, 1.0])


# --- undistorted images -----------------------------------------------------------------------------------------


def smooth(x: Array, y: Array) -> Array:
    return 120 + 60 * np.sin(5 * x + 1) * np.cos(4 * y)


@pytest.mark.parametrize("k1", [-0.15, 0.2])
def test_an_undistorted_image_shows_each_ray_at_its_own_pixel(k1: float) -> None:
    camera = dataclasses.replace(CAMERA, k1=k1)
    xy = pixel_rays(camera).xy(0, camera.height)
    photograph = smooth(xy[..., 0], xy[..., 1]).astype(np.uint8)
    made = undistorted(photograph, camera)
    assert not made.camera.distortion.any()
    xy = pixel_rays(made.camera).xy(0, camera.height)
    difference = made.image - smooth(xy[..., 0], xy[..., 1])
    assert np.abs(difference[made.valid]).max() < 3
    assert (made.valid.all()) == (k1 < 0)
    assert not made.image[~made.valid].any()


def test_depth_of_an_undistorted_image_belongs_to_its_own_pixels() -> None:
    """The two depths agree along the same ray, whichever camera took it."""
    corners = np.array([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]])
    surface = RayMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    pinhole = pinhole_of(CAMERA)
    depth = depth_map(surface, pinhole, T)
    v, u = (k.ravel() for k in np.mgrid[10:110:7, 10:170:7])
    z = depth[v, u].astype(np.float64)
    rays = np.stack([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy, np.ones(len(u))], axis=1)
    assert np.abs(apply(T, rays * z[:, None])[:, 2]).max() < 1e-6


# --- masks ------------------------------------------------------------------------------------------------------


def covered(camera: CameraModel, mesh: trimesh.Trimesh) -> NDArray[np.bool_]:
    return seen(RayMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)), camera, T).valid


@pytest.mark.parametrize("camera", [CAMERA, pinhole_of(CAMERA)])
@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.05), (0.26, 0.1, 0.02), (-0.1, 0.19, 0.0)])
def test_the_mask_of_a_sphere_holds_every_pixel_that_shows_it_and_hardly_more(
    camera: CameraModel, centre: tuple[float, float, float]
) -> None:
    sphere = WorldSphere(np.array(centre), 0.03)
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=sphere.radius_m)
    mesh.apply_translation(sphere.centre_m)
    mask, truth = marker_mask(camera, T, [sphere]), covered(camera, mesh)
    assert truth.any()
    assert mask[truth].all()
    assert np.count_nonzero(mask & ~truth) < 2.2 * np.sqrt(4 * np.pi * np.count_nonzero(truth)) + 12


def test_the_mask_of_a_post_holds_every_pixel_that_shows_it_and_hardly_more() -> None:
    (post,) = posts_below([WorldSphere(np.array([0.03, 0.02, 0.1]), 0.015)], UP, 0.1, 0.008)
    mesh = trimesh.creation.cylinder(post.radius_m, segment=[post.top_m, post.foot_m], sections=64)
    mask, truth = marker_mask(CAMERA, T, [], [post]), covered(CAMERA, mesh)
    assert mask[truth].all()
    assert np.count_nonzero(mask & ~truth) < 0.5 * np.count_nonzero(truth)


def test_what_is_behind_the_camera_or_beside_the_image_is_in_no_mask() -> None:
    behind = T[:3, 3] - 0.3 * T[:3, 2]
    beside = T[:3, 3] + 0.3 * T[:3, 2] + 2.0 * T[:3, 0]
    posts = [Cylinder(place, place - 0.1 * UP, 0.01) for place in (behind, beside)]
    assert not marker_mask(CAMERA, T, [WorldSphere(behind, 0.02), WorldSphere(beside, 0.02)], posts).any()


def test_a_sphere_that_fills_the_image_is_all_of_it() -> None:
    assert marker_mask(CAMERA, T, [WorldSphere(T[:3, 3] + 0.2 * T[:3, 2], 0.19)]).all()


# --- crops ------------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), width=st.integers(17, 90), height=st.integers(9, 60))
def test_every_crop_shows_the_specimen_and_no_marker(seed: int, width: int, height: int) -> None:
    rng = np.random.default_rng(seed)
    wanted, forbidden = np.zeros((2, 203, 301), dtype=bool)
    wanted[40:170, 60:250] = True
    for v, u in rng.integers(0, 200, (5, 2)):
        forbidden[v : v + 12, u : u + 12] = True
    crops = marker_free_crops(wanted, forbidden, (width, height))
    assert crops == marker_free_crops(wanted, forbidden, (width, height))
    for crop in crops:
        assert wanted[crop.slices].shape == (height, width)
        assert not forbidden[crop.slices].any()
        assert wanted[crop.slices].any()


def test_crops_cover_the_specimen() -> None:
    wanted, forbidden = np.zeros((2, 480, 640), dtype=bool)
    wanted[100:380, 100:540] = True
    forbidden[:60] = forbidden[430:] = True
    crops = marker_free_crops(wanted, forbidden, (200, 120))
    shown = np.zeros_like(wanted)
    for crop in crops:
        shown[crop.slices] = True
    assert np.count_nonzero(shown & wanted) > 0.9 * np.count_nonzero(wanted)


def test_an_image_full_of_markers_has_no_crop_and_a_crop_larger_than_the_image_is_refused() -> None:
    wanted = np.ones((100, 100), dtype=bool)
    assert marker_free_crops(wanted, wanted, (32, 32)) == []
    with pytest.raises(ConfigurationError, match="does not fit"):
        marker_free_crops(wanted, ~wanted)


def test_the_camera_of_a_crop_projects_to_the_same_places() -> None:
    crop = ImageCrop(40, 24, 90, 60)
    points = apply(inverse(T), np.random.default_rng(2).uniform(-0.1, 0.1, (50, 3)))
    inside = crop.camera(CAMERA)
    assert (inside.width, inside.height) == (90, 60)
    assert np.abs(inside.project(points) + np.array([40, 24]) - CAMERA.project(points)).max() < 1e-9


def test_depth_of_a_crop_is_that_of_the_image() -> None:
    corners = np.array([[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0.1], [-0.2, 0.2, 0]])
    surface, crop = RayMesh(corners, np.array([[0, 1, 2], [0, 2, 3]])), ImageCrop(40, 24, 90, 60)
    whole, part = (depth_map(surface, camera, T) for camera in (CAMERA, crop.camera(CAMERA)))
    assert np.abs(part - whole[crop.slices]).max() < 1e-6


# --- splits -----------------------------------------------------------------------------------------------------


def test_splits_are_the_same_for_the_same_views_and_train_and_test_share_none() -> None:
    rng = np.random.default_rng(4)
    sees = {f"v{i:03d}": rng.random(500) < 0.3 for i in range(36)}
    made = splits(sees)
    assert made == splits(dict(reversed(sees.items())))
    assert set(made.dense) == set(sees)
    assert len(made.sparse) == 8
    assert set(made.sparse) <= set(sees)
    assert not set(made.train) & set(made.test)
    assert set(made.train) | set(made.test) == set(sees)


def test_the_sparse_views_are_those_that_see_most_together() -> None:
    sees = {f"v{i}": np.zeros(80, dtype=bool) for i in range(12)}
    for i in range(12):  # eight views see ten points each, and four see what others see
        sees[f"v{i}"][10 * (i % 8) : 10 * (i % 8) + (10 if i < 8 else 9)] = True
    assert set(splits(sees).sparse) == {f"v{i}" for i in range(8)}


def test_a_data_set_without_views_is_refused() -> None:
    with pytest.raises(DataError, match="at least one view"):
        splits({})
