"""Spheres are found in scan-like and CT-like meshes without initial guesses, and constellations are matched."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from service.compute.surfaces.constellations import close_loop, match_constellations
from service.compute.surfaces.mesh_spheres import locate_spheres
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, apply, inverse, transform

IntArray = NDArray[np.int64]

RADIUS = 0.015
CENTRES = np.array(
    [
        [-0.20, -0.12, 0.060],
        [0.21, -0.10, 0.085],
        [0.02, 0.17, 0.070],
        [-0.15, 0.13, 0.095],
        [0.17, 0.12, 0.055],
        [0.01, -0.17, 0.080],
    ]
)
CAP_DEG = [60, 90, 150, 75, 120, 60]


def _terrain(n: int) -> tuple[Array, IntArray]:
    """A bumpy specimen with ridges whose curvature is close to the spheres'."""
    x = np.linspace(-0.3, 0.3, n)
    X, Y = np.meshgrid(x, x)
    bumps = 0.03 * np.exp(-(X**2 / 0.02 + Y**2 / 0.008)) + 0.004 * np.sin(60 * X) * np.cos(47 * Y)
    # a half cylinder and a bump of almost the spheres' curvature, and a dent of exactly their radius
    ridge = np.sqrt(np.maximum(0, RADIUS**2 - (X - 0.05) ** 2)) * (np.abs(Y) < 0.1)
    boss = np.sqrt(np.maximum(0, 0.0185**2 - (X + 0.07) ** 2 - (Y - 0.02) ** 2))
    dent = np.sqrt(np.maximum(0, RADIUS**2 - (X - 0.12) ** 2 - Y**2))
    Z = bumps + ridge + boss - dent
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    return np.stack([X.ravel(), Y.ravel(), Z.ravel()], 1), faces


@cache
def _scan(noise_m: float, seed: int = 0) -> tuple[Array, IntArray]:
    rng = np.random.default_rng(seed)
    parts: list[tuple[Array, IntArray]] = [_terrain(350)]
    for centre, cap in zip(CENTRES, CAP_DEG, strict=True):
        ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
        visible = ball.triangles_center[:, 2] > np.cos(np.deg2rad(cap)) * RADIUS
        visible &= rng.random(len(visible)) > 0.05  # pinholes
        parts.append((ball.vertices + centre, ball.faces[visible]))
        foot = [centre[0], centre[1], 0.0]
        post = trimesh.creation.cylinder(radius=0.004, segment=[centre - [0, 0, 0.0145], foot])
        parts.append((post.vertices, post.faces))
    offsets = np.cumsum([0, *(len(v) for v, _ in parts)])
    vertices = np.concatenate([v for v, _ in parts])
    faces = np.concatenate([f + o for (_, f), o in zip(parts, offsets, strict=False)])
    return vertices + rng.normal(0, noise_m, vertices.shape), faces


def _nearest(centres: Array) -> Array:
    distance = np.linalg.norm(centres[:, None] - CENTRES[None], axis=2)
    assert sorted(distance.argmin(axis=1)) == list(range(len(CENTRES)))
    return distance.min(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("flipped", [False, True])
def test_partial_noisy_spheres_among_clutter(flipped: bool) -> None:
    vertices, faces = _scan(noise_m=5e-5)
    spheres = locate_spheres(vertices, faces[:, ::-1] if flipped else faces, RADIUS, expected=6)
    error = _nearest(np.array([s.centre_m for s in spheres]))
    assert error.max() < 3e-5
    for sphere in spheres:
        assert 0.2 < sphere.coverage <= 1.0
        assert 3e-5 < sphere.rms_m < 7e-5
        assert abs(sphere.radius_residual_m) < 3e-5
        assert np.all(np.linalg.eigvalsh(sphere.covariance) > 0)
    # the stated uncertainty is of the size of the error: not ten times too small or too large
    sigma = np.array([np.sqrt(np.trace(s.covariance)) for s in spheres])
    assert 0.2 < np.sqrt(np.mean(error**2)) / np.sqrt(np.mean(sigma**2)) < 5


def test_ct_isosurface_of_coarse_voxels() -> None:
    voxel = 0.8e-3
    axes = [np.arange(-0.06, 0.06, voxel), np.arange(-0.05, 0.05, voxel), np.arange(-0.03, 0.03, voxel)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    centres = np.array([[-0.03, 0.01, 0.002], [0.031, -0.015, -0.004]])
    solid = np.full(grid.shape[:3], 1e3)
    for c in centres:
        solid = np.minimum(solid, np.linalg.norm(grid - c, axis=-1) - RADIUS)
    post = np.maximum(np.linalg.norm(grid[..., :2] - centres[0][:2], axis=-1) - 0.004, grid[..., 2])
    block = np.max(np.abs(grid - [0.0, 0.04, 0.0]) - [0.05, 0.006, 0.01], axis=-1)
    density = 1 / (1 + np.exp(np.minimum(np.minimum(solid, post), block) / (0.4 * voxel)))
    density += np.random.default_rng(1).normal(0, 0.03, density.shape)
    v, f, _, _ = marching_cubes(density, 0.5, spacing=(voxel,) * 3)
    spheres = locate_spheres(v.astype(np.float64) + [a[0] for a in axes], f, RADIUS, expected=2)
    found = np.array(sorted((s.centre_m for s in spheres), key=lambda c: float(c[0])))
    assert np.linalg.norm(found - centres, axis=1).max() < 5e-5


def test_any_rigid_motion_moves_the_centres_with_the_mesh() -> None:
    vertices, faces = _scan(noise_m=3e-5)
    T = transform(Rotation.from_rotvec([1.0, -2.0, 0.5]), np.array([3.0, -2.0, 1.0]))
    moved = locate_spheres(apply(T, vertices), faces, RADIUS, expected=6)
    assert _nearest(apply(inverse(T), np.array([s.centre_m for s in moved]))).max() < 3e-5


def test_wrong_count_says_what_was_found() -> None:
    vertices, faces = _scan(noise_m=5e-5)
    with pytest.raises(ComputeError, match=r"found 6 spheres .* expected 7: \(.*coverage") as caught:
        locate_spheres(vertices, faces, RADIUS, expected=7)
    assert caught.value.remedy


@pytest.mark.slow
def test_wrong_unit_finds_nothing() -> None:
    vertices, faces = _scan(noise_m=5e-5)
    with pytest.raises(ComputeError, match="found 0 spheres"):
        locate_spheres(vertices * 10, faces, RADIUS)


def test_not_a_mesh() -> None:
    with pytest.raises(ComputeError, match="no surface"):
        locate_spheres(np.zeros((10, 3)), np.empty((0, 3), dtype=np.int64), RADIUS)
    with pytest.raises(DataError, match="does not have"):
        locate_spheres(np.zeros((3, 3)), np.array([[0, 1, 7]]), RADIUS)


# --- constellations -------------------------------------------------------------------------------------

CONSTELLATION = np.concatenate(
    [CENTRES, [[0.0, 0.03, 0.12], [-0.06, -0.02, 0.1], [0.08, 0.01, 0.11], [0.2, 0.02, 0.04]]]
)


@pytest.mark.slow
@given(
    rotation=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-2, 2)] * 3),
    seed=st.integers(0, 1000),
    missing=st.integers(0, 3),
    extra=st.integers(0, 2),
)
@settings(max_examples=25, deadline=None)
def test_constellations_match_in_any_order(
    rotation: tuple[float, ...], shift: tuple[float, ...], seed: int, missing: int, extra: int
) -> None:
    rng = np.random.default_rng(seed)
    T_a_b = transform(Rotation.from_rotvec(rotation), np.array(shift))
    order = rng.permutation(len(CONSTELLATION))[missing:]
    b = apply(inverse(T_a_b), CONSTELLATION[order]) + rng.normal(0, 5e-5, (len(order), 3))
    b = np.concatenate([b, b.mean(axis=0) + rng.uniform(0.4, 0.6, (extra, 3))])
    match = match_constellations(CONSTELLATION, b)
    assert match.pairs == tuple(sorted((int(i), k) for k, i in enumerate(order)))
    assert len(match.missing_a) == missing
    assert len(match.missing_b) == extra
    assert match.rms_m < 2e-4
    np.testing.assert_allclose(apply(match.T_a_b, b[: len(order)]), CONSTELLATION[order], atol=5e-4)


def test_mirrored_constellation_is_refused() -> None:
    with pytest.raises(ComputeError, match=r"mirror images \(10 spheres agree only when mirrored\)"):
        match_constellations(CONSTELLATION, CONSTELLATION * [1, -1, 1])


@pytest.mark.parametrize("scale", [1.02, 0.93, 1.1])
def test_a_constellation_in_another_scale_is_refused_with_it(scale: float) -> None:
    rng = np.random.default_rng(5)
    other = scale * CONSTELLATION + rng.normal(0, 5e-5, CONSTELLATION.shape)
    with pytest.raises(ComputeError, match=r"with the second multiplied by (\d\.\d{4}), 10 do") as told:
        match_constellations(CONSTELLATION, other)
    words = re.search(r"multiplied by (\d\.\d{4})", str(told.value))
    assert words is not None
    assert float(words[1]) == pytest.approx(1 / scale, abs=5e-4)


def test_a_small_difference_of_scale_is_measured_with_its_sigma() -> None:
    rng = np.random.default_rng(6)
    covariance = np.broadcast_to(np.eye(3) * 2e-5**2, (len(CONSTELLATION), 3, 3))
    other = 1.003 * CONSTELLATION + rng.normal(0, 2e-5, CONSTELLATION.shape)
    loop = close_loop(CONSTELLATION, covariance, other, covariance, match_constellations(CONSTELLATION, other))
    assert loop.scale == pytest.approx(1.003, abs=3 * loop.scale_sigma)
    assert 1e-5 < loop.scale_sigma < 2e-4


def test_flat_and_symmetric_constellations_are_refused() -> None:
    with pytest.raises(ComputeError, match="plane"):
        match_constellations(CONSTELLATION * [1, 1, 0], CONSTELLATION * [1, 1, 0])
    tower = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (0.0, 0.07)])
    with pytest.raises(ComputeError, match="more than one way"):
        match_constellations(tower, tower)


def test_unrelated_constellations_are_refused() -> None:
    rng = np.random.default_rng(4)
    with pytest.raises(ComputeError, match=r"no 4 of 6 and 6 spheres agree within 0\.5 mm"):
        match_constellations(CONSTELLATION[:6], rng.uniform(-0.3, 0.3, (6, 3)), tolerance_m=5e-4)
