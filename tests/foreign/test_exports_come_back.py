"""What an exporter writes and a reader of ours reads comes back as it was."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from service.cli.conversion import keep_image
from service.cli.main import app
from service.compute.poses.pose_files import read_camera_json, read_poses
from service.compute.poses.ros_messages import StampedImage
from service.dataset.formats.hdf5 import data_set_of_folder
from service.dataset.formats.mcap import stamps_ns
from service.dataset.records import DataSet
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


def test_a_recording_of_ros_comes_back(dataset: DataSet, tmp_path: Path) -> None:
    folder, out = written(dataset, "mcap", tmp_path), tmp_path / "out"
    words = ["import-ros", str(folder), "--out", str(out), "--base", "world", "--pose-topic", "/camera/pose"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    stamps = stamps_ns(dataset.views)
    named = {view.name: f"{stamps[view.name]}{Path(view.file).suffix}" for view in dataset.views}
    found = read_poses(out / "poses.csv", list(named.values()))
    for view in dataset.views:
        np.testing.assert_allclose(found[named[view.name]], view.T_world_camera, atol=1e-9)
        assert (out / "images" / named[view.name]).read_bytes() == dataset.pixels.picture(view)
    back, camera = read_camera_json(out / "camera.json"), dataset.views[0].camera
    np.testing.assert_allclose(back.matrix, camera.matrix, atol=1e-9)
    np.testing.assert_allclose(back.distortion, camera.distortion, atol=1e-12)


def test_pictures_of_a_recording_are_kept_by_what_they_hold(tmp_path: Path) -> None:
    """compressedDepth has a header of its own before the PNG; some drivers state jpeg and send PNG."""
    (tmp_path / "images").mkdir()
    png = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()
    stamps: dict[str, int] = {}
    left_out: dict[str, str] = {}
    for stamp, (form, data) in enumerate(
        [
            ("bgr8; jpeg compressed bgr8", png),
            ("16UC1; compressedDepth png", bytes(12) + png),
            ("jpeg", b"RIFF0000WEBP"),
        ]
    ):
        keep_image(tmp_path, StampedImage(stamp, "camera", form, data), stamps, left_out)
    assert stamps == {"0.png": 0}
    assert left_out == {
        "1": "its format '16UC1; compressedDepth png' is not jpeg or png",
        "2": "its format 'jpeg' is not jpeg or png, but WebP",
    }


def test_camera_and_whole_data_set_come_back(dataset: DataSet, tmp_path: Path) -> None:
    assert read_camera_json(written(dataset, "plain", tmp_path) / "camera.json") == dataset.views[0].camera
    again = data_set_of_folder(written(dataset, "hdf5", tmp_path))
    for view, back in zip(dataset.views, again.views, strict=True):
        np.testing.assert_array_equal(back.T_world_camera, view.T_world_camera)
        assert back.camera == view.camera
        np.testing.assert_array_equal(again.pixels.colours(back), dataset.pixels.colours(view))
