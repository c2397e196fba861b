"""The formats of COLMAP's readers, read by pycolmap against points whose places are known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import trimesh
from PIL import Image

from service.core.errors import DataError
from service.dataset.records import DataSet
from tests.support.scenes.posed import scene
from tests.support.scenes.read_formats import check_depth, corners, picture, truth_px, written


@pytest.mark.parametrize("name", ["colmap", "colmap-binary", "colmap-pinhole", "sugar"])
def test_pycolmap_projects_points_to_their_pixels(
    dataset: DataSet, pinholes: DataSet, tmp_path: Path, name: str
) -> None:
    folder = written(dataset, name, tmp_path)
    expected = dataset if name in ("colmap", "colmap-binary") else pinholes
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    images = {image.name: image for image in model.images.values()}
    assert set(images) == {view.file for view in dataset.views}
    for view in expected.views:
        camera = model.cameras[images[view.file].camera_id]
        assert camera.model.name == ("OPENCV" if expected is dataset else "PINHOLE")
        for point, truth in zip(corners(), truth_px(view), strict=True):
            assert np.abs(images[view.file].project_point(point) - 0.5 - truth).max() < 0.01
        with Image.open(folder / "images" / view.file) as picture:
            assert picture.size == (camera.width, camera.height)


@pytest.mark.parametrize("name", ["colmap", "colmap-binary"])
@pytest.mark.parametrize("term", ["k3", "k4", "k5", "k6"])
def test_a_lens_with_more_terms_has_them_all_in_the_model(
    dataset: DataSet, tmp_path: Path, name: str, term: str
) -> None:
    view = dataset.views[0]
    bent = dataclasses.replace(view, camera=dataclasses.replace(view.camera, **{term: 0.01}))
    folder = written(dataclasses.replace(dataset, views=(bent, *dataset.views[1:])), name, tmp_path)
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    (image,) = (image for image in model.images.values() if image.name == view.file)
    assert model.cameras[image.camera_id].model.name == "FULL_OPENCV"
    pixels = np.array([image.project_point(point) for point in corners()])
    assert np.abs(pixels - 0.5 - truth_px(bent)).max() < 0.01


@pytest.mark.parametrize("name", ["colmap", "colmap-binary", "colmap-pinhole"])
def test_a_model_of_cameras_alone_has_no_points(dataset: DataSet, tmp_path: Path, name: str) -> None:
    """An invented point would count as measured for whoever triangulates from these poses."""
    model = pycolmap.Reconstruction(str(written(dataset, name, tmp_path) / "sparse" / "0"))
    assert (len(model.points3D), model.num_reg_images()) == (0, len(dataset.views))


@pytest.mark.parametrize("name", ["colmap", "colmap-pinhole", "sugar", "eth3d"])
def test_an_image_name_that_colmaps_text_cannot_hold_is_refused(dataset: DataSet, tmp_path: Path, name: str) -> None:
    first, *others = dataset.views
    spaced = dataclasses.replace(dataset, views=(dataclasses.replace(first, name="view 1"), *others))
    with pytest.raises(DataError, match=r"cannot hold image names with spaces.*view 1\.png"):
        written(spaced, name, tmp_path)


def test_the_undistorted_images_show_the_solid_where_pycolmap_projects_it(dataset: DataSet, tmp_path: Path) -> None:
    folder, shown = written(dataset, "colmap-pinhole", tmp_path), scene()
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    points = trimesh.sample.sample_surface(shown.mesh, 4000, seed=5)[0]
    top = points[np.abs(points[:, 2] - 0.03) < 1e-9]  # nothing hides it from above but the tall part
    top = top[(top[:, 0] < 0.0) & (np.abs(top[:, 1]) < 0.02) & (top[:, 0] > -0.07)]
    for image in model.images.values():
        grey = picture(folder / "images" / image.name)[..., 0].astype(np.float64)
        pixels = np.array([image.project_point(point) for point in top]) - 0.5
        u, v = np.rint(pixels).astype(int).T
        error = grey[v, u] - shown.tone(top)
        assert np.sqrt(np.mean(error**2)) < 4


def test_the_points_of_sugar_are_in_the_scene_and_tell_nothing_of_the_surface(
    dataset: DataSet, tmp_path: Path
) -> None:
    model = pycolmap.Reconstruction(str(written(dataset, "sugar", tmp_path) / "sparse" / "0"))
    points = np.array([point.xyz for point in model.points3D.values()])
    low, high = scene().mesh.bounds
    assert len(points) == 100_000
    assert (points >= low).all()
    assert (points <= high).all()
    assert np.abs(points.mean(axis=0) - (low + high) / 2).max() < 0.01 * (high - low).max()


def test_eth3d_has_depth_and_scan(dataset: DataSet, pinholes: DataSet, tmp_path: Path) -> None:
    folder = written(dataset, "eth3d", tmp_path)
    model = pycolmap.Reconstruction(str(folder / "dslr_calibration_undistorted"))
    for image in model.images.values():  # ETH3D's own sets name them so, and their image_path is images/
        assert (folder / "images" / image.name).is_file()
        assert image.name.startswith("dslr_images_undistorted/")
    images = {Path(image.name).name: image for image in model.images.values()}
    assert set(images) == {view.file for view in dataset.views}
    for view in pinholes.views:
        projected = np.array([images[view.file].project_point(point) for point in corners()])
        assert np.abs(projected - 0.5 - truth_px(view)).max() < 0.01
    mesh = trimesh.load_mesh(folder / "dslr_scan_eval" / "scan1.ply")
    assert np.abs(mesh.bounds - scene().mesh.bounds).max() < 1e-12
    for view in pinholes.views:
        raw = np.fromfile(folder / "ground_truth_depth" / "dslr_images_undistorted" / view.file, "<f4")
        depth = raw.reshape(view.camera.height, view.camera.width)
        assert np.isinf(depth).any()
        check_depth(view, depth, 1e-6)
