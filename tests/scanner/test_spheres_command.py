"""`orthocapture spheres`: limits by option, weak caps, low-polygon and large scans."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

from service.cli.main import app
from service.compute.surfaces.mesh_spheres import locate_spheres
from service.core.errors import ComputeError
from service.core.geometry import Array

CENTRES_MM = np.array([[0.0, 0, 0], [90, 10, 5], [30, 110, -8]])


def _run(mesh: Path, out: Path, *more: str) -> Result:
    words = ["spheres", "--mesh", str(mesh), "--out", str(out), *more]
    return CliRunner().invoke(app, words, catch_exceptions=False)


def _balls(path: Path, radius_mm: float, *, noise_mm: float = 0.0, far_mm: float = 0.0, scale: float = 1.0) -> Path:
    rng = np.random.default_rng(3)
    parts: list[trimesh.Trimesh] = []
    for centre in CENTRES_MM:
        ball = trimesh.creation.icosphere(subdivisions=4, radius=radius_mm)
        rough = rng.normal(0, noise_mm, (len(ball.vertices), 1)) * ball.vertices / radius_mm
        ball.vertices = ball.vertices + rough + centre
        parts.append(ball)
    if far_mm:
        parts.append(trimesh.creation.box(extents=[10, 10, 10]).apply_translation([far_mm, 0, 0]))
    mesh = trimesh.util.concatenate(parts)
    mesh.apply_scale(scale)
    mesh.export(path)
    return path


def test_a_rough_ball_is_refused_with_the_limits_and_accepted_by_option(tmp_path: Path) -> None:
    mesh = _balls(tmp_path / "ct.stl", 8.0, noise_mm=0.24)
    out = tmp_path / "spheres.json"
    refused = _run(mesh, out, "--radius-mm", "8", "--mesh-unit", "mm")
    assert refused.exit_code == 1
    assert "at most 0.20" in refused.output
    assert "--max-rms-mm 0.2, --max-radius-off-mm 0.32, --max-form-mm 0.08, --min-cap-deg 50" in refused.output
    assert not out.exists()
    done = _run(mesh, out, "--radius-mm", "8", "--mesh-unit", "mm", "--max-rms-mm", "0.4", "--expect", "3")
    assert done.exit_code == 0, done.output


@pytest.mark.parametrize(("given", "more"), [("9", ""), ("10.6", ""), ("19.5", "the radius, not the diameter")])
def test_a_wrong_radius_is_told_with_the_one_that_the_spheres_have(tmp_path: Path, given: str, more: str) -> None:
    mesh = _balls(tmp_path / "ball.stl", 9.75)
    refused = _run(mesh, tmp_path / "a.json", "--radius-mm", given, "--mesh-unit", "mm", "--expect", "3")
    assert refused.exit_code == 1
    words = " ".join(refused.output.split())
    assert "There are 3 spheres of radius 9.7" in words
    assert "give --radius-mm 9.7" in words
    assert more in words


@pytest.mark.slow
def test_a_ball_of_another_radius_is_accepted_by_option(tmp_path: Path) -> None:
    mesh = _balls(tmp_path / "ball.stl", 9.75)
    words = ("--radius-mm", "9.4", "--mesh-unit", "mm", "--seeds", "0,0,0")
    assert _run(mesh, tmp_path / "a.json", *words).exit_code == 1
    more = ("--max-radius-off-mm", "0.7", "--max-rms-mm", "0.6", "--max-form-mm", "0.6")
    assert _run(mesh, tmp_path / "b.json", *words, *more).exit_code == 0


def test_a_scan_of_a_room_in_metres_is_read(tmp_path: Path) -> None:
    mesh = _balls(tmp_path / "room.ply", 15.0, far_mm=6500, scale=1e-3)
    out = tmp_path / "spheres.json"
    done = _run(mesh, out, "--radius-mm", "15", "--mesh-unit", "m", "--expect", "3")
    assert done.exit_code == 0, done.output
    found = np.array(json.loads(out.read_text())["registration_mm"])
    for centre in CENTRES_MM:
        assert np.linalg.norm(found - centre, axis=1).min() < 0.05


def test_an_unwritable_output_is_told_before_the_mesh_is_read(tmp_path: Path) -> None:
    done = _run(tmp_path / "none.stl", tmp_path / "nowhere" / "spheres.json", "--radius-mm", "15")
    assert done.exit_code == 1
    assert "folder of the file to write does not exist" in done.output


def _fillet(radius: float) -> tuple[Array, NDArray[np.int64]]:
    """A narrow strip of a sphere, like a fillet between two surfaces, which continue as planes."""
    along, across = np.meshgrid(np.linspace(-1.2, 1.2, 40), np.linspace(-0.16, 0.16, 8))
    points = radius * np.stack(
        [np.sin(along) * np.cos(across), np.sin(across), np.cos(along) * np.cos(across)], axis=-1
    )  # fmt: skip
    i = np.arange(points.shape[0] * points.shape[1]).reshape(points.shape[:2])
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    return points.reshape(-1, 3), np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])


def test_a_strip_of_a_sphere_is_no_cap() -> None:
    points, faces = _fillet(0.015)
    with pytest.raises(ComputeError, match=r"its cap is \d+° wide, 50° are needed"):
        locate_spheres(points, faces, 0.015)


@pytest.mark.slow
def test_models_of_few_vertices_never_end_in_a_fault() -> None:
    # Long facets cover a sphere's area with vertices at two places: a matrix of rank two (LinAlgError).
    rng = np.random.default_rng(1)
    for _ in range(120):
        ball = trimesh.creation.icosphere(subdivisions=int(rng.integers(0, 3)), radius=1.0)
        points = np.array(ball.vertices) * rng.uniform(0.2, 2, 3) * 10 ** rng.uniform(-3, 0)
        size = float(np.ptp(points))
        points += rng.normal(0, rng.choice([0, 0.02, 0.1]) * size, points.shape)
        post = trimesh.creation.cylinder(radius=rng.uniform(0.1, 1) * size, height=size, sections=12)
        faces = np.concatenate([ball.faces, np.array(post.faces) + len(points)])
        points = np.concatenate([points, np.array(post.vertices)])[faces].reshape(-1, 3)
        radius = float(size * rng.uniform(0.05, 1.5))
        try:
            found = locate_spheres(
                points, np.arange(len(points)).reshape(-1, 3), radius, seeds_m=points[rng.integers(0, len(points), 1)]
            )
        except ComputeError:
            continue
        for sphere in found:
            assert sphere.n >= 20
            assert abs(sphere.radius_residual_m) <= 0.1 * radius
