"""Predicts the information that board images at given poses hold about the camera and its mount."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.compute.calibration.board.board import Board, BoardView
from service.compute.calibration.board_poses.knowledge import BoardKnowledge
from service.compute.calibration.hand_eye.reprojection import projection_jacobian
from service.compute.calibration.hand_eye.weighted import linearise
from service.compute.calibration.intrinsics.adjustment import Adjustment, linearised, project_with_jacobian
from service.compute.calibration.intrinsics.uncertainty import EstimatedCamera, uncertainty_of
from service.compute.camera_model import CameraModel
from service.core.geometry import Array, inverse

_PARAMETERS = 8  # fx … p2
# Prior before any image: focal lengths (relative), principal point (over the width), distortion.
_PRIOR_SIGMA = (0.05, 0.05, 0.02, 0.02, 0.2, 0.4, 2e-3, 2e-3)
_ARM_M, _ARM_RAD = 0.5e-3, 0.5e-3  # scatter of an arm's poses, per axis
_DISTANCE_M = 0.7  # at which projections are judged in the choice
_GRID = (12, 8)
_EVERY = 2  # use every second corner of rows and columns; more would only average noise


def lens_prior(camera: CameraModel) -> Array:
    """(8, 8) prior information from the nominal values."""
    scale = np.array([camera.fx, camera.fy, camera.width, camera.width, 1, 1, 1, 1])
    return np.diag(1 / (np.array(_PRIOR_SIGMA) * scale) ** 2)


def lens_information(boards: Array, camera: CameraModel, board: Board, corner_sigma_px: float) -> Array:
    """(C, 8, 8) information about fx … p2 from images of boards T_camera_board (C, 4, 4) whose poses are unknown."""
    some = (
        np.arange(board.columns * board.rows, dtype=np.int64)
        .reshape(board.rows, board.columns)[::_EVERY, ::_EVERY]
        .ravel()
    )
    weight = board.columns * board.rows / len(some) / corner_sigma_px**2
    return np.array([view.normal for view in _equations(boards, camera, board, some).views]) * weight


def lens_field(camera: CameraModel) -> Array:
    """(8, 8) matrix F such that trace(F C) is the mean variance, px², of projected points, less a camera motion.

    C is the covariance of fx … p2. Whatever a rigid motion of the camera can absorb is not a calibration error.
    """
    x, y = np.linspace(0, camera.width - 1, _GRID[0]), np.linspace(0, camera.height - 1, _GRID[1])
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = np.column_stack([camera.normalise(pixels), np.ones(len(pixels))]) * _DISTANCE_M
    _, by_pose, by_camera = project_with_jacobian(points, np.zeros(6), camera)
    J = by_camera[:, :_PARAMETERS]
    Q, _ = np.linalg.qr(by_pose)
    free = J - Q @ (Q.T @ J)
    return free.T @ free / len(pixels)


def hand_eye_information(T_base_camera: Array, known: BoardKnowledge, board: Board, corner_sigma_px: float) -> Array:
    """(C, 12, 12) information of each pose about T_flange_camera and T_base_board."""
    points = board.points()
    corners = points.reshape(board.rows, board.columns, 3)[:: board.rows - 1, :: board.columns - 1].reshape(-1, 3)
    share = len(points) / len(corners)
    X, B = known.T_flange_camera, known.T_base_board
    flanges = T_base_camera @ inverse(X)
    boards = np.array([inverse(T) @ B for T in T_base_camera])
    _, J_px = projection_jacobian(corners, boards, known.camera)
    rows = J_px.reshape(len(boards), -1, 6)
    covariance = inverse_of(np.swapaxes(rows, 1, 2) @ rows * share) * corner_sigma_px**2
    _, J, from_board = linearise(flanges, boards, X, B)
    noise = np.diag([_ARM_M**2] * 3 + [_ARM_RAD**2] * 3)
    V = noise + from_board @ covariance @ np.swapaxes(from_board, 1, 2)
    return np.swapaxes(J, 1, 2) @ np.linalg.solve(V, J)


def uncertainty_mm(boards: Array, camera: CameraModel, board: Board, corner_sigma_px: float) -> float:
    """Predicted `projection_uncertainty` of a calibration from boards T_camera_board (N, 4, 4), worst in the image.

    At the boards' median distance; NaN if they do not determine the camera.
    """
    everything = np.arange(board.columns * board.rows, dtype=np.int64)
    solution = _equations(boards, camera, board, everything)
    normal = np.sum([view.normal for view in solution.views], axis=0)
    variance = corner_sigma_px**2
    scale = 1 / np.sqrt(np.diag(normal))
    if np.linalg.eigvalsh(normal * np.outer(scale, scale))[0] < 1e-13:
        return float("nan")
    views = tuple(BoardView(everything, np.zeros((len(everything), 2))) for _ in boards)
    covariance = inverse_of(normal[None])[0] * variance
    flat = np.zeros((len(everything), 0))
    known = EstimatedCamera(camera, board, views, solution, covariance, flat, variance)
    middle = np.append(board.points().mean(axis=0), 1.0)
    return uncertainty_of(known, float(np.median((boards @ middle)[:, 2]))).worst_mm


def inverse_of(information: Array) -> Array:
    """(N, K, K) inverses of positive definite matrices, scaled first because their units differ widely."""
    scale = 1 / np.sqrt(np.einsum("nii->ni", information))
    both = scale[:, :, None] * scale[:, None, :]
    return np.linalg.inv(information * both) * both


def _equations(boards: Array, camera: CameraModel, board: Board, which: NDArray[np.int64]) -> Adjustment:
    return linearised(boards, board.points()[which], camera, _PARAMETERS)
