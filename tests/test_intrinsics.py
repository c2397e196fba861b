"""Board corners in rendered images, their numbering, and the camera that is calibrated from them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import Board, BoardView, board_points, detect_board, half_turn
from service.compute.calibration.intrinsics import calibrate_intrinsics, locate_board
from service.compute.camera_model import CameraModel
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, apply, inverse, look_at, transform
from tests.support.textured_scene import TEXEL_M, Slab, camera_of_width, render

COLUMNS, ROWS, SQUARE_M = 16, 23, 0.015
BOARD = Board(COLUMNS, ROWS, SQUARE_M)
CAMERA = camera_of_width(960)
SIZE = (CAMERA.width, CAMERA.height)
BORDER = 80  # texels of white around the squares


def _board(columns: int, rows: int) -> tuple[Slab, Array]:
    """A checkerboard lying at z = 0 and its true inner corners (rows, columns, 3) in the world."""
    texels = round(SQUARE_M / TEXEL_M)
    squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    texture = np.pad(np.kron(squares, np.ones((texels, texels))) * 200 + 25, BORDER, constant_values=225)
    low = -np.array(texture.shape[::-1]) * TEXEL_M / 2
    high = low + (np.array(texture.shape[::-1]) - 1) * TEXEL_M
    y, x = np.mgrid[1 : rows + 1, 1 : columns + 1]
    # a texel's centre lies at its index, so the edge between two squares lies half a texel before
    corners = np.stack(
        [low[0] + (BORDER + x * texels - 0.5) * TEXEL_M, low[1] + (BORDER + y * texels - 0.5) * TEXEL_M], -1
    )
    slab = Slab((low[0], low[1]), (high[0], high[1]), 0.0, texture.astype(np.float32))
    return slab, np.concatenate([corners, np.zeros((rows, columns, 1))], axis=-1)


def _poses(count: int, tilt_deg: float, seed: int = 0) -> list[Transform]:
    rng = np.random.default_rng(seed)
    out: list[Transform] = []
    for k in range(count):
        azimuth = 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / count
        tilt = np.deg2rad(tilt_deg * rng.uniform(0.6, 1.0))
        eye = rng.uniform(0.7, 0.85) * np.array(
            [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
        )
        target = np.append(rng.uniform(-0.05, 0.05, 2), 0.0)
        out.append(look_at(eye, target, np.array([1.0, 0.0, 0.0])))  # long side across the picture
    return out


def _corners(camera: CameraModel, pose: Transform, sigma_px: float, rng: np.random.Generator) -> Array:
    """Ideal corners of a board centred in the world, facing the camera, with noise."""
    centre = board_points(COLUMNS, ROWS, SQUARE_M).mean(axis=0)
    T_world_board = transform(Rotation.from_euler("x", np.pi), np.array([-centre[0], centre[1], 0.0]))
    points = apply(inverse(pose) @ T_world_board, board_points(COLUMNS, ROWS, SQUARE_M))
    return camera.project(points) + rng.normal(0, sigma_px, (len(points), 2))


def _views(corners: list[Array]) -> list[BoardView]:
    return [BoardView(np.arange(len(view)), view) for view in corners]


@pytest.fixture(scope="module")
def board() -> tuple[Slab, Array]:
    return _board(COLUMNS, ROWS)


@pytest.fixture(scope="module")
def picture(board: tuple[Slab, Array]) -> tuple[NDArray[np.uint8], Transform]:
    pose = _poses(3, 35)[1]
    sharp = render([board[0]], CAMERA, pose, 1)
    return np.asarray(cv2.GaussianBlur(sharp, (0, 0), 0.6), dtype=np.uint8), pose  # as a lens would


def test_corners_are_found_to_a_twentieth_of_a_pixel(
    board: tuple[Slab, Array], picture: tuple[NDArray[np.uint8], Transform]
) -> None:
    image, pose = picture
    found = detect_board(image, COLUMNS, ROWS)
    truth = CAMERA.project(apply(inverse(pose), board[1].reshape(-1, 3)))
    distance = np.linalg.norm(found[:, None] - truth[None], axis=2)
    assert len(set(distance.argmin(axis=1))) == COLUMNS * ROWS
    assert np.sqrt(np.mean(distance.min(axis=1) ** 2)) < 0.05


def test_numbering_follows_the_board_when_the_picture_is_turned(picture: tuple[NDArray[np.uint8], Transform]) -> None:
    image, _ = picture
    upright = detect_board(image, COLUMNS, ROWS)
    turned = detect_board(np.ascontiguousarray(image[::-1, ::-1]), COLUMNS, ROWS)
    back = np.array([image.shape[1] - 1, image.shape[0] - 1]) - turned
    assert np.linalg.norm(back - upright, axis=1).max() < 0.1
    assert half_turn(COLUMNS, ROWS, SQUARE_M) is None


def test_half_turn_of_a_symmetric_board_maps_it_onto_itself() -> None:
    turn = half_turn(9, 7, SQUARE_M)
    assert turn is not None
    points = board_points(9, 7, SQUARE_M)
    np.testing.assert_allclose(apply(turn, points), points[::-1], atol=1e-12)


def test_large_image_is_searched_small_and_measured_at_full_size(
    picture: tuple[NDArray[np.uint8], Transform],
) -> None:
    image, _ = picture
    large = cv2.resize(image, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    found = detect_board(np.asarray(large, dtype=np.uint8), COLUMNS, ROWS)
    reference = (detect_board(image, COLUMNS, ROWS) + 0.5) * 3 - 0.5
    assert np.sqrt(np.mean(np.sum((found - reference) ** 2, axis=1))) < 0.2


def test_hidden_board_is_an_error(picture: tuple[NDArray[np.uint8], Transform]) -> None:
    image = picture[0].copy()
    image[:, :400] = 90
    with pytest.raises(ComputeError, match="no board of 16 × 23"):
        detect_board(image, COLUMNS, ROWS)
    with pytest.raises(DataError, match="grey"):
        detect_board(np.zeros((10, 10, 3), dtype=np.uint8), COLUMNS, ROWS)


def test_camera_is_recovered_within_its_sigma() -> None:
    rng = np.random.default_rng(5)
    poses = _poses(25, 40)
    views = [_corners(CAMERA, T, 0.05, rng) for T in poses]
    views[4] = views[4] + rng.normal(0, 3.0, views[4].shape)  # a moved board
    result = calibrate_intrinsics(_views(views), BOARD, SIZE)
    assert [e.index for e in result.excluded] == [4]
    assert 4 not in result.views
    assert 0.05 < result.rms_px < 0.09  # two-dimensional: √2 · 0.05
    assert len(result.per_view_rms_px) == len(result.T_camera_board) == len(result.tilt_deg) == 24
    for name, sigma in result.sigma.items():
        assert abs(getattr(result.camera, name) - getattr(CAMERA, name)) < 4.5 * sigma, name
    assert result.sigma["fx"] < 0.5
    assert result.tilt_deg.max() > 30
    assert 0.5 < result.coverage <= 1
    # the poses are the ones the corners were made with
    expected = np.linalg.norm(poses[0][:3, 3])
    origin = inverse(result.T_camera_board[0])[:3, 3]
    centre = board_points(COLUMNS, ROWS, SQUARE_M).mean(axis=0)
    assert np.linalg.norm(origin - centre) == pytest.approx(expected, abs=3e-4)


def test_locate_board_agrees_with_the_corners() -> None:
    pose = _poses(3, 35)[2]
    corners = _corners(CAMERA, pose, 0.03, np.random.default_rng(0))
    T, rms = locate_board(corners, SQUARE_M, COLUMNS, ROWS, CAMERA)
    assert rms < 0.06
    again = CAMERA.project(apply(T, board_points(COLUMNS, ROWS, SQUARE_M)))
    assert np.sqrt(np.mean(np.sum((again - corners) ** 2, axis=1))) == pytest.approx(rms)


def test_views_that_determine_nothing_are_refused() -> None:
    rng = np.random.default_rng(1)
    flat = _views([_corners(CAMERA, T, 0.05, rng) for T in _poses(12, 2)])
    with pytest.raises(ComputeError, match="same tilt"):
        calibrate_intrinsics(flat, BOARD, SIZE)
    few = _views([_corners(CAMERA, T, 0.05, rng) for T in _poses(3, 40)])
    with pytest.raises(ComputeError, match="2 usable board views"):
        calibrate_intrinsics(few[:2], BOARD, SIZE)
    with pytest.raises(DataError, match="view 1"):
        calibrate_intrinsics([few[0], BoardView(few[1].indices, few[1].corners[:-1])], BOARD, SIZE)
