"""The score without spheres and posts: what was cut out no longer counts, and what is left does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from service.compute.surfaces.fuse import Markers
from service.compute.surfaces.surface import Surface, write_ply
from service.dataset.records import Mesh
from tests.support.scenes.specimen import score_specimen, specimen_of

CENTRE_M = np.array([0.0, 0.0, 0.03])
UP = np.array([0.0, 0.0, 1.0])
MARKERS = (Markers(CENTRE_M[None], 0.005, UP, 0.002, 0.05),)


def plate(z_m: float = 0.0, side_mm: int = 80) -> Surface:
    """A square plate at a height, of faces of 1 mm."""
    x, y = (g.ravel() * 0.001 - 0.0005 * side_mm for g in np.meshgrid(*2 * [np.arange(side_mm + 1)]))
    corner = (np.arange(side_mm)[:, None] * (side_mm + 1) + np.arange(side_mm)).ravel()
    across = corner + side_mm + 2
    faces = np.concatenate([np.stack([corner, corner + 1, across], 1), np.stack([corner, across, across - 1], 1)])
    return Surface(np.stack([x, y, np.full(len(x), z_m)], 1), faces.astype(np.int64))


def with_ball(surface: Surface) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.005)
    vertices = np.concatenate([surface.vertices_m, np.asarray(ball.vertices) + CENTRE_M])
    return Mesh(vertices, np.concatenate([surface.faces, np.asarray(ball.faces) + len(surface.vertices_m)]))


def test_faces_on_spheres_and_posts_are_cut_out_and_no_others() -> None:
    truth = with_ball(plate())
    bare = specimen_of(Surface(truth.vertices_m, truth.faces), MARKERS)
    assert bare.vertices_m[:, 2].max() == 0
    aside = np.hypot(bare.vertices_m[:, 0], bare.vertices_m[:, 1])
    assert 0.004 < aside.min() < 0.006
    assert len(bare.vertices_m) > 0.98 * len(plate().vertices_m)


@pytest.mark.slow
def test_a_missing_sphere_does_not_count_and_an_error_of_the_specimen_does(tmp_path: Path) -> None:
    side_mm = 48
    truth = with_ball(plate(side_mm=side_mm))
    for name, z_m in (("right", 0.0), ("off", 0.001)):
        write_ply(tmp_path / f"{name}.ply", plate(z_m, side_mm), 1.0, {}, ["metres"])
    right = score_specimen(tmp_path / "right.ply", truth, MARKERS)
    off = score_specimen(tmp_path / "off.ply", truth, MARKERS)
    assert right.completeness_mm < 2 * right.floor_mm
    assert abs(off.chamfer_mm - 1.0) < 0.05
