"""Every export format, read back by a reader that is not ours, against points whose places are known."""

from __future__ import annotations

import csv
import dataclasses
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import trimesh

from service.core.geometry import apply, inverse
from service.dataset.exporter import exporters
from service.dataset.formats.hdf5 import data_set_of_folder
from service.dataset.records import DataSet, Mesh
from tests.support.scenes.posed import scene
from tests.support.scenes.read_formats import check_depth, corners, document, picture, truth_px, written

NAMES = {
    "colmap", "colmap-binary", "colmap-pinhole", "sugar", "eth3d", "nerfstudio", "instant-ngp", "neus2", "dtu", "bop",
    "hdf5", "gltf", "plain", "matching", "mcap",
}  # fmt: skip
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])


def test_every_format_is_found() -> None:
    assert set(exporters()) == NAMES


# --- plain files, BOP, HDF5, glTF -------------------------------------------------------------------------------


def test_plain_files_hold_camera_poses_mesh_and_the_photographs(dataset: DataSet, tmp_path: Path) -> None:
    folder = written(dataset, "plain", tmp_path)
    lens = document(folder / "camera.json")
    K = np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1]])
    distortion = np.array([lens.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")])
    names = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1, usecols=0, dtype=str)
    poses = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1, usecols=range(1, 8))
    frames = {frame["file_path"]: frame for frame in document(folder / "transforms.json")["frames"]}
    assert list(names) == [view.file for view in dataset.views]
    for name, (*t, qx, qy, qz, qw), view in zip(names, poses, dataset.views, strict=True):
        R = trimesh.transformations.quaternion_matrix([qw, qx, qy, qz])[:3, :3]
        pixels = cv2.projectPoints(corners(), cv2.Rodrigues(R.T)[0], -R.T @ t, K, distortion)[0].reshape(-1, 2)
        assert np.abs(pixels - truth_px(view)).max() < 0.01
        same = np.array(frames[f"images/{name}"]["transform_matrix"])
        assert np.abs(same[:3, :3] @ OPENCV_FROM_OPENGL - R).max() < 1e-9
        assert np.abs(same[:3, 3] - t).max() < 1e-12
        assert np.array_equal(picture(folder / "images" / name), dataset.pixels.colours(view))
    mesh = trimesh.load_mesh(folder / "mesh.ply", process=False)
    assert np.array_equal(np.asarray(mesh.vertices), dataset.mesh.vertices_m)
    assert np.array_equal(np.asarray(mesh.faces), dataset.mesh.faces)


@pytest.fixture
def fused(dataset: DataSet) -> DataSet:
    """The data set as if its mesh had been fused from CT and scan."""
    n = len(dataset.mesh.vertices_m)
    source, sigma_m = (np.arange(n) % 3).astype(np.uint8), 1e-5 * (1.0 + np.arange(n))
    return dataclasses.replace(dataset, mesh=dataclasses.replace(dataset.mesh, source=source, sigma_m=sigma_m))


def test_a_fused_mesh_has_source_and_sigma_of_each_vertex(fused: DataSet, dataset: DataSet, tmp_path: Path) -> None:
    source, sigma_m = fused.mesh.source, fused.mesh.sigma_m
    assert source is not None
    assert sigma_m is not None
    mesh = trimesh.load_mesh(written(fused, "plain", tmp_path) / "mesh.ply", process=False)
    told = mesh.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(np.asarray(mesh.vertices), dataset.mesh.vertices_m)
    assert np.array_equal(np.asarray(told["source"]).ravel(), source)
    assert np.asarray(told["sigma_m"]).ravel() == pytest.approx(sigma_m, rel=1e-6)
    with h5py.File(written(fused, "hdf5", tmp_path) / "data.h5") as file:
        stored: Any = file["mesh"]
        assert np.array_equal(stored["source"], source)
        assert np.array_equal(stored["sigma_m"], sigma_m)
    again = data_set_of_folder(tmp_path / "hdf5").mesh
    assert again.sigma_m is not None
    assert np.array_equal(again.sigma_m, sigma_m)
    (tmp_path / "scan").mkdir()
    with h5py.File(written(dataset, "hdf5", tmp_path / "scan") / "data.h5") as file:
        stored = file["mesh"]
        assert set(stored) == {"vertices_m", "faces"}


def test_bop_model_projects_to_the_depth_image(dataset: DataSet, pinholes: DataSet, tmp_path: Path) -> None:
    folder = written(dataset, "bop", tmp_path)
    scene_folder = folder / "test" / "000001"
    cameras, poses = (document(scene_folder / f"scene_{name}.json") for name in ("camera", "gt"))
    model = trimesh.load_mesh(folder / "models" / "obj_000001.ply", process=False)
    info = document(folder / "models" / "models_info.json")["1"]
    lens, camera = document(folder / "camera.json"), pinholes.views[0].camera
    assert [lens[key] for key in ("fx", "fy", "cx", "cy")] == [camera.fx, camera.fy, camera.cx, camera.cy]
    assert (lens["width"], lens["height"]) == (camera.width, camera.height)
    assert {of_view["depth_scale"] for of_view in cameras.values()} == {lens["depth_scale"]}
    assert info["diameter"] == pytest.approx(
        max(np.linalg.norm(a - b) for a in model.vertices for b in model.vertices), rel=1e-9
    )
    for key, view in zip(cameras, pinholes.views, strict=True):
        (pose,) = poses[key]
        K = np.array(cameras[key]["cam_K"]).reshape(3, 3)
        R, t_mm = np.array(pose["cam_R_m2c"]).reshape(3, 3), np.array(pose["cam_t_m2c"])
        pixels = cv2.projectPoints(np.asarray(model.vertices), cv2.Rodrigues(R)[0], t_mm, K, np.zeros(4))[0]
        assert np.abs(pixels.reshape(-1, 2) - truth_px(view)).max() < 0.01
        coded = cv2.imread(str(scene_folder / "depth" / f"{int(key):06d}.png"), cv2.IMREAD_UNCHANGED)
        check_depth(view, coded * cameras[key]["depth_scale"] / 1e3, 1e-4)


def test_the_loader_of_hdf5_needs_only_numpy_and_h5py(dataset: DataSet, tmp_path: Path) -> None:
    folder = written(dataset, "hdf5", tmp_path)
    script = (
        "import loader, sys; views = loader.Views('.'); views[0]; "
        "print(len(views), any(module.startswith('service') for module in sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, env={}, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [str(len(dataset.views)), "False"]


def test_the_ten_lines_of_the_documents_project_the_mesh_onto_the_image(dataset: DataSet, tmp_path: Path) -> None:
    fine = scene().mesh
    for _ in range(4):
        fine = fine.subdivide()
    vertices = np.asarray(fine.vertices)
    dense = dataclasses.replace(dataset, mesh=Mesh(vertices, np.asarray(fine.faces, dtype=np.int64)))
    folder = written(dense, "hdf5", tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "dataset.md").read_text(encoding="utf-8")
    (snippet,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len([line for line in snippet.splitlines() if line]) == 10
    script = snippet + "np.savez('found.npz', pixels=pixels, shown=shown, colours=colours, image=view['image'])\n"
    subprocess.run([sys.executable, "-c", script], cwd=folder, env={}, check=True)
    view = dataset.views[0]
    with np.load(folder / "found.npz") as found:
        pixels, shown, image = found["pixels"], found["shown"], found["image"][..., 2].astype(np.float64)
        assert np.abs(pixels - view.camera.project(apply(inverse(view.T_world_camera), vertices))).max() < 0.01
        assert 0.2 < np.mean(shown) < 0.8  # the rest is behind the solid
        column, row = np.rint(pixels[shown]).astype(int).T
        assert np.array_equal(found["colours"][:, 2], image[row, column])
    # Where the photograph itself has the vertices: the shift that best explains their brightness.
    slopes = np.stack([slope[row, column] for slope in np.gradient(image)[::-1]], axis=1)
    smooth = np.linalg.norm(slopes, axis=1) < 8  # not at an edge of the solid
    off = scene().tone(vertices[shown]) - image[row, column]
    off -= np.sum(slopes * (pixels[shown] - np.stack([column, row], axis=1)), axis=1)
    shift_px = np.linalg.lstsq(slopes[smooth], off[smooth], rcond=None)[0]
    assert np.count_nonzero(smooth) > 300
    assert np.abs(shift_px).max() < 0.5


def test_hdf5_is_the_same_while_a_profiler_holds_what_the_writer_has_left(dataset: DataSet, tmp_path: Path) -> None:
    """A Dask worker's profiler holds frames, and so their arrays, for a moment; this one holds them to the end."""
    alone, watched = tmp_path / "alone", tmp_path / "watched"
    alone.mkdir()
    watched.mkdir()
    hdf5 = written(dataset, "hdf5", alone)
    held: list[FrameType] = []
    before = sys.getprofile()
    sys.setprofile(lambda frame, _event, _argument: held.append(frame))
    try:
        again = written(dataset, "hdf5", watched)
    finally:
        sys.setprofile(before)
    files = list(hdf5.rglob("*.h5"))
    assert len(files) == len(dataset.views) + 1
    for file in files:
        assert (again / file.relative_to(hdf5)).read_bytes() == file.read_bytes(), file.name


def test_hdf5_holds_image_depth_and_pose(dataset: DataSet, tmp_path: Path) -> None:
    folder = written(dataset, "hdf5", tmp_path)
    specification = importlib.util.spec_from_file_location("exported_loader", folder / "loader.py")
    assert specification is not None
    assert specification.loader is not None
    loader: Any = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(loader)
    with h5py.File(folder / "data.h5") as file:
        for split, names in dataset.splits.named().items():
            assert loader.Views(folder, split).names == list(names)
            assert file[f"splits/{split}"].dtype.kind == "S", "a split without views is text, too"  # type: ignore[union-attr]
    sparse, shown = loader.Views(folder, "train"), scene()
    views = {view.name: view for view in dataset.views}
    assert list(sparse.names) == list(dataset.splits.train)
    for item in (sparse[k] for k in range(len(sparse))):
        R, t = item["T_world_camera"][:3, :3], item["T_world_camera"][:3, 3]
        pixels = cv2.projectPoints(corners(), cv2.Rodrigues(R.T)[0], -R.T @ t, item["K"], item["distortion"])[0]
        assert np.abs(pixels.reshape(-1, 2) - truth_px(views[item["name"]])).max() < 1e-6
        assert item["image"].shape == (*item["depth_m"].shape, 3)
        # The colour at a pixel is that of the place where its depth puts it: image, depth and pose belong together.
        v, u = (k.ravel() for k in np.mgrid[8:112:5, 8:152:5])
        rays = cv2.undistortPoints(np.stack([u, v], 1).astype(float), item["K"], item["distortion"]).reshape(-1, 2)
        z = item["depth_m"][v, u].astype(np.float64)
        world = np.column_stack([rays * z[:, None], z]) @ R.T + t
        red = item["image"][v, u, 2].astype(np.float64)
        assert np.median(np.abs(red - shown.tone(world))[z > 0]) < 1.5
        assert item["covariance"].shape == (6, 6)


def test_trimesh_reads_the_gltf_with_its_cameras(dataset: DataSet, tmp_path: Path) -> None:
    file = written(dataset, "gltf", tmp_path) / "scene.glb"
    loaded, content = trimesh.load_scene(file), file.read_bytes()
    cameras = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])["cameras"]
    lenses = [camera["perspective"] for camera in cameras]
    (mesh,) = loaded.geometry.values()
    assert np.abs(mesh.bounds - scene().mesh.bounds).max() < 1e-7
    assert mesh.volume == pytest.approx(scene().mesh.volume, rel=1e-5)
    for view, lens in zip(dataset.views, lenses, strict=True):
        camera, depth_m = view.camera, dataset.pixels.depth_m(view)
        assert lens["yfov"] == pytest.approx(2 * np.arctan2(camera.height / 2, camera.fy))
        assert lens["aspectRatio"] == pytest.approx(camera.width / camera.height * camera.fy / camera.fx)
        assert 0 < lens["znear"] < 0.5 * depth_m[depth_m > 0].min()
        pose = np.asarray(loaded.graph.get(view.name)[0])
        assert np.abs(pose[:3, :3] @ np.diag([1, -1, -1]) - view.T_world_camera[:3, :3]).max() < 1e-6
        assert np.abs(pose[:3, 3] - view.T_world_camera[:3, 3]).max() < 1e-6


# --- what is common to all --------------------------------------------------------------------------------------


def says_simulated(path: Path) -> bool:
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            return bool(file.attrs["simulated"])
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            return bool(arrays["simulated"])
    if path.suffix == ".csv":
        with path.open(encoding="utf-8") as table:
            return {row["simulated"] for row in csv.DictReader(table)} == {"true"}
    return b"simulated" in path.read_bytes().lower()


#: Files that cannot say it: bare numbers, or a form of which every key is a number of an image.
SILENT = (
    "*.bin", "scene_*.json", "models_info.json", "SHA256SUMS", "loader.py", "ground_truth_depth/*/*",
    "poses.csv",
)  # fmt: skip


@pytest.mark.parametrize("name", sorted(NAMES))
def test_a_simulated_data_set_says_so_in_every_file_that_can(dataset: DataSet, tmp_path: Path, name: str) -> None:
    folder = written(dataset, name, tmp_path)
    files = [path for path in folder.rglob("*") if path.is_file()]
    heard = [path for path in files if not any(path.relative_to(folder).match(form) for form in SILENT)]
    assert heard
    assert [path.name for path in heard if not says_simulated(path)] == []
    assert document(folder / "splits.json")["dense"] == [view.name for view in dataset.views]


@pytest.mark.parametrize("name", ["bop", "eth3d", "plain"])
def test_a_mesh_says_only_of_a_simulated_data_set_that_it_is(dataset: DataSet, tmp_path: Path, name: str) -> None:
    real = dataclasses.replace(dataset, simulated=False)
    for exported, said in ((dataset, [f"comment {dataset.mark}".encode()]), (real, [])):
        folder = tmp_path / str(exported.simulated)
        folder.mkdir()
        (mesh,) = written(exported, name, folder).rglob("*.ply")
        head = mesh.read_bytes().partition(b"end_header\n")[0].splitlines()
        assert [line for line in head if line.startswith(b"comment")] == said
        assert not trimesh.load_mesh(mesh).is_empty


@pytest.mark.parametrize("name", sorted(NAMES))
def test_the_checksums_are_those_of_every_file(dataset: DataSet, tmp_path: Path, name: str) -> None:
    folder = written(dataset, name, tmp_path)
    done = subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=folder, check=False)
    assert done.returncode == 0
    stated = {line.split("  ", 1)[1] for line in (folder / "SHA256SUMS").read_text().splitlines()}
    assert stated == {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()} - {"SHA256SUMS"}
