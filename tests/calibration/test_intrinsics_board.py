"""Boards of every kind in photographs with known corners: turned, cut off, blurred, unevenly lit."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import Board, find_board
from service.compute.camera_model import CameraModel
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, apply, transform
from tests.support.boards.board_images import Photography, Shade, checkerboard, photograph, printed

CAMERA = CameraModel(1200, 800, 1680, 1682, 602.3, 401.7, -0.045, 0.03, 4e-4, -5e-4)
CHECKERBOARD = Board(11, 8, 0.015)
CHARUCO = Board(11, 8, 0.015, "charuco", dictionary="DICT_4X4_250")


def _pose(board: Board, tilt_deg: float, roll_deg: float, distance_m: float) -> Transform:
    R = Rotation.from_euler("zxz", [30, tilt_deg, roll_deg], degrees=True).as_matrix()
    return transform(R, np.array([0.004, -0.003, distance_m]) - R @ board.points().mean(axis=0))


def _jpeg(image: NDArray[np.uint8], quality: int = 92) -> NDArray[np.uint8]:
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def _errors(board: Board, shade: Shade, T: Transform, how: Photography, samples: int = 2) -> tuple[Array, int]:
    """Distances (M, 2) of the found corners from the true ones, and how many were found."""
    image = _jpeg(photograph(shade, CAMERA, T, np.random.default_rng(3), samples=samples, how=how))
    view = find_board(image, board)
    truth = CAMERA.project(apply(T, board.points()))
    return view.corners - truth[view.indices], len(view.indices)


@pytest.mark.parametrize("roll_deg", [0, 50, 130, 200, 290])
def test_checkerboard_corners_are_unbiased_whichever_way_it_is_turned(roll_deg: float) -> None:
    shade = checkerboard(CHECKERBOARD.columns, CHECKERBOARD.rows, CHECKERBOARD.square_m)
    error, found = _errors(CHECKERBOARD, shade, _pose(CHECKERBOARD, 25, roll_deg, 0.5), Photography())
    assert found == 88
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.03
    assert np.abs(error.mean(axis=0)).max() < 0.008


@pytest.mark.parametrize(
    ("how", "limit_px"),
    [
        (Photography(blur_px=3.0), 0.06),
        (Photography(noise=10.0), 0.1),
        (Photography(light=0.9), 0.06),
        (Photography(gamma=1.0), 0.03),
    ],
    ids=["blur", "noise", "shadow", "linear"],
)
def test_corners_stay_where_they_are_in_poor_images(how: Photography, limit_px: float) -> None:
    shade = checkerboard(CHECKERBOARD.columns, CHECKERBOARD.rows, CHECKERBOARD.square_m)
    error, _ = _errors(CHECKERBOARD, shade, _pose(CHECKERBOARD, 30, 70, 0.5), how)
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < limit_px
    assert np.abs(error.mean(axis=0)).max() < 0.02


@pytest.mark.parametrize("legacy", [False, True])
def test_charuco_corners_have_their_own_numbers_also_when_the_board_is_cut(legacy: bool) -> None:
    board = Board(11, 9, 0.015, "charuco", dictionary="DICT_4X4_250", legacy=legacy)
    drawing = np.asarray(board.charuco().generateImage((12 * 64, 10 * 64)), dtype=np.uint8)
    shade = printed(drawing, 0.015 / 64, np.array([-0.015, -0.015]))
    for distance_m, least, most in ((0.5, 95, 99), (0.2, 20, 80)):
        error, found = _errors(board, shade, _pose(board, 20, 40, distance_m), Photography(), samples=3)
        assert least <= found <= most
        assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.12


def test_circles_are_measured_at_their_centroids() -> None:
    board = Board(4, 11, 0.012, "circles")
    centres = board.points()[:, :2]

    def shade(xy: NDArray[np.floating[Any]], footprint_m: float) -> Array:
        nearest = np.full(len(xy), np.inf)
        for centre in centres:
            nearest = np.minimum(nearest, np.hypot(*(xy - centre).T))
        return np.clip((nearest - 0.006) / footprint_m + 0.5, 0, 1)

    error, found = _errors(board, shade, _pose(board, 20, 60, 0.5), Photography(), samples=1)
    assert found == 44
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.15  # centroid and centre differ in perspective
    turn = board.half_turn()
    assert turn is None
    even = Board(4, 10, 0.012, "circles")
    turn = even.half_turn()
    assert turn is not None
    np.testing.assert_allclose(apply(turn, even.points()), even.points()[::-1], atol=1e-12)


def test_boards_that_cannot_be_are_refused() -> None:
    with pytest.raises(DataError, match="cannot be used"):
        Board(2, 9, 0.015)
    with pytest.raises(DataError, match="smaller than its square"):
        Board(8, 9, 0.015, "charuco", marker_m=0.02)
    with pytest.raises(DataError, match="not a marker dictionary"):
        Board(8, 9, 0.015, "charuco", dictionary="DICT_X").charuco()
    with pytest.raises(DataError, match="fewer than this board"):
        Board(16, 23, 0.015, "charuco", dictionary="DICT_4X4_50").charuco()
    empty = np.full((300, 400), 128, dtype=np.uint8)
    for board in (CHECKERBOARD, CHARUCO, Board(4, 11, 0.012, "circles")):
        with pytest.raises(ComputeError):
            find_board(empty, board)


def test_a_small_board_in_a_dark_room_is_found_as_it_is() -> None:
    # Stretching the histogram turns the noise of a dark room into texture: of 14 boards photographed so (a public set
    # of bench/real_data/__main__.py) OpenCV finds all without stretching, and 4 with it.
    rng = np.random.default_rng(1)
    paper = np.full((400, 520), 95.0)
    for row in range(7):
        for column in range(row % 2, 10, 2):
            paper[60 + 40 * row : 100 + 40 * row, 60 + 40 * column : 100 + 40 * column] = 18
    turn = 0.35 * np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    placed = np.column_stack([turn, [300, 150]])
    shown = cv2.warpAffine(paper, placed, (640, 512), flags=cv2.INTER_AREA, borderValue=-1)
    light = cv2.GaussianBlur(np.where(shown >= 0, shown, 14.0), (0, 0), 0.7)
    image = np.clip(light + rng.normal(0, 8, light.shape) * np.sqrt(np.maximum(light, 5) / 90), 0, 255)
    view = find_board(image.astype(np.uint8), Board(9, 6, 0.015))
    inner = np.stack(np.meshgrid(99.5 + 40 * np.arange(9), 99.5 + 40 * np.arange(6)), axis=-1).reshape(-1, 2)
    truth = inner @ turn.T + placed[:, 2]
    near = np.linalg.norm(view.corners[:, None] - truth[None], axis=2).min(axis=1)
    assert len(view.corners) > 45
    assert float(np.median(near)) < 0.2
