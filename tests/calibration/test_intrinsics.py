"""Board corners in rendered images, their numbering, and the camera calibrated from them."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import Board, BoardView, board_points, find_board, half_turn
from service.compute.calibration.intrinsics import calibrate_intrinsics, locate_view
from service.compute.calibration.intrinsics_adjustment import LensModel
from service.compute.calibration.intrinsics_quality import (
    calibration_warnings,
    cross_validate,
    projection_uncertainty,
)
from service.compute.camera_model import CameraModel
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, align_points, apply, inverse, look_at, transform
from tests.support.scenes.textured_scene import TEXEL_M, Slab, camera_of_width, render

COLUMNS, ROWS, SQUARE_M = 16, 23, 0.015
BOARD = Board(COLUMNS, ROWS, SQUARE_M)
CAMERA = camera_of_width(960)
SIZE = (CAMERA.width, CAMERA.height)
BORDER = 80  # texels of white around the squares


def _board(columns: int, rows: int) -> tuple[Slab, Array]:
    """A checkerboard at z = 0 and its true inner corners (rows, columns, 3) in the world."""
    texels = round(SQUARE_M / TEXEL_M)
    squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    texture = np.pad(np.kron(squares, np.ones((texels, texels))) * 200 + 25, BORDER, constant_values=225)
    low = -np.array(texture.shape[::-1]) * TEXEL_M / 2
    high = low + (np.array(texture.shape[::-1]) - 1) * TEXEL_M
    y, x = np.mgrid[1 : rows + 1, 1 : columns + 1]
    # a texel's centre lies at its index, so the edge between two squares lies half a texel before it
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
        out.append(look_at(eye, target, np.array([1.0, 0.0, 0.0])))  # long side across the image
    return out


def _corners(camera: CameraModel, pose: Transform, sigma_px: float, rng: np.random.Generator) -> Array:
    """Ideal corners of a board centred in the world and facing the camera, with noise."""
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
    return np.asarray(cv2.GaussianBlur(sharp, (0, 0), 0.6), dtype=np.uint8), pose  # blurred as by a lens


def test_corners_are_found_to_a_twentieth_of_a_pixel(
    board: tuple[Slab, Array], picture: tuple[NDArray[np.uint8], Transform]
) -> None:
    image, pose = picture
    found = find_board(image, BOARD).corners
    truth = CAMERA.project(apply(inverse(pose), board[1].reshape(-1, 3)))
    distance = np.linalg.norm(found[:, None] - truth[None], axis=2)
    assert len(set(distance.argmin(axis=1))) == COLUMNS * ROWS
    assert np.sqrt(np.mean(distance.min(axis=1) ** 2)) < 0.05


def test_numbering_follows_the_board_when_the_picture_is_turned(picture: tuple[NDArray[np.uint8], Transform]) -> None:
    image, _ = picture
    upright = find_board(image, BOARD).corners
    turned = find_board(np.ascontiguousarray(image[::-1, ::-1]), BOARD).corners
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
    found = find_board(np.asarray(large, dtype=np.uint8), BOARD).corners
    reference = (find_board(image, BOARD).corners + 0.5) * 3 - 0.5
    assert np.sqrt(np.mean(np.sum((found - reference) ** 2, axis=1))) < 0.2


def test_hidden_board_is_an_error(picture: tuple[NDArray[np.uint8], Transform]) -> None:
    image = picture[0].copy()
    image[:, :400] = 90
    with pytest.raises(ComputeError, match="no board of 16 × 23"):
        find_board(image, BOARD)
    with pytest.raises(DataError, match="grey"):
        find_board(np.zeros((10, 10, 3), dtype=np.uint8), BOARD)


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
    # the poses are those with which the corners were made
    expected = np.linalg.norm(poses[0][:3, 3])
    origin = inverse(result.T_camera_board[0])[:3, 3]
    centre = board_points(COLUMNS, ROWS, SQUARE_M).mean(axis=0)
    assert np.linalg.norm(origin - centre) == pytest.approx(expected, abs=3e-4)


def test_locating_a_view_agrees_with_the_corners() -> None:
    pose = _poses(3, 35)[2]
    corners = _corners(CAMERA, pose, 0.03, np.random.default_rng(0))
    T, rms = locate_view(_views([corners])[0], BOARD, CAMERA)
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


def _random_views(count: int, seed: int, *, noise_px: float = 0.04, shared_px: float = 0.0) -> list[BoardView]:
    """Noisy corners; with `shared_px` the corners of each image are also warped together, differently per image."""
    rng = np.random.default_rng(seed)
    points = BOARD.points()
    views: list[BoardView] = []
    while len(views) < count:
        angles = [rng.uniform(0, 360), rng.uniform(5, 40), rng.uniform(0, 360)]
        R = Rotation.from_euler("zxz", angles, degrees=True).as_matrix()
        place = np.array([rng.uniform(-0.06, 0.06), rng.uniform(-0.04, 0.04), rng.uniform(0.7, 1.0)])
        pixels = CAMERA.project(apply(transform(R, place - R @ points.mean(axis=0)), points))
        inside = ((pixels > 5) & (pixels < np.array(SIZE) - 6)).all(axis=1)
        if np.count_nonzero(inside) < 150:
            continue
        pixels += rng.normal(0, noise_px, pixels.shape)
        x, y = ((pixels - pixels.mean(axis=0)) / pixels.std(axis=0)).T
        pixels += np.stack([x * x, y * y, x * y, x**3, y**3], axis=1) @ rng.normal(0, shared_px, (5, 2))
        views.append(BoardView(np.flatnonzero(inside), pixels[inside]))
    return views


@pytest.mark.slow
@pytest.mark.parametrize("shared_px", [0.0, 0.02])
def test_stated_covariance_is_honest_also_when_the_corners_of_an_image_err_together(shared_px: float) -> None:
    squares: list[float] = []
    for seed in range(12):
        result = calibrate_intrinsics(_random_views(16, seed, shared_px=shared_px), BOARD, SIZE)
        error = np.array([getattr(result.camera, name) - getattr(CAMERA, name) for name in result.parameters])
        squares.append(float(error @ np.linalg.solve(result.covariance, error)) / len(error))
        assert result.inflation >= 1
        assert (result.inflation > 5) == (shared_px > 0)
    assert 0.4 < np.mean(squares) < 2.0


def test_leaving_a_view_out_is_what_a_new_adjustment_without_it_gives() -> None:
    views = _random_views(9, 3, shared_px=0.02)
    result = calibrate_intrinsics(views, BOARD, SIZE)
    validation = cross_validate(result)
    for k in (0, 4):
        without = calibrate_intrinsics([view for i, view in enumerate(views) if i != k], BOARD, SIZE)
        change = np.array([getattr(without.camera, n) - getattr(result.camera, n) for n in result.parameters])
        sigma = np.sqrt(np.diag(result.covariance))
        np.testing.assert_allclose(result.leave_one_out[k] / sigma, change / sigma, atol=0.15)
        assert locate_view(views[k], without.board, without.camera)[1] == pytest.approx(
            validation.leave_one_out_view_px[k], rel=0.02
        )
    assert validation.five_fold_rms_px > result.rms_px
    assert validation.five_fold_rms_px == pytest.approx(validation.leave_one_out_rms_px, rel=0.1)


@pytest.mark.parametrize("distance_m", [0.4, 0.8, 1.6])
def test_an_uncertainty_of_pixels_is_one_of_places_at_the_distance(distance_m: float) -> None:
    stated = projection_uncertainty(
        calibrate_intrinsics(_random_views(12, 0), BOARD, SIZE), distance_m, columns=7, rows=5
    )
    assert stated.distance_m == distance_m
    assert (stated.pixels[0, 0].tolist(), stated.pixels[-1, -1].tolist()) == ([0, 0], [SIZE[0] - 1, SIZE[1] - 1])
    assert stated.sigma_px.shape == stated.sigma_mm.shape == (5, 7)
    # The focal length is so many pixels per radian; the middle of the image is one of the grid's places here.
    assert stated.centre_mm == pytest.approx(stated.centre_px * 1e3 * distance_m / CAMERA.fx, rel=0.02)
    assert stated.sigma_px[2, 3] == pytest.approx(stated.centre_px, rel=1e-9)
    assert stated.sigma_mm[2, 3] == pytest.approx(stated.centre_mm, rel=1e-9)
    assert stated.worst_px == stated.sigma_px.max() > stated.rms_px > stated.sigma_px.min()
    assert stated.worst_mm == stated.sigma_mm.max() > stated.rms_mm > stated.sigma_mm.min()
    ratio = stated.sigma_mm / stated.sigma_px * CAMERA.fx / (1e3 * distance_m)
    assert ((ratio > 0.9) & (ratio < 1.3)).all()


def test_projection_uncertainty_counts_each_view_in_whatever_order_they_were_taken() -> None:
    views = _random_views(6, 0)
    first, second = (
        projection_uncertainty(calibrate_intrinsics(taken, BOARD, SIZE, model="pinhole"), 0.8, columns=3, rows=3)
        for taken in (views, views[::-1])
    )
    assert np.allclose(first.sigma_px, second.sigma_px, rtol=1e-4)


@pytest.mark.slow
def test_projection_uncertainty_is_the_spread_of_projections_over_calibrations() -> None:
    """Each calibrated camera is moved to fit the boards, as happens when its pose is estimated."""
    projected: list[Array] = []
    once = calibrate_intrinsics(_random_views(12, 0), BOARD, SIZE)
    stated = projection_uncertainty(once, 0.8, columns=6, rows=4)
    inflation = once.inflation  # a dozen images determine it only roughly; here it is known to be one
    rng = np.random.default_rng(5)
    clean = _random_views(12, 0, noise_px=0.0)
    truth = calibrate_intrinsics(clean, BOARD, SIZE)
    rays = np.column_stack([CAMERA.normalise(stated.pixels.reshape(-1, 2)), np.ones(24)]) * 0.8
    points = BOARD.points()
    for _ in range(30):
        noisy = [BoardView(v.indices, v.corners + rng.normal(0, 0.04, v.corners.shape)) for v in clean]
        result = calibrate_intrinsics(noisy, BOARD, SIZE)
        seen = [
            np.concatenate([apply(T, points[v.indices]) for T, v in zip(r.T_camera_board, clean, strict=True)])
            for r in (truth, result)
        ]
        motion, _ = align_points(seen[1], seen[0])
        projected.append(result.camera.project(apply(motion, rays)))
    spread = np.array(projected)
    observed = [np.sqrt(np.linalg.eigvalsh(np.cov(spread[:, k].T))[-1]) for k in range(24)]
    ratio = np.array(observed) / stated.sigma_px.ravel() * np.sqrt(inflation)
    assert 0.75 < np.median(ratio) < 1.3
    assert 0.5 < ratio.min() < ratio.max() < 1.8
    # px to mm at that distance: f pixels per radian
    assert stated.centre_mm == pytest.approx(stated.centre_px * 800 / CAMERA.fx, rel=0.02)
    with pytest.raises(DataError, match="not in front"):
        projection_uncertainty(truth, -1.0)


@pytest.mark.parametrize("model", ["pinhole", "radial2", "opencv5", "rational"])
def test_other_lens_models(model: LensModel) -> None:
    lens = {
        "pinhole": {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0},
        "radial2": {"p1": 0.0, "p2": 0.0},
        "opencv5": {"k1": -0.2, "k3": 0.3},
        "rational": {"k1": 0.3, "k4": 0.35, "k5": 0.05},
    }[model]
    camera = dataclasses.replace(CAMERA, **lens)
    points = BOARD.points()
    views: list[BoardView] = []
    for view in _random_views(14, 8, noise_px=0.0):
        T, _ = locate_view(view, BOARD, CAMERA)
        pixels = camera.project(apply(T, points[view.indices]))
        views.append(
            BoardView(view.indices, pixels + np.random.default_rng(len(views)).normal(0, 0.02, pixels.shape))
        )
    result = calibrate_intrinsics(views, BOARD, SIZE, model=model)
    assert result.rms_px < 0.035
    assert len(result.parameters) == {"pinhole": 4, "radial2": 6, "opencv5": 9, "rational": 12}[model]
    for name in result.parameters[:4]:
        assert abs(getattr(result.camera, name) - getattr(camera, name)) < 5 * result.sigma[name]
    rays = np.column_stack([camera.normalise(np.array([[200.0, 150.0], [700.0, 500.0]])), np.ones(2)])
    np.testing.assert_allclose(result.camera.project(rays), camera.project(rays), atol=0.3)


def test_a_view_that_suffered_from_a_worse_one_comes_back() -> None:
    views = _random_views(12, 2)
    rng = np.random.default_rng(0)
    for k, size_px in ((3, 40.0), (7, 6.0)):
        views[k] = BoardView(views[k].indices, views[k].corners + rng.normal(0, size_px, views[k].corners.shape))
    few = views[5]
    views[5] = BoardView(few.indices[:4], few.corners[:4])
    result = calibrate_intrinsics(views, BOARD, SIZE)
    assert [e.index for e in result.excluded] == [3, 5, 7]
    assert "4 corners" in result.excluded[1].reason
    assert "px, median" in result.excluded[0].reason


def test_warnings_name_what_is_weak() -> None:
    result = calibrate_intrinsics(_random_views(8, 1, shared_px=0.05), BOARD, SIZE, model="rational")
    words = " ".join(calibration_warnings(result, cross_validate(result), projection_uncertainty(result, 0.8)))
    assert "8 views" in words
    assert "is not determined" in words
    assert "images disagree" in words
