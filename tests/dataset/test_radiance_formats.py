"""The formats of radiance fields, converted as their readers do, against points whose places are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from service.compute.images.render import WorldSphere
from service.core.errors import DataError
from service.core.geometry import Array, inverse
from service.dataset.pixels import undistorted_data_set
from service.dataset.records import DataSet
from tests.support.scenes.posed import posed_data_set
from tests.support.scenes.read_formats import corners, document, picture, truth_px, written

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])


def test_nerfstudio_projects_points_to_their_pixels(dataset: DataSet, tmp_path: Path) -> None:
    folder = written(dataset, "nerfstudio", tmp_path)
    stated = document(folder / "transforms.json")
    for frame, view in zip(stated["frames"], dataset.views, strict=True):
        pose = np.array(frame["transform_matrix"])
        R, t = OPENCV_FROM_OPENGL @ pose[:3, :3].T, pose[:3, 3]
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]])
        distortion = np.array([frame[key] for key in ("k1", "k2", "p1", "p2")])
        pixels = cv2.projectPoints(corners(), cv2.Rodrigues(R)[0], -R @ t, K, distortion)[0].reshape(-1, 2)
        assert np.abs(pixels - 0.5 - truth_px(view)).max() < 0.01
        depth = picture(folder / frame["depth_file_path"])
        exact = dataset.pixels.depth_m(view)
        assert depth.dtype == np.uint16
        assert np.abs(depth * stated["depth_unit_scale_factor"] - exact).max() < 0.51e-4
        mask = picture(folder / frame["mask_path"])
        assert ((mask == 0) == dataset.pixels.markers(view)).all()
        assert (mask == 0).any()
    assert not set(stated["train_filenames"]) & set(stated["test_filenames"])


def ngp_matrix(stated: Any, matrix: Array) -> Array:
    """(3, 4) as Instant-NGP's and NeuS2's nerf_matrix_to_ngp make of a frame."""
    pose = matrix[:3].copy()
    pose[:, 1:3] *= -1
    pose[:, 3] = pose[:, 3] * stated["scale"] + np.array(stated["offset"])
    return pose if "from_na" in stated else pose[[1, 2, 0]]


def ngp_saved(stated: Any, points: Array) -> Array:
    """What Instant-NGP writes into a mesh file for points of its unit cube."""
    return (points - np.array(stated["offset"], dtype=np.float64)) / stated["scale"]


def test_instant_ngp_sees_the_solid_in_its_cube_and_its_meshes_come_back(dataset: DataSet, tmp_path: Path) -> None:
    folder = written(dataset, "instant-ngp", tmp_path)
    stated, box = document(folder / "transforms.json"), document(folder / "unit_box.json")
    # The solid in the unit cube of Instant-NGP, found from the poses alone: where the rays of its corners meet.
    cube = np.array([_meeting(dataset, stated, k) for k in range(len(corners()))])
    assert ((cube > 0.0) & (cube < 1.0)).all()
    saved = ngp_saved(stated, cube)
    assert np.abs(saved[:, box["mesh_axes"]] + box["centre_m"] - corners()).max() < 1e-6
    # The solid has no symmetry: another order of the axes does not fit.
    assert np.abs(saved + box["centre_m"] - corners()).max() > 0.02


@pytest.mark.parametrize("term", ["k3", "k4", "k5", "k6"])
def test_instant_ngp_is_not_given_a_lens_that_it_does_not_know(dataset: DataSet, tmp_path: Path, term: str) -> None:
    views = tuple(replace(v, camera=replace(v.camera, **{term: 0.01})) for v in dataset.views)
    with pytest.raises(DataError, match="knows only k1, k2, p1, p2"):
        written(replace(dataset, views=views), "instant-ngp", tmp_path)


def test_neus2_sees_the_solid_in_its_cube_and_its_meshes_come_back(dataset: DataSet, tmp_path: Path) -> None:
    folder = written(dataset, "neus2", tmp_path)
    stated, pinholes = document(folder / "transform.json"), undistorted_data_set(dataset)
    for frame in stated["frames"]:  # with from_na, NeuS2 flips the axes twice
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])).tolist()
    cube = np.array([_meeting(pinholes, stated, k) for k in range(len(corners()))])
    assert ((cube > 0.0) & (cube < 1.0)).all()
    box, saved = document(folder / "unit_box.json"), ngp_saved(stated, cube)
    assert np.abs(saved[:, box["mesh_axes"]] + box["centre_m"] - corners()).max() < 1e-6
    image = picture(folder / stated["frames"][0]["file_path"])
    assert image.shape[2] == 4
    assert set(np.unique(image[..., 3])) == {0, 255}
    # Its pixels have their corners at integers.
    for frame, view in zip(stated["frames"], pinholes.views, strict=True):
        pose = ngp_matrix(stated, np.array(frame["transform_matrix"]))
        seen = (cube - pose[:, 3]) @ pose[:, :3] @ np.array(frame["intrinsic_matrix"])[:3, :3].T
        assert np.abs(seen[:, :2] / seen[:, 2:] - 0.5 - truth_px(view)).max() < 0.01


def _meeting(dataset: DataSet, stated: Any, corner: int) -> Array:
    """Where the rays of a corner's pixels meet, in Instant-NGP's cube."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for frame, view in zip(stated["frames"], dataset.views, strict=True):
        pose = ngp_matrix(stated, np.array(frame["transform_matrix"]))
        x, y = view.camera.normalise(truth_px(view)[corner : corner + 1])[0]
        ray = pose[:, :3] @ np.array([x, y, 1.0])
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        normal += across
        right += across @ pose[:, 3]
    return np.linalg.solve(normal, right).astype(np.float64)


def test_dtu_projections_and_masks(dataset: DataSet, pinholes: DataSet, tmp_path: Path) -> None:
    folder = written(dataset, "dtu", tmp_path)
    with np.load(folder / "cameras.npz") as cameras:
        for k, view in enumerate(pinholes.views):
            # As IDR loads it: cv2 takes the projection apart.
            P = cameras[f"world_mat_{k}"] @ cameras[f"scale_mat_{k}"]
            K, R, place = cv2.decomposeProjectionMatrix(P[:3])[:3]
            unit = inverse(view.T_world_camera)
            assert np.abs(R - unit[:3, :3]).max() < 1e-9
            assert np.abs(K / K[2, 2] - view.camera.matrix).max() < 1e-6
            scale = cameras[f"scale_mat_{k}"]
            assert (
                np.abs(
                    scale[:3, :3] @ (place[:3] / place[3]).ravel() + scale[:3, 3] - view.T_world_camera[:3, 3]
                ).max()
                < 1e-9
            )
            sphere = (corners() - scale[:3, 3]) / scale[0, 0]
            assert np.linalg.norm(sphere, axis=1).max() <= 1 + 1e-12
            mask = picture(folder / "mask" / f"{k:06d}.png")
            image = picture(folder / "image" / f"{k:06d}.png")
            assert mask.shape == image.shape[:2]
            assert ((mask == 255) <= (pinholes.pixels.depth_m(view) > 0)).all()


def test_dtu_masks_show_the_solid_without_the_markers_in_front_of_it(tmp_path: Path) -> None:
    on_top = WorldSphere(np.array([0.02, 0.0, 0.045]), 0.012)
    folder = tmp_path / "photographs"
    folder.mkdir()
    dataset = posed_data_set(folder, more_spheres=(on_top,))
    exported, pinholes = written(dataset, "dtu", tmp_path), undistorted_data_set(dataset)
    for k, view in enumerate(pinholes.views):
        mask = picture(exported / "mask" / f"{k:06d}.png")
        solid, markers = pinholes.pixels.depth_m(view) > 0, pinholes.pixels.markers(view)
        assert (solid & markers).sum() > 20
        assert ((mask == 255) == (solid & pinholes.pixels.valid(view) & ~markers)).all()
        assert set(np.unique(mask)) == {0, 255}
