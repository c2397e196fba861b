"""Spheres among similar shapes, small caps, clouds, correlated noise: found or refused, with uncertainty."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from drivers.meshes.point_cloud import is_point_cloud, read_point_cloud
from service.cli.main import app
from service.compute.poses.pose_files import read_spheres_json
from service.compute.surfaces.constellations import close_loop, match_constellations
from service.compute.surfaces.mesh_spheres import MeshSphere, locate_spheres
from service.core.errors import ComputeError
from service.core.geometry import Array, apply, inverse, transform
from tests.support.scenes.sphere_meshes import RADIUS_M, MeshBuilder, cap, clutter, scattered_centres


def _scene(
    seed: int, half_deg: float, white_m: float, *, shared_m: float = 0.0, level: int = 4, cluttered: bool = False
) -> tuple[Array, Array, np.ndarray]:
    rng = np.random.default_rng(seed)
    centres = scattered_centres(rng, 6)
    built = clutter(rng, white_m) if cluttered else MeshBuilder()
    for centre in centres:
        built.add(*cap(centre, np.deg2rad(half_deg), rng, level=level, white_m=white_m, shared_m=shared_m))
    return centres, *built.build()


def _errors(spheres: tuple[MeshSphere, ...], centres: Array) -> tuple[Array, Array]:
    """Distances (N,) and squared Mahalanobis distances (N,) of a one-to-one assignment."""
    found = np.array([s.centre_m for s in spheres])
    nearest = np.linalg.norm(found[:, None] - centres[None], axis=2).argmin(axis=1)
    assert sorted(nearest) == list(range(len(centres)))
    error = found - centres[nearest]
    squares = [float(e @ np.linalg.solve(s.covariance, e)) for e, s in zip(error, spheres, strict=True)]
    return np.linalg.norm(error, axis=1), np.array(squares)


@pytest.mark.parametrize("cloud", [False, True])
def test_spheres_among_cylinder_torus_ellipsoids_and_other_spheres(cloud: bool) -> None:
    centres, vertices, faces = _scene(1, 60, 1e-4, cluttered=True)
    spheres = locate_spheres(vertices, faces[:0] if cloud else faces, RADIUS_M)
    distance, _ = _errors(spheres, centres)
    assert distance.max() < 8e-5


def test_caps_of_thirty_degrees_half_angle_with_honest_covariance() -> None:
    squares: list[float] = []
    for seed in range(3):
        centres, vertices, faces = _scene(seed, 30, 5e-5, level=5)
        spheres = locate_spheres(vertices, faces, RADIUS_M, expected=6)
        squares += _errors(spheres, centres)[1].tolist()
        assert all(s.coverage < 0.15 for s in spheres)
    assert 0.4 < np.mean(squares) / 3 < 2.0


@pytest.mark.parametrize("shared_m", [0.0, 6e-5])
def test_covariance_holds_for_noise_that_neighbours_share(shared_m: float) -> None:
    squares: list[float] = []
    for seed in range(4):
        centres, vertices, faces = _scene(seed + 20, 75, 5e-5, shared_m=shared_m)
        squares += _errors(locate_spheres(vertices, faces, RADIUS_M), centres)[1].tolist()
    assert np.mean(np.array(squares) < 14.16) >= 0.95  # 3 sigma in three dimensions
    assert 0.15 < np.mean(squares) / 3 < 2.0


def test_duplicate_shells_repeated_vertices_outliers_and_flipped_pieces() -> None:
    rng = np.random.default_rng(5)
    centres = scattered_centres(rng, 6)
    built = MeshBuilder()
    for number, centre in enumerate(centres):
        points, faces = cap(centre, np.deg2rad(80), rng)
        built.add(points, faces[:, ::-1] if number < 2 else faces)
        built.add(*cap(centre, np.deg2rad(70), rng))  # seen twice
    vertices, faces = built.build()
    soup = vertices[faces].reshape(-1, 3)  # as in STL files
    stray = rng.random(len(soup)) < 0.01
    soup[stray] += rng.normal(0, 4e-3, (int(stray.sum()), 3))
    spheres = locate_spheres(soup, np.arange(len(soup)).reshape(-1, 3), RADIUS_M, expected=6)
    assert _errors(spheres, centres)[0].max() < 6e-5


def test_facets_do_not_pull_the_centre_inwards() -> None:
    """A facet lies up to e²/(8 R) inside the sphere, 0.14 mm here; the centre of a cap must not be shifted by it."""
    rng = np.random.default_rng(0)
    centre = np.array([0.1, 0.0, 0.2])
    points, faces = cap(centre, np.deg2rad(60), rng, level=3, white_m=0.0, pinholes=0.0)
    (sphere,) = locate_spheres(points, faces, RADIUS_M)
    assert np.linalg.norm(sphere.centre_m - centre) < 1e-7
    assert abs(sphere.radius_residual_m) < 1e-7


def test_refusals_say_why() -> None:
    _, vertices, faces = _scene(2, 60, 5e-5)
    big = trimesh.creation.icosphere(subdivisions=4, radius=1.03 * RADIUS_M)
    more = np.concatenate([vertices, np.asarray(big.vertices) + np.array([0.0, 0.4, 0.1])])
    faces = np.concatenate([faces, np.asarray(big.faces) + len(vertices)])
    with pytest.raises(ComputeError) as caught:
        locate_spheres(more, faces, RADIUS_M, expected=7)
    assert "found 6 spheres" in str(caught.value)
    assert re.search(r"Refused candidates: \(-?0\.0, 400\.0, 100\.0\) mm .* \(rms 0\.4\d mm", str(caught.value))


def test_seeds_choose_the_spheres_and_their_order() -> None:
    centres, vertices, faces = _scene(3, 90, 5e-5)
    chosen = centres[[4, 1]] + [0.006, -0.005, 0.004]
    spheres = locate_spheres(vertices, faces, RADIUS_M, seeds_m=chosen)
    found = np.array([s.centre_m for s in spheres])
    np.testing.assert_allclose(found, centres[[4, 1]], atol=5e-5)
    with pytest.raises(ComputeError, match=r"no sphere .* at seed 1"):
        locate_spheres(vertices, faces, RADIUS_M, seeds_m=np.array([centres[0], [1.0, 1.0, 1.0]]))


def test_a_moved_sphere_is_named() -> None:
    rng = np.random.default_rng(7)
    centres = scattered_centres(rng, 9)
    sigma = 1e-5
    covariances = np.tile(sigma**2 * np.eye(3), (9, 1, 1))
    T = transform(np.eye(3), np.array([0.1, 0.2, 0.3]))
    for moved in (None, 4):
        b = centres + rng.normal(0, sigma, centres.shape)
        if moved is not None:
            b[moved] += [3e-4, 0, 0]
        b = apply(inverse(T), b)
        a = centres + rng.normal(0, sigma, centres.shape)
        closure = close_loop(a, covariances, b, covariances, match_constellations(a, b), systematic_sigma_m=0.0)
        assert [s.pair[0] for s in closure.moved] == ([] if moved is None else [moved])
        assert 0.3 < closure.chi2_per_dof < 2.5
        if moved is not None:
            assert np.linalg.norm(closure.moved[0].difference_m - [3e-4, 0, 0]) < 6e-5
            assert closure.moved[0].z > 10


def test_command_reads_clouds_and_writes_spheres(tmp_path: Path) -> None:
    centres, vertices, _ = _scene(4, 80, 5e-5)
    cloud, out = tmp_path / "scan.xyz", tmp_path / "spheres.json"
    np.savetxt(cloud, vertices * 1e3, fmt="%.4f")
    assert is_point_cloud(cloud)
    assert read_point_cloud(cloud).unit == "mm"
    seeds = ";".join(",".join(f"{1e3 * v:.1f}" for v in c) for c in centres)
    arguments = ["spheres", "--mesh", str(cloud), "--radius-mm", "15", "--out", str(out), "--seeds", seeds, "--json"]
    answer = CliRunner().invoke(app, arguments)
    assert answer.exit_code == 0, answer.output
    np.testing.assert_allclose(read_spheres_json(out).centres_m, centres, atol=8e-5)
    details = json.loads(out.read_text())["details"]
    assert np.shape([d["covariance_m2"] for d in details]) == (6, 3, 3)
