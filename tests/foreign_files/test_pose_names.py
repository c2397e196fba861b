"""Poses of other programs: names as they write them, and the axes of their cameras.

Each file is written here as the program named writes it; the expected poses are derived by hand. Axes: nerfstudio and
Instant-NGP look along -z (OpenGL); NeuS2 with `from_na` along +z, y down (`nerf_matrix_to_ngp` in
include/neural-graphics-primitives/nerf_loader.h of NeuS2: what it flips it flips back).
"""

from __future__ import annotations

import json
import unicodedata
from pathlib import Path

import numpy as np
import pytest

from service.compute.images.photographs import ImageFolder
from service.compute.poses.pose_files import posed_images, read_poses
from service.core.errors import DataError

A = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1.0]])
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def _transforms(path: Path, *names: str, **keys: object) -> Path:
    """The k-th pose has x = k."""
    frames = [{"file_path": name, "transform_matrix": _at(k).tolist()} for k, name in enumerate(names)]
    path.write_text(json.dumps({**keys, "frames": frames}))
    return path


def _at(k: int) -> np.ndarray:
    T = A.copy()
    T[0, 3] = k
    return T


@pytest.mark.parametrize(
    ("written", "image"),
    [
        ("images\\v1_001.jpg", "v1_001.jpg"),  # the case f07: written on Windows
        ("C:\\Users\\Ana\\scan 1\\images\\v1_001.jpg", "v1_001.jpg"),
        ("D:v1_001.jpg", "v1_001.jpg"),
        (".\\images\\v1_001.jpg", "v1_001.jpg"),
        ("\\\\server\\share\\v1_001.jpg", "v1_001.jpg"),
        ("/home/ana/images/v1_001.jpg", "v1_001.jpg"),
        ("./images/v1_001", "v1_001.jpg"),  # the case f08: Blender's sets
        ("./train/r_0", "r_0.png"),
        ("images/frame.0001", "frame.0001.jpg"),
        ("images/V1_001.JPG", "v1_001.jpg"),
        ("images/V1_001", "v1_001.JPG"),
        (unicodedata.normalize("NFD", "images/Wirbelsäule_1.jpg"), unicodedata.normalize("NFC", "Wirbelsäule_1.jpg")),
        (unicodedata.normalize("NFC", "images/Wirbelsäule_1.jpg"), unicodedata.normalize("NFD", "Wirbelsäule_1.jpg")),
        ("images/脊椎.jpg", "脊椎.jpg"),
    ],
)
def test_a_name_that_fits_one_image_is_that_image(written: str, image: str, tmp_path: Path) -> None:
    path = _transforms(tmp_path / "transforms.json", "images/other.jpg", written)
    files = ImageFolder((tmp_path / image,))
    chosen, kept = posed_images(path, files, tmp_path)
    np.testing.assert_allclose(chosen[image], _at(1) @ FLIP, atol=1e-12)
    assert kept == files


@pytest.mark.parametrize(
    ("written", "images"),
    [
        (("left/0001.jpg", "right/0001.jpg"), ("0001.jpg",)),
        (("left\\0001.jpg", "right\\0001.jpg"), ("0001.jpg",)),
        (("images/v1",), ("v1.jpg", "v1.png")),
        (("images/V1.jpg",), ("v1.jpg", "v1.JPG")),
    ],
)
def test_a_name_that_fits_several_is_refused(
    written: tuple[str, ...], images: tuple[str, ...], tmp_path: Path
) -> None:
    path = _transforms(tmp_path / "transforms.json", *written)
    with pytest.raises(DataError, match="it is not clear whose pose it is") as caught:
        read_poses(path, images)
    assert all(name in caught.value.what for name in (*written, *images))


def test_exact_names_go_before_those_that_are_only_alike(tmp_path: Path) -> None:
    path = _transforms(tmp_path / "transforms.json", "a.jpg", "A.jpg", "b", "b.jpg")
    found = read_poses(path, ["A.jpg", "a.jpg", "b.jpg"])
    assert {name: T[0, 3] for name, T in found.items()} == {"a.jpg": 0.0, "A.jpg": 1.0, "b.jpg": 3.0}


def test_an_image_of_another_kind_is_not_taken_for_the_one_of_the_pose(tmp_path: Path) -> None:
    path = _transforms(tmp_path / "transforms.json", "images/v1.png")
    with pytest.raises(DataError, match=r"named v1\.jpg, those of the poses images/v1\.png"):
        read_poses(path, ["v1.jpg"])


@pytest.mark.parametrize(
    ("keys", "axes"),
    [
        ({}, FLIP),
        ({"camera_angle_x": 0.69}, FLIP),  # Blender's sets
        ({"from_na": True}, np.eye(4)),
        ({"from_na": False}, np.eye(4)),  # NeuS2 tests only whether it is there
        ({"normal_mts_args": []}, np.diag([-1.0, -1.0, 1.0, 1.0])),
    ],
)
def test_the_axes_of_cameras_are_those_of_the_program(
    keys: dict[str, object], axes: np.ndarray, tmp_path: Path
) -> None:
    path = _transforms(tmp_path / "transforms.json", "a.jpg", **keys)
    np.testing.assert_allclose(read_poses(path)["a.jpg"], _at(0) @ axes, atol=1e-12)


def test_the_only_transforms_of_a_folder_are_read_and_several_are_refused(tmp_path: Path) -> None:
    _transforms(tmp_path / "transforms_train.json", "./train/r_0", "./train/r_1")
    assert set(read_poses(tmp_path)) == {"train/r_0", "train/r_1"}
    _transforms(tmp_path / "transforms_test.json", "./test/r_0")
    with pytest.raises(DataError, match=r"several files of poses: transforms_test\.json, transforms_train\.json"):
        read_poses(tmp_path)


def test_a_trajectory_of_tum_names_images_by_their_timestamps(tmp_path: Path) -> None:
    """As in RGB-D SLAM's groundtruth.txt: camera to world, metres, scalar last, comments before."""
    path = tmp_path / "groundtruth.txt"
    path.write_text(
        "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"
        "1305031102.175304 1.5 -0.25 2.0 0 0 0.7071068 0.7071068\n"
        "1305031102.211214 1.6 -0.25 2.0 0.0 0.0 0.0 1.0\n"
    )
    found = read_poses(path, ["1305031102.175304.png"])["1305031102.175304.png"]
    expected = np.array([[0, -1, 0, 1.5], [1, 0, 0, -0.25], [0, 0, 1, 2.0], [0, 0, 0, 1]])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    path.write_text(path.read_text() + "1305031102.3 1 2 3\n")
    with pytest.raises(DataError, match="the line is not timestamp tx ty tz qx qy qz qw") as caught:
        read_poses(path)
    assert caught.value.where == f"{path}:5"


def test_the_images_file_of_a_colmap_model_names_the_model(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 1 2 3 1 C:\\data\\v1.jpg\n\n")
    (tmp_path / "points3D.txt").write_text("")
    T = read_poses(tmp_path / "images.txt", ["v1.jpg"])["v1.jpg"]
    np.testing.assert_allclose(T[:3, 3], [-1, -2, -3])
