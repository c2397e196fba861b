"""Filling holes of a stereo surface: with what a view sees and no depth contradicts, near the surface."""

from __future__ import annotations

import numpy as np
import trimesh

from service.compute.ground_truth.fusion.fuse import compact
from service.compute.ground_truth.surface import Surface
from service.compute.stereo.filling import FillLimits, filled
from service.compute.stereo.matching import DepthMap
from service.compute.stereo.pairs import StereoView
from service.core.geometry import Array, look_at
from tests.support.scenes.depth_of_sphere import CAMERA, depth_of_sphere

RADIUS_M = 0.05
HOLE_M, WIDTH_M = 0.045, 0.0218  # height above which nothing was matched, and radius there
ABOVE, ASIDE, BELOW = (np.array(eye) for eye in ((0.05, 0.0, 0.3), (0.3, 0.0, 0.05), (0.02, 0.0, -0.3)))
LIMITS = FillLimits(near_m=0.002, far_m=0.05, behind_m=0.002)
BALL = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_M)
WHOLE = Surface(np.array(BALL.vertices), np.array(BALL.faces, dtype=np.int64))
OPEN, _ = compact(WHOLE.vertices_m, WHOLE.faces[(WHOLE.vertices_m[WHOLE.faces][:, :, 2] < HOLE_M).all(axis=1)])


def view(eye: Array) -> StereoView:
    blank = np.zeros((CAMERA.height, CAMERA.width), dtype=np.uint8)
    return StereoView(blank, CAMERA, look_at(eye, np.zeros(3), np.array([0.1, 1.0, 0.2])))


def depth(eye: Array) -> DepthMap:
    """Without the hole."""
    one = depth_of_sphere(view(eye).T_world_camera, RADIUS_M)
    v, u = np.nonzero(np.isfinite(one.depth_m))
    one.depth_m[v, u] = np.where(one.points_m(1)[:, 2] < HOLE_M, one.depth_m[v, u], np.nan)
    return one


def with_plate() -> Surface:
    """The whole ball, and a plate beside it that is no surface: a closed guess may hold such."""
    plate = trimesh.creation.icosphere(subdivisions=3, radius=0.008)
    place = np.array(plate.vertices) * [0.1, 1.0, 1.0] + [0.06, 0.0, 0.0]
    faces = np.array(plate.faces, dtype=np.int64) + len(WHOLE.vertices_m)
    return Surface(np.concatenate([WHOLE.vertices_m, place]), np.concatenate([WHOLE.faces, faces]))


def added(found: Surface) -> Array:
    """Vertices that filling added."""
    return found.vertices_m[len(OPEN.vertices_m) :]


def test_a_hole_is_filled_by_the_closed_guess_where_a_view_sees_it() -> None:
    found = filled(OPEN, WHOLE, [depth(ABOVE), depth(ASIDE)], [view(ABOVE), view(ASIDE)], LIMITS)
    new = added(found)
    assert np.all(new[:, 2] > HOLE_M - 0.004)
    assert np.max(np.linalg.norm(new[:, :2], axis=1)) < WIDTH_M + 0.004
    np.testing.assert_array_equal(found.faces[: len(OPEN.faces)], OPEN.faces)
    upward = found.area_vectors_m2[len(OPEN.faces) :].sum(axis=0)[2]
    assert 0.9 < upward / (np.pi * WIDTH_M**2) < 1.3, "all of the hole"


def test_what_no_view_sees_stays_open() -> None:
    assert len(added(filled(OPEN, WHOLE, [depth(BELOW)], [view(BELOW)], LIMITS))) == 0


def test_what_depth_maps_see_through_is_not_taken() -> None:
    guess, views = with_plate(), [view(ASIDE), view(np.array([0.3, 0.01, 0.05])), view(ABOVE)]
    maps = [depth(one.eye_m) for one in views]
    assert np.all(added(filled(OPEN, guess, maps, views, LIMITS))[:, 2] > HOLE_M - 0.004)
    once = added(filled(OPEN, guess, maps[:1], views, LIMITS))
    assert np.any(once[:, 0] > RADIUS_M + 0.005), "one map alone may be wrong"


def test_what_is_far_from_the_surface_is_not_taken() -> None:
    near = FillLimits(near_m=0.002, far_m=0.01, behind_m=0.002)
    new = added(filled(OPEN, WHOLE, [], [view(ABOVE)], near))
    assert len(new) > 50
    assert np.min(np.linalg.norm(new[:, :2], axis=1)) > 0.010, "the middle of the hole stays open"
