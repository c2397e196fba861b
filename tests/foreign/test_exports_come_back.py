"""What an exporter writes and a reader of ours reads comes back as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from service.compute.poses.files.camera_files import read_camera_json
from service.compute.poses.files.pose_files import read_poses
from service.dataset.posed.of_folder import data_set_of_folder
from service.dataset.posed.records import DataSet
from tests.support.scenes.read_formats import written

NAMED_BY_FILE = {
    "colmap": "", "colmap-binary": "", "colmap-pinhole": "", "sugar": "", "eth3d": "", "nerfstudio": "",
    "instant-ngp": "", "neus2": "", "plain": "poses.csv",
}  # fmt: skip


@pytest.mark.parametrize("name", [*NAMED_BY_FILE, "plain transforms"])
def test_poses_come_back(name: str, dataset: DataSet, tmp_path: Path) -> None:
    folder = written(dataset, name.split(maxsplit=1)[0], tmp_path)
    path = folder / NAMED_BY_FILE.get(name, "transforms.json")
    found = read_poses(path, [Path(view.file).with_suffix(".png").name for view in dataset.views])
    for view in dataset.views:
        T = found[Path(view.file).with_suffix(".png").name]
        np.testing.assert_allclose(T, view.T_world_camera, atol=1e-9, err_msg=name)


def test_camera_and_whole_data_set_come_back(dataset: DataSet, tmp_path: Path) -> None:
    assert read_camera_json(written(dataset, "plain", tmp_path) / "camera.json") == dataset.views[0].camera
    again = data_set_of_folder(written(dataset, "hdf5", tmp_path))
    for view, back in zip(dataset.views, again.views, strict=True):
        np.testing.assert_array_equal(back.T_world_camera, view.T_world_camera)
        assert back.camera == view.camera
        np.testing.assert_array_equal(again.pixels.colours(back), dataset.pixels.colours(view))
