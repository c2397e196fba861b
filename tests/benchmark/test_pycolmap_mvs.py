"""COLMAP's dense steps in pycolmap: the depth maps, which need a GPU, are replaced by the true ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from drivers.meshes.surface_file import read_surface_file
from service.benchmark.methods import methods, missing
from service.benchmark.programs import patch_match, triangulate
from service.compute.images.render import RayMesh
from service.core.errors import ComputeError
from service.core.geometry import Array, transform
from service.dataset.exporter import exporter, write_data_set
from tests.support.scenes.slab_data_set import slab_data_set, slab_mesh, slab_scene


def write_map(path: Path, values: Array) -> None:
    """Write an array (H, W, C) as COLMAP writes depth and normal maps."""
    height, width, channels = values.shape
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + values.transpose(2, 0, 1).astype("<f4").tobytes())


def write_true_maps(dense: Path) -> None:
    """What PatchMatch would find if it made no error, for every image of a workspace."""
    truth = slab_mesh()
    surface = RayMesh(truth.vertices_m, truth.faces)
    model = pycolmap.Reconstruction(str(dense / "sparse"))
    for image in model.images.values():
        camera, matrix = model.cameras[image.camera_id], image.cam_from_world().inverse().matrix()
        pose = transform(matrix[:, :3], matrix[:, 3])
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        pixels = np.stack([column, row, np.ones_like(row)], axis=-1).reshape(-1, 3)
        depth = np.nan_to_num(surface.depths(pose, pixels @ np.linalg.inv(camera.calibration_matrix()).T))
        shape = (camera.height, camera.width, -1)
        normals = np.broadcast_to(pose[2, :3], (len(depth), 3))  # all slabs are level
        write_map(dense / "stereo" / "depth_maps" / f"{image.name}.geometric.bin", depth.reshape(shape))
        write_map(dense / "stereo" / "normal_maps" / f"{image.name}.geometric.bin", normals.reshape(shape))


def write_empty_maps(dense: Path) -> None:
    """What PatchMatch finds of a scene without texture."""
    write_true_maps(dense)
    for path in (dense / "stereo" / "depth_maps").glob("*.geometric.bin"):
        *size, values = path.read_bytes().split(b"&", 3)
        path.write_bytes(b"&".join([*size, bytes(len(values))]))


@pytest.fixture(scope="module")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """COLMAP's workspace of the slabs."""
    folder = tmp_path_factory.mktemp("slabs")
    (folder / "photographs").mkdir()
    write_data_set(slab_data_set(folder / "photographs"), exporter("colmap-pinhole"), folder / "data")
    triangulate(folder / "data", folder / "dense")
    return folder / "dense"


@pytest.mark.slow
@pytest.mark.sweep
def test_the_depth_maps_are_fused_and_meshed_in_the_frame_of_the_poses(
    dense: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pycolmap, "patch_match_stereo", write_true_maps)
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim = 8, 5.0  # there are 16,000 points
    patch_match(dense, tmp_path / "fused.ply", tmp_path / "mesh.ply", options)
    heights = np.array(sorted({slab.z for slab in slab_scene()}))
    for name, most_m in (("fused.ply", 0.2e-3), ("mesh.ply", 1e-3)):
        vertices = read_surface_file(tmp_path / name, "m").vertices_m
        assert len(vertices) > 2000
        assert np.median(np.abs(vertices[:, 2:] - heights).min(axis=1)) < most_m


@pytest.mark.slow
def test_depth_maps_without_depth_end_with_words(
    dense: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pycolmap, "patch_match_stereo", write_empty_maps)
    with pytest.raises(ComputeError, match="no point"):
        patch_match(dense, tmp_path / "fused.ply", tmp_path / "mesh.ply")


def test_the_locked_build_has_no_cuda_and_the_method_says_so() -> None:
    assert missing(methods()["pycolmap"]) == ("" if pycolmap.has_cuda else "pycolmap is built without CUDA")
