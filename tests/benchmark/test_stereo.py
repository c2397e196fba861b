"""Dense stereo on a processor: pairs, depth, fusion, and the whole method on images of a scene that is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from service.benchmark.methods import methods, missing
from service.benchmark.running import Trial, run_trial
from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh
from service.compute.stereo.matching import (
    StereoView,
    depth_of_pair,
    guided_depth,
    looked_at_m,
    rectified,
    stereo_pairs,
)
from service.compute.stereo.reconstruct import fused, surface_of
from service.compute.surfaces.chamfer import ChamferSettings
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, look_at
from service.dataset.records import DataSet
from tests.support.scenes.depth_of_sphere import depth_of_sphere
from tests.support.scenes.slab_data_set import slab_data_set, slab_mesh, slab_scene
from tests.support.scenes.textured_scene import render

PINHOLE = CameraModel(320, 240, 450.0, 450.0, 159.5, 119.5)
UP = np.array([0.0, 1.0, 0.1])


def height_m(places: Array) -> Array:
    """Height of the uppermost slab at places (N, 2)."""
    out = np.zeros(len(places))
    for slab in slab_scene():
        inside = ((places > slab.low) & (places < slab.high)).all(axis=1)
        out[inside] = np.maximum(out[inside], slab.z)
    return out


def eye_at(angle_deg: float, tilt_deg: float = 25.0) -> Transform:
    angle, tilt = np.radians([angle_deg, tilt_deg])
    out = np.array([np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), np.cos(tilt)])
    return look_at(0.6 * out, np.array([0.0, 0.0, 0.02]), UP)


def seen_from(T_world_camera: Transform) -> StereoView:
    return StereoView(render(slab_scene(), PINHOLE, T_world_camera, 1), PINHOLE, T_world_camera)


def blank(T_world_camera: Transform) -> StereoView:
    return StereoView(np.zeros((240, 320), dtype=np.uint8), PINHOLE, T_world_camera)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    return slab_data_set(tmp_path_factory.mktemp("slabs"))


def test_the_cameras_look_at_one_point() -> None:
    views = [blank(eye_at(angle)) for angle in (0, 80, 200)]
    assert np.abs(looked_at_m(views) - [0, 0, 0.02]).max() < 1e-9
    with pytest.raises(ComputeError, match="look in parallel"):
        looked_at_m([views[0], blank(views[0].T_world_camera + np.eye(4, k=3) * 0.1)])


def test_pairs_have_useful_angles_and_lonely_views_get_wider_ones() -> None:
    near = [blank(eye_at(angle)) for angle in (0, 20, 40, 42)]
    lonely = blank(eye_at(130))
    pairs = stereo_pairs([*near, lonely])
    assert (2, 3) not in pairs, "too narrow to measure depth"
    assert {(0, 1), (1, 2)} <= set(pairs)
    assert any(4 in pair for pair in pairs), "a lonely view has a partner"
    with pytest.raises(ComputeError, match="no two images"):
        stereo_pairs([blank(eye_at(0, 45)), blank(eye_at(180, 45))])


@pytest.mark.slow
def test_the_depth_of_a_pair_is_that_of_the_scene() -> None:
    views = [seen_from(eye_at(0)), seen_from(eye_at(30))]
    pair = rectified(views[0], views[1], looked_at_m(views))
    found = depth_of_pair(pair, 0.58)
    assert found is not None
    points = found.points_m(1)
    around = [height_m(points[:, :2] + step) for step in ((0, 0), (0.006, 0), (-0.006, 0), (0, 0.006), (0, -0.006))]
    flat = (np.ptp(around, axis=0) == 0) & (np.abs(points[:, :2]).max(axis=1) < 0.15)  # no edge is near
    error_m = np.abs(points[flat, 2] - around[0][flat])
    assert flat.sum() > 10_000
    assert np.isfinite(found.depth_m).mean() > 0.3
    assert np.median(error_m) < 1e-3
    assert np.mean(error_m < 5e-3) > 0.9


def test_near_a_guess_that_is_wrong_by_millimetres_the_depth_is_found() -> None:
    pair = rectified(seen_from(eye_at(0)), seen_from(eye_at(30)), np.array([0.0, 0.0, 0.02]))
    guess = slab_mesh()
    lifted = RayMesh(guess.vertices_m + np.array([0.0, 0.0, 0.012]), guess.faces)
    found = guided_depth(pair, lifted, 0.58)
    assert found is not None
    points = found.points_m(3)
    inside = np.abs(points[:, :2]).max(axis=1) < 0.12
    error_m = np.abs(points[inside, 2] - height_m(points[inside, :2]))
    assert np.median(error_m) < 6e-4
    assert inside.sum() > 1500


def test_images_of_different_things_give_no_depth() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (2, 240, 320)).astype(np.uint8)
    views = [StereoView(noise[k], PINHOLE, eye_at(20.0 * k)) for k in range(2)]
    assert depth_of_pair(rectified(views[0], views[1], looked_at_m(views)), 0.58) is None


def test_depth_maps_of_a_sphere_become_a_sphere_with_faces_outward() -> None:
    eyes = [np.array(eye) * 0.3 for eye in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))]
    maps = [depth_of_sphere(look_at(eye, np.zeros(3), np.array([0.3, 0.5, 0.8])), 0.05) for eye in eyes]
    found = surface_of(fused(maps, 0.002, 1), 1)
    radii = np.linalg.norm(found.vertices_m, axis=1)
    assert np.median(np.abs(radii - 0.05)) < 1e-4
    assert np.abs(radii - 0.05).max() < 1e-3, "half a voxel, where all maps see it at grazing angles"
    assert abs(found.area_m2 - 4 * np.pi * 0.05**2) < 0.03 * found.area_m2
    outward = np.einsum("ni,ni->n", found.face_normals, found.vertices_m[found.faces[:, 0]])
    assert np.mean(outward > 0) > 0.99
    # Tiles and blocks leave no seam: every edge has two faces.
    edges = np.sort(np.concatenate([found.faces[:, [0, 1]], found.faces[:, [1, 2]], found.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).mean() > 0.99


def test_a_place_that_too_few_maps_see_is_left_out() -> None:
    one = depth_of_sphere(look_at(np.array([0.3, 0, 0]), np.zeros(3), UP), 0.05)
    with pytest.raises(ComputeError, match="no place is seen by 2 pairs"):
        fused([one], 0.002, 2)


def test_the_method_needs_nothing_else() -> None:
    assert missing(methods()["stereo"]) == ""


@pytest.mark.slow
@pytest.mark.sweep  # a small run of it: test_benchmark_command.py
def test_the_benchmark_scores_the_stereo_method_on_images_alone(dataset: DataSet, tmp_path: Path) -> None:
    trial = Trial(methods()["stereo"], "dense", tmp_path, settings=ChamferSettings(spacing_m=2e-3))
    result = run_trial(trial, dataset)
    assert result.score is not None, result.failure
    assert result.views == 12
    assert result.score.accuracy_mm < 1.2
    assert result.score.chamfer_mm < 2.5
    assert not list((tmp_path / "stereo-dense" / "data").rglob("*.ply")), "the truth is not among the files"
