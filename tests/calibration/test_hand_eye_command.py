"""`orthocapture calibrate hand-eye` says whether poses and images agree, and which mistake explains it if not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from service.cli.main import app
from service.compute.calibration.board import Board
from service.core.geometry import Array, inverse
from tests.support.boards.board_folder import T_BASE_BOARD, T_FLANGE_CAMERA, BoardFolder, board_folder

BOARD = Board(9, 6, 0.02)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> BoardFolder:
    return board_folder(tmp_path_factory.mktemp("boards"), BOARD)


def _run(photographs: BoardFolder, poses: Path, out: Path, *more: str) -> Result:
    words = ["calibrate", "hand-eye", "--images", str(photographs.images), "--robot-poses", str(poses)]
    words += ["--camera", str(photographs.camera), "--board", "9x6", "--square-mm", "20", "--out", str(out), *more]
    return CliRunner().invoke(app, words, catch_exceptions=False)


def _in_millimetres(T: Array) -> Array:
    scaled = T.copy()
    scaled[:3, 3] *= 1e3
    return scaled


@pytest.mark.slow
def test_poses_that_fit_give_the_mount(photographs: BoardFolder, tmp_path: Path) -> None:
    out = tmp_path / "hand_eye.json"
    done = _run(photographs, photographs.poses(tmp_path / "poses.csv"), out)
    assert done.exit_code == 0, done.output
    record = json.loads(out.read_text())
    assert record["setup"] == "eye-in-hand"
    assert np.allclose(record["T_flange_camera"], T_FLANGE_CAMERA, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words", "remedy"),
    [
        (inverse, "fit inverted: either the file holds T_flange_base, or the camera stands", "--setup eye-to-hand"),
        pytest.param(_in_millimetres, "fit in millimetres", "Write positions in metres", marks=pytest.mark.sweep),
    ],
)
def test_poses_that_are_read_wrongly_are_refused_and_the_mistake_is_named(
    photographs: BoardFolder, tmp_path: Path, change: Callable[[Array], Array], words: str, remedy: str
) -> None:
    poses = photographs.poses(tmp_path / "poses.csv", [change(T) for T in photographs.T_base_flange.values()])
    out = tmp_path / "hand_eye.json"
    for method in ("weighted", "park"):
        done = _run(photographs, poses, out, "--method", method)
        assert done.exit_code == 1, done.output
        assert words in done.output
        assert remedy in done.output
        assert not out.exists()


@pytest.mark.slow
def test_squares_that_are_not_as_stated_are_refused_with_their_true_side(
    photographs: BoardFolder, tmp_path: Path
) -> None:
    poses, out = photographs.poses(tmp_path / "poses.csv"), tmp_path / "hand_eye.json"
    done = _run(photographs, poses, out, "--square-mm", "20.7")
    assert done.exit_code == 1, done.output
    assert "mm by the robot, 20.7 were given" in done.output
    assert "the squares are 20.0" in done.output or "the squares are 19.9" in done.output
    assert not out.exists()
    right = _run(photographs, poses, out, "--size-tolerance-percent", "0.02")
    assert right.exit_code == 0, right.output
    assert "mm by the robot, 20 were given" in right.output
    assert json.loads(out.read_text())["board_size"]["tolerance"] == pytest.approx(2e-4)


@pytest.mark.slow
def test_a_universal_robots_rows_without_header_are_read(photographs: BoardFolder, tmp_path: Path) -> None:
    poses, out = tmp_path / "poses.txt", tmp_path / "hand_eye.json"
    rows = [[*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_rotvec()] for T in photographs.T_base_flange.values()]
    poses.write_text("\n".join(" ".join(f"{v:.9f}" for v in row) for row in rows))
    done = _run(photographs, poses, out)
    assert done.exit_code == 0, done.output
    assert "was read with positions in m, rotations as rotation vectors in radians" in " ".join(done.output.split())
    assert np.allclose(json.loads(out.read_text())["T_flange_camera"], T_FLANGE_CAMERA, atol=1e-3)
    poses.write_text("\n".join(" ".join(f"{v:.9f}" for v in [*(1e3 * np.array(r[:3])), *r[3:]]) for r in rows))
    assert "--length mm" in _run(photographs, poses, out).output
    assert _run(photographs, poses, out, "--length", "mm").exit_code == 0


@pytest.mark.slow
def test_poses_of_other_images_fit_nothing(photographs: BoardFolder, tmp_path: Path) -> None:
    mixed = list(photographs.T_base_flange.values())
    poses = photographs.poses(tmp_path / "poses.csv", mixed[4:] + mixed[:4])
    done = _run(photographs, poses, tmp_path / "hand_eye.json")
    assert done.exit_code == 1, done.output
    assert "do not fit the images" in done.output
    assert not (tmp_path / "hand_eye.json").exists()


@pytest.mark.slow
def test_a_camera_beside_the_robot_is_placed_in_the_base(photographs: BoardFolder, tmp_path: Path) -> None:
    # The same images, interpreted the other way round: the board's pose becomes the flange's.
    poses = photographs.poses(tmp_path / "poses.csv", [inverse(T) for T in photographs.T_base_flange.values()])
    out = tmp_path / "hand_eye.json"
    done = _run(photographs, poses, out, "--setup", "eye-to-hand")
    assert done.exit_code == 0, done.output
    assert "in the robot's base frame" in done.output
    record = json.loads(out.read_text())
    assert record["setup"] == "eye-to-hand"
    assert np.allclose(record["T_base_camera"], T_FLANGE_CAMERA, atol=1e-3)
    assert np.allclose(record["T_flange_board"], T_BASE_BOARD, atol=1e-3)
    assert "T_flange_camera" not in json.dumps(record)


def test_a_file_that_cannot_be_written_is_told_before_anything_is_computed(
    photographs: BoardFolder, tmp_path: Path
) -> None:
    poses = photographs.poses(tmp_path / "poses.csv")
    done = _run(photographs, poses, tmp_path / "nowhere" / "hand_eye.json")
    assert done.exit_code == 1
    assert "folder of the file to write does not exist" in done.output
