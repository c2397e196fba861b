"""One rule for image files: odd ones are left out by name, damaged ones are errors, --strict refuses both."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner, Result

from service.cli.main import app
from service.compute.calibration.board import Board
from service.compute.images.photographs import image_folder
from service.core.errors import DataError
from tests.support.boards.board_folder import CAMERA, BoardFolder, board_folder

BOARD = Board(9, 6, 0.02)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> BoardFolder:
    return board_folder(tmp_path_factory.mktemp("boards"), BOARD, count=8)


@pytest.fixture
def odd(photographs: BoardFolder, tmp_path: Path) -> BoardFolder:
    """The photographs with a hidden file, a copy and one of another size among them."""
    images = tmp_path / "images"
    shutil.copytree(photographs.images, images)
    (images / "._b1.jpg").write_bytes(b"\0\5\x16\7 what macOS notes")
    shutil.copy(images / "b1.jpg", images / "b1 copy.jpg")
    with Image.open(images / "b2.jpg") as picture:
        picture.resize((450, 300)).save(images / "small.jpg")
    return BoardFolder(images, photographs.camera, photographs.T_base_flange)


def _invoke(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)


def _commands(folder: BoardFolder, tmp_path: Path) -> dict[str, list[object]]:
    board = ["--board", "9x6", "--square-mm", "20"]
    poses = folder.poses(tmp_path / "poses.csv")
    spheres = tmp_path / "spheres.json"
    spheres.write_text(json.dumps({"radius_mm": 15, "registration_mm": [[0, 0, 0], [90, 0, 0], [0, 80, 5]]}))
    images = ["--images", folder.images]
    camera = ["--camera", folder.camera]
    return {
        "intrinsics": ["calibrate", "intrinsics", *images, *board, "--out", tmp_path / "camera.json"],
        "hand-eye": [
            "calibrate",
            "hand-eye",
            *images,
            *camera,
            *board,
            "--robot-poses",
            poses,
            "--out",
            tmp_path / "h",
        ],
        "sfm": ["sfm", *images, *camera, "--out", tmp_path / "model"],
        "register": [
            "register",
            *images,
            *camera,
            "--poses",
            poses,
            "--spheres",
            spheres,
            "--out",
            tmp_path / "r.json",
        ],
    }


@pytest.mark.parametrize("command", ["intrinsics", "hand-eye", "sfm", "register"])
def test_damaged_images_are_errors_and_all_are_named(odd: BoardFolder, tmp_path: Path, command: str) -> None:
    whole = (odd.images / "b3.jpg").read_bytes()
    (odd.images / "b3.jpg").write_bytes(whole[: len(whole) // 2])
    (odd.images / "notes.png").write_text("no picture")
    done = _invoke(*_commands(odd, tmp_path)[command])
    assert done.exit_code == 1
    assert (
        "2 of 11 images are damaged: b3.jpg: the JPEG ends before its picture is complete; notes.png:" in done.output
    )


@pytest.mark.parametrize("command", ["intrinsics", "hand-eye", "sfm", "register"])
def test_strict_refuses_odd_files_by_name(odd: BoardFolder, tmp_path: Path, command: str) -> None:
    done = _invoke(*_commands(odd, tmp_path)[command], "--strict")
    assert done.exit_code == 1
    assert "3 odd files" in done.output
    for words in ("._b1.jpg: a hidden file", "the same file as", "small.jpg: 450 × 300 px"):
        assert words in done.output


@pytest.mark.slow
@pytest.mark.parametrize("command", ["intrinsics", "hand-eye"])
def test_odd_files_are_left_out_by_name(odd: BoardFolder, tmp_path: Path, command: str) -> None:
    done = _invoke(*_commands(odd, tmp_path)[command])
    assert done.exit_code == 0, done.output
    assert "._b1.jpg: a hidden file" in done.output
    assert "b1.jpg: the same file as b1 copy.jpg" in done.output
    assert "small.jpg: 450 × 300 px" in done.output


@pytest.mark.slow
@pytest.mark.usefixtures("one_processor")
def test_images_without_a_pose_are_left_out_by_name(photographs: BoardFolder, tmp_path: Path) -> None:
    T = dict(list(photographs.T_base_flange.items())[1:])
    fewer = BoardFolder(photographs.images, photographs.camera, T)
    done = _invoke(*_commands(fewer, tmp_path)["hand-eye"])
    assert done.exit_code == 0, done.output
    assert "b0.jpg: no pose in poses.csv" in done.output
    images = tmp_path / "images"  # as many as it takes: all are searched for spheres
    images.mkdir()
    for name in ("b0.jpg", "b1.jpg", "b2.jpg"):
        shutil.copy(photographs.images / name, images)
    fewer = BoardFolder(images, photographs.camera, {name: T[name] for name in ("b1.jpg", "b2.jpg")})
    done = _invoke(*_commands(fewer, tmp_path)["register"])
    assert "left out b0.jpg: no pose in poses.csv" in done.output
    done = _invoke(*_commands(fewer, tmp_path)["register"], "--strict")
    assert "1 odd file: b0.jpg: no pose" in done.output


def test_images_all_of_another_size_blame_the_camera_model(photographs: BoardFolder, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"the images are 900 × 600 px, the camera model is for 450 × 300 px"):
        image_folder(photographs.images, size=(450, 300))


@pytest.mark.slow
@pytest.mark.parametrize(
    "suffix", [pytest.param(suffix, marks=pytest.mark.sweep) for suffix in ("bmp", "pgm", "pnm", "png", "tif")]
)
def test_other_formats_of_images_are_read(photographs: BoardFolder, tmp_path: Path, suffix: str) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for file in sorted(photographs.images.iterdir()):
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        cv2.imwrite(str(images / f"{file.stem}.{suffix}"), np.asarray(grey))
    done = _invoke("calibrate", "intrinsics", "--images", images, "--board", "9x6", "--square-mm", "20",
                   "--out", tmp_path / "camera.json")  # fmt: skip
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "camera.json").read_text())["n_views"] == 8


@pytest.mark.slow
def test_a_camera_without_distortion_is_a_pinhole_camera(photographs: BoardFolder, tmp_path: Path) -> None:
    pinhole = {key: value for key, value in CAMERA.record().items() if key not in ("k1", "k2", "p1", "p2")}
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps(pinhole))
    folder = BoardFolder(photographs.images, camera, photographs.T_base_flange)
    done = _invoke(*_commands(folder, tmp_path)["hand-eye"])
    assert done.exit_code == 0, done.output
