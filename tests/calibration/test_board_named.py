"""The mistake in a wrong board description is named: found by trying counts, printing, dictionary and frame."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from service.cli.main import app
from service.compute.calibration.board import Board
from service.compute.calibration.board_search import find_boards, probe_board
from tests.support.boards.board_folder import BoardFolder, board_folder

BOARD = Board(9, 6, 0.02)
CHARUCO = Board(8, 5, 0.022, "charuco", 0.016, "DICT_4X4_100", legacy=True)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> BoardFolder:
    return board_folder(tmp_path_factory.mktemp("boards"), BOARD, count=5)


@pytest.fixture(scope="module")
def charuco(tmp_path_factory: pytest.TempPathFactory) -> BoardFolder:
    return board_folder(tmp_path_factory.mktemp("charuco"), CHARUCO, count=6)


def _run(photographs: BoardFolder, out: Path, *words: str) -> Result:
    more = ["calibrate", "intrinsics", "--images", str(photographs.images), "--out", str(out), *words]
    return CliRunner().invoke(app, more, catch_exceptions=False)


@pytest.mark.parametrize(
    ("words", "seen", "remedy"),
    [
        (("--board", "10x7", "--square-mm", "20"), "9 × 6 inner corners, not 10 × 7, which counts its", "give 9x6"),
        (("--board", "7x5", "--square-mm", "20"), "9 × 6 inner corners, not 7 × 5", "give 9x6"),
        (("--board", "9x6", "--square-mm", "0.02"), "squares of 0.02 mm", "20 for a square of 0.02 m"),
    ],
)
def test_a_checkerboard_described_wrongly_is_named(
    photographs: BoardFolder, tmp_path: Path, words: tuple[str, ...], seen: str, remedy: str
) -> None:
    done = _run(photographs, tmp_path / "camera.json", *words)
    assert done.exit_code == 1, done.output
    assert seen in done.output
    assert remedy in done.output
    assert not (tmp_path / "camera.json").exists()


@pytest.mark.parametrize(
    ("words", "seen", "remedy"),
    [
        (("8x5", "DICT_4X4_100"), "printed as OpenCV did before version 4.6", "Give --legacy"),
        (("8x5", "DICT_5X5_100", "--legacy"), "the markers are of DICT_4X4_", "Give --dictionary DICT_4X4_"),
        (("9x6", "DICT_4X4_100", "--legacy"), "squares were counted, not inner corners", "Give --board 8x5"),
        (("5x8", "DICT_4X4_100", "--legacy"), "columns and rows are swapped", "Give --board 8x5"),
    ],
)
def test_a_charuco_board_described_wrongly_is_named(
    charuco: BoardFolder, tmp_path: Path, words: tuple[str, ...], seen: str, remedy: str
) -> None:
    board, dictionary, *more = words
    options = ["--pattern", "charuco", "--square-mm", "22", "--marker-mm", "16"]
    done = _run(charuco, tmp_path / "c.json", *options, "--board", board, "--dictionary", dictionary, *more)
    assert done.exit_code == 1, done.output
    assert seen in done.output
    assert remedy in done.output


@pytest.mark.parametrize("marker", ["12", "19"])
def test_a_wrong_side_of_the_markers_is_named(charuco: BoardFolder, tmp_path: Path, marker: str) -> None:
    options = ["--pattern", "charuco", "--board", "8x5", "--square-mm", "22", "--marker-mm", marker]
    done = _run(charuco, tmp_path / "c.json", *options, "--dictionary", "DICT_4X4_100", "--legacy")
    assert done.exit_code == 1, done.output
    assert f"not {float(marker):.1f} mm, in squares of 22 mm" in done.output
    side = float(done.output.partition("give --marker-mm ")[2].split()[0])
    assert side == pytest.approx(16.0, abs=0.4)


def _circles(*, asymmetric: bool) -> np.ndarray:
    """A grid of 7 × 5 black circles on white."""
    picture = np.full((700, 900), 235, dtype=np.uint8)
    for row in range(5):
        for column in range(7):
            x = 120 + 90 * column + (45 if asymmetric and row % 2 else 0)
            cv2.circle(picture, (x, 150 + 90 * row), 24, 20, -1, cv2.LINE_AA)
    return cv2.GaussianBlur(picture, (0, 0), 1.0)


@pytest.mark.parametrize("asymmetric", [True, False])
def test_circles_are_not_a_checkerboard(tmp_path: Path, asymmetric: bool) -> None:
    cv2.imwrite(str(tmp_path / "circles.png"), _circles(asymmetric=asymmetric))
    wrong = probe_board([tmp_path / "circles.png"], BOARD)
    assert wrong is not None
    assert wrong.words == "the image shows circles, not squares"
    assert "--pattern circles" in wrong.remedy


def test_a_checkerboard_is_not_circles(photographs: BoardFolder) -> None:
    wrong = probe_board([photographs.images / "b0.jpg"], dataclasses.replace(BOARD, pattern="circles"))
    assert wrong is not None
    assert "squares, not circles" in wrong.words


@pytest.mark.slow
def test_a_legacy_board_is_calibrated_and_serves_hand_eye(charuco: BoardFolder, tmp_path: Path) -> None:
    options = ["--pattern", "charuco", "--board", "8x5", "--square-mm", "22", "--marker-mm", "16"]
    options += ["--dictionary", "DICT_4X4_100", "--legacy"]
    done = _run(charuco, tmp_path / "camera.json", *options, "--model", "radial2")
    assert done.exit_code == 0, done.output
    poses = charuco.poses(tmp_path / "poses.csv")
    words = ["calibrate", "hand-eye", "--images", str(charuco.images), "--robot-poses", str(poses), *options]
    words += ["--camera", str(charuco.camera), "--out", str(tmp_path / "hand_eye.json"), "--suggest", "0"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "6 images" in done.output


def test_a_board_that_is_cut_by_the_frame_is_said_to_be_cut(photographs: BoardFolder, tmp_path: Path) -> None:
    whole = cv2.imread(str(photographs.images / "b0.jpg"), cv2.IMREAD_GRAYSCALE)
    assert whole is not None
    cut = tmp_path / "cut.png"
    cv2.imwrite(str(cut), np.ascontiguousarray(whole[:, : whole.shape[1] // 2 + 40]))
    (found,) = find_boards([cut], BOARD)
    assert found.view is None
    assert "cropped by the image's edge" in found.reason
    (other,) = find_boards([photographs.images / "b0.jpg"], dataclasses.replace(BOARD, columns=10, rows=7))
    assert "9 × 6 inner corners, not 10 × 7" in other.reason
