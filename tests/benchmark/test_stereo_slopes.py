"""Steep surfaces in depth maps: their slopes, and that fusion leaves no holes in them."""

from __future__ import annotations

import numpy as np

from service.compute.stereo.fusion import fused
from service.compute.stereo.matching import DepthMap
from service.compute.stereo.slopes import STEEPEST, slopes_of
from service.compute.stereo.surface import surface_of
from service.core.geometry import Array, look_at
from tests.support.scenes.depth_of_sphere import depth_of_sphere

RADIUS_M, EYE = 0.05, np.array([0.3, 0.0, 0.0])


def seen_from(eye: Array) -> DepthMap:
    return depth_of_sphere(look_at(eye, np.zeros(3), np.array([0.1, 0.2, 1.0])), RADIUS_M)


def incidence_rad(points_m: Array) -> Array:
    """(N,) angle between the normal of the sphere at points (N, 3) and the ray to EYE."""
    ray = EYE - points_m
    cosine = np.einsum("ni,ni->n", ray, points_m) / np.linalg.norm(ray, axis=1) / np.linalg.norm(points_m, axis=1)
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def test_the_slopes_of_a_sphere_are_its_normals() -> None:
    one = seen_from(EYE)
    slopes, points = slopes_of(one), one.points_m(1)
    normals, angle = slopes.normals(one), incidence_rad(points)
    off = np.degrees(np.arccos(np.clip(np.einsum("ni,ni->n", normals, points) / RADIUS_M, -1.0, 1.0)))
    assert off[angle < np.radians(60)].max() < 6.0
    assert off[angle < np.radians(75)].max() < 12.0
    across = slopes.across[np.isfinite(one.depth_m)]
    assert across.min() >= np.float32(STEEPEST)
    assert np.abs(across - np.cos(angle))[angle < np.radians(75)].max() < 0.1


def test_a_slope_is_not_taken_across_a_jump() -> None:
    depth = np.full((200, 200), 0.5, dtype=np.float32)
    depth[:, 100:] = 0.6
    depth[:, 99:101] = np.nan  # matching leaves a gap at every jump
    slopes = slopes_of(DepthMap(depth, seen_from(EYE).camera, np.eye(4), 1.0))
    known = np.isfinite(depth)
    np.testing.assert_allclose(slopes.across[known], 1.0, atol=1e-3)
    assert np.isnan(slopes.across[~known]).all()


def test_a_steep_surface_has_no_holes() -> None:
    found = surface_of(fused([seen_from(EYE)], 0.001, 1), 1)
    centres = found.vertices_m[found.faces].mean(axis=1)
    angle, area = incidence_rad(centres), np.linalg.norm(found.area_vectors_m2, axis=1)
    at = np.arccos(np.linspace(0.9, 0.2, 200))  # polar angles of the sphere, and the incidence that each has
    incidence = incidence_rad(RADIUS_M * np.stack([np.cos(at), np.sin(at), 0 * at], axis=1))
    for low, high in ((40, 60), (60, 70), (70, 75)):
        first, last = np.interp(np.radians([low, high]), incidence, at)
        whole = 2 * np.pi * RADIUS_M**2 * (np.cos(first) - np.cos(last))
        share = area[(angle > np.radians(low)) & (angle < np.radians(high))].sum() / whole
        assert 0.9 < share < 1.15, f"between {low}° and {high}°"
    assert np.abs(np.linalg.norm(centres, axis=1) - RADIUS_M)[angle < np.radians(75)].max() < 3e-4
