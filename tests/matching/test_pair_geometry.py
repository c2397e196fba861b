"""Correspondences, overlap, difficulty and relative poses, against rays that are computed without a mesh."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh, depth_map
from service.compute.matching.loader import OCCLUDED, OUTSIDE, UNKNOWN, VISIBLE, View, correspondences, look_up
from service.compute.matching.pairs import (
    CLASSES,
    Difficulty,
    covisibility,
    difficulty,
    points_seen,
    relative_covariance,
    relative_pose,
)
from service.core.geometry import Array, Transform, apply, increment, inverse, look_at
from tests.support.scenes.posed import UP, reach, scene

CAMERA = CameraModel(96, 72, 120.0, 121.0, 47.0, 36.5)
MORE_THAN_TOLERATED = 1.1  # of depth, in widths of a pixel on the surface

ANGLES = st.floats(0.0, 2 * np.pi)
RADII = st.floats(0.08, 0.3)
HEIGHTS = st.floats(0.25, 0.5)
PLACES = st.tuples(ANGLES, RADII, HEIGHTS)


@cache
def solid() -> RayMesh:
    mesh = scene().mesh
    return RayMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))


def pose(place: tuple[float, float, float]) -> Transform:
    angle, radius, height = place
    eye = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
    return look_at(eye, np.array([0.01, 0.02, 0.02]), UP)


def view(T_world_camera: Transform, camera: CameraModel = CAMERA) -> View:
    return View(Path("unread.png"), camera.matrix, T_world_camera, depth_map(solid(), camera, T_world_camera))


def rays(T_world_camera: Transform, pixels: Array) -> Array:
    """Directions (N, 3) in the world, with z = 1 in the camera's frame."""
    xy = (pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ T_world_camera[:3, :3].T


@settings(max_examples=40, deadline=None)
@given(PLACES, PLACES)
def test_correspondences_are_where_the_surface_projects(
    a: tuple[float, float, float], b: tuple[float, float, float]
) -> None:
    first, second = pose(a), pose(b)
    found = correspondences(view(first), view(second))
    directions = rays(first, found.first_px)
    points = first[:3, 3] + directions * reach(first[:3, 3], directions)[:, None]
    truth = CAMERA.project(apply(inverse(second), points))
    stated = found.status != UNKNOWN  # at edges of the surface nothing is stated
    hit = np.isfinite(points).all(axis=1)
    assert stated.sum() > 200
    assert np.abs(found.second_px - truth)[stated & hit].max() < 0.01


@settings(max_examples=40, deadline=None)
@given(PLACES, PLACES)
def test_what_something_hides_is_never_visible(a: tuple[float, float, float], b: tuple[float, float, float]) -> None:
    """At the outline of what hides a point, visibility is exact to a pixel; elsewhere it is exact."""
    first, second = pose(a), pose(b)
    found = correspondences(view(first), view(second))
    directions = rays(first, found.first_px)
    distance = reach(first[:3, 3], directions)
    hit = np.isfinite(distance)
    points = first[:3, 3] + directions[hit] * distance[hit, None]
    status, pixels = found.status[hit], found.second_px[hit]
    z = (points - second[:3, 3]) @ second[:3, 2]
    around = [np.array([dx, dy]) for dx in (-1.0, 0.0, 1.0) for dy in (-1.0, 0.0, 1.0)]
    gaps_m = np.array([z - reach(second[:3, 3], rays(second, pixels + offset)) for offset in around])
    inside = (pixels >= 0).all(axis=1) & (pixels <= [CAMERA.width - 1, CAMERA.height - 1]).all(axis=1)
    assert ((status == OUTSIDE) <= ~inside).all()
    hidden = inside & (gaps_m > MORE_THAN_TOLERATED * z / CAMERA.fx).all(axis=0)
    assert not (hidden & (status == VISIBLE)).any()
    free = inside & (np.abs(gaps_m[4]) < 1e-6)
    assert not (free & (status == OCCLUDED)).any()
    # What is unknown is a margin at the edges of the surface, not most of it.
    assert np.count_nonzero(free & (status == VISIBLE)) > 0.6 * np.count_nonzero(free)


def test_behind_the_tall_part_points_are_occluded() -> None:
    low, high = np.array([-0.3, 0.06, 0.12]), np.array([0.3, 0.06, 0.12])
    sides = [view(look_at(eye, np.array([0.06, 0.05, 0.03]), UP)) for eye in (low, high)]
    found = correspondences(sides[0], sides[1])
    face = np.count_nonzero(found.status == OCCLUDED)
    assert face > 100  # the face towards the first camera


@settings(max_examples=25, deadline=None)
@given(PLACES, PLACES, st.integers(0, 1000))
def test_correspondences_between_pixels_lead_back(
    a: tuple[float, float, float], b: tuple[float, float, float], seed: int
) -> None:
    """From the first image to the second and back: the same place, wherever both ways are visible."""
    first, second = view(pose(a)), view(pose(b))
    pixels = np.random.default_rng(seed).uniform(0, [CAMERA.width - 1, CAMERA.height - 1], (400, 2))
    there = correspondences(first, second, pixels)
    at = np.flatnonzero(there.status == VISIBLE)
    back = correspondences(second, first, there.second_px[at])
    both = back.status == VISIBLE
    error = np.linalg.norm(back.second_px - pixels[at], axis=1)[both]
    assert len(error) > 10
    # Across an edge of the solid the depth between two pixels is not that of a plane.
    assert np.median(error) < 0.01
    assert np.percentile(error, 90) < 0.7


@settings(max_examples=15, deadline=None)
@given(st.lists(PLACES, min_size=2, max_size=4))
def test_overlap_counts_common_points(places: list[tuple[float, float, float]]) -> None:
    points = np.asarray(scene().mesh.sample(400), dtype=np.float64)
    views = [view(pose(place)) for place in places]
    found = covisibility(np.array([points_seen(points, one) for one in views]))
    assert (found.common == found.common.T).all()
    assert ((found.overlap >= 0) & (found.overlap <= 1)).all()
    own = np.diag(found.common)
    assert np.allclose(found.overlap * own[:, None], (found.overlap * own[:, None]).T)
    for i, one in enumerate(views):
        status = look_up(points, one)[1]
        assert own[i] == np.count_nonzero(status == VISIBLE)
    assert all(i < j for i, j in found.pairs())
    label = found.components()
    assert all(label[i] == label[j] for i, j in found.pairs())


def test_a_close_view_lies_within_a_far_one() -> None:
    points = np.asarray(scene().mesh.sample(2000), dtype=np.float64)
    eye = np.array([0.0, 0.05, 1.0])
    far, close = (view(look_at(eye * k, np.array([0.0, 0.01, 0.02]), UP)) for k in (0.5, 0.15))
    found = covisibility(np.array([points_seen(points, one) for one in (far, close)]))
    assert found.overlap[1, 0] > 0.75
    assert found.overlap[0, 1] < 0.6
    common = points[found.seen.all(axis=0)]
    stated = difficulty(common, far, close, float(found.overlap.min()))
    assert stated.scale == pytest.approx(0.48 / 0.13, rel=0.1)
    swapped = difficulty(common, close, far, float(found.overlap.min()))
    assert swapped.scale == pytest.approx(stated.scale, rel=0.1)
    assert swapped.angle_deg == stated.angle_deg


def test_the_angle_is_that_between_the_rays() -> None:
    target = np.array([0.0, 0.0, 0.03])
    eyes = [target + 0.4 * np.array([np.sin(a), 0.0, np.cos(a)]) for a in (-0.2, 0.15)]
    first, second = (view(look_at(eye, target, np.array([0.0, 1.0, 0.0]))) for eye in eyes)
    stated = difficulty(target[None], first, second, 0.9)
    assert stated.angle_deg == pytest.approx(np.degrees(0.35))
    assert stated.scale == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("angle_deg", "scale", "overlap", "name"),
    [
        (15.0, 1.2, 0.6, "easy"),
        (15.1, 1.0, 1.0, "medium"),
        (0.0, 1.3, 1.0, "medium"),
        (0.0, 1.0, 0.39, "hard"),
        (44.0, 1.0, 0.9, "hard"),
        (5.0, 2.1, 0.9, "extreme"),
        (5.0, 1.0, 0.19, "extreme"),
    ],
)
def test_a_pair_is_as_difficult_as_the_worst_of_its_measures(
    angle_deg: float, scale: float, overlap: float, name: str
) -> None:
    assert Difficulty(angle_deg, scale, overlap).name == name
    assert name in CLASSES


@pytest.mark.slow
def test_the_relative_covariance_is_that_of_draws() -> None:
    rng = np.random.default_rng(4)
    first, second = pose((0.3, 0.2, 0.4)), pose((1.9, 0.25, 0.3))
    half = rng.normal(size=(12, 12)) * np.tile([1e-4] * 3 + [3e-4] * 3, 2)[:, None]
    joint = half @ half.T
    given_pose, moved = relative_pose(first, second), np.empty((20_000, 6))
    for k, draw in enumerate(rng.multivariate_normal(np.zeros(12), joint, len(moved))):
        T = relative_pose(increment(first, draw[:3], draw[3:6]), increment(second, draw[6:9], draw[9:]))
        turn = T[:3, :3] @ given_pose[:3, :3].T
        moved[k, :3] = T[:3, 3] - given_pose[:3, 3]
        moved[k, 3:] = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    seen, stated = np.cov(moved.T), relative_covariance(first, second, joint)
    scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    assert np.abs((seen - stated) / scale).max() < 0.05


@settings(max_examples=30, deadline=None)
@given(PLACES, PLACES, st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_an_error_of_the_world_frame_cancels(
    a: tuple[float, float, float], b: tuple[float, float, float], direction: list[float]
) -> None:
    first, second = pose(a), pose(b)
    d, w = np.array(direction[:3]), np.array(direction[3:])
    moved = np.concatenate([np.concatenate([d + np.cross(w, T[:3, 3]), w]) for T in (first, second)])
    assert np.abs(relative_covariance(first, second, np.outer(moved, moved))).max() < 1e-15
