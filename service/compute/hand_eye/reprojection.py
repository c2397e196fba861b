"""Covariance of board poses from their corners, and hand-eye by least reprojection error (12 parameters)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.board.board import Board, BoardView
from service.compute.camera_model import CameraModel
from service.compute.descent import halved_gauss_newton, largest
from service.compute.hand_eye.weighted import linearise
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, increment, inverse, skew

_STEP_M = 1e-6
_ITERATIONS = 30


@dataclass(frozen=True, slots=True)
class BoardCorners:
    """Detected corners of N board views.

    Attributes:
        points_m: (P, 3) points in the board frame.
        corners_px: (N, P, 2) detected; NaN for corners that were not seen.
        camera: the calibrated camera.
    """

    points_m: Array
    corners_px: Array
    camera: CameraModel

    def __post_init__(self) -> None:
        if self.corners_px.ndim != 3 or self.corners_px.shape[1:] != (len(self.points_m), 2):
            raise DataError(f"{self.corners_px.shape} corners for a board of {len(self.points_m)} points")

    def take(self, which: NDArray[np.bool_]) -> BoardCorners:
        """Select these views."""
        return BoardCorners(self.points_m, self.corners_px[which], self.camera)


def board_corners(views: Sequence[BoardView], board: Board, camera: CameraModel) -> BoardCorners:
    """Return the corners of a board's views, which may be partial, as one array."""
    points = board.points()
    pixels = np.full((len(views), len(points), 2), np.nan)
    for row, view in zip(pixels, views, strict=True):
        row[view.indices] = view.corners
    return BoardCorners(points, pixels, camera)


def projection_jacobian(points_m: Array, T_camera_board: Array, camera: CameraModel) -> tuple[Array, Array]:
    """Return pixels (N, P, 2) and derivatives (N, P, 2, 6) by the increment (d, w) of T_camera_board (N, 4, 4)."""
    points = np.einsum("nij,pj->npi", T_camera_board[:, :3, :3], points_m) + T_camera_board[:, None, :3, 3]
    shape = points.shape[:2]

    def project(p: Array) -> Array:
        return camera.project(p.reshape(-1, 3)).reshape(*shape, 2)

    # Central differences over a micrometre are accurate to nine digits and work for any lens model.
    to_point = np.stack(
        [(project(points + shift) - project(points - shift)) / (2 * _STEP_M) for shift in np.eye(3) * _STEP_M],
        axis=-1,
    )
    arms = (points - T_camera_board[:, None, :3, 3]).reshape(-1, 3)
    turn = -to_point @ skew(arms).reshape(*shape, 3, 3)
    return project(points), np.concatenate([to_point, turn], axis=-1)


def board_covariance(corners: BoardCorners, T_camera_board: Array) -> tuple[Array, float]:
    """Return (N, 6, 6) covariance of each board pose, and the corners' standard deviation in px behind it.

    The latter is the median over the views of their residuals' standard deviation per axis.
    """
    pixels, J = projection_jacobian(corners.points_m, T_camera_board, corners.camera)
    residual = (corners.corners_px - pixels).reshape(len(pixels), -1)
    rows = J.reshape(len(J), -1, 6)
    seen = np.isfinite(residual)
    freedom = np.maximum(seen.sum(axis=1) - 6, 1)
    sigma_px = float(np.median(np.sqrt(np.nansum(residual**2, axis=1) / freedom)))
    rows = np.where(seen[:, :, None], rows, 0.0)
    normal = np.swapaxes(rows, 1, 2) @ rows
    scale = 1 / np.sqrt(np.einsum("nii->ni", normal))
    both = scale[:, :, None] * scale[:, None, :]
    return np.linalg.inv(normal * both) * both * sigma_px**2, sigma_px


def _grams(hands: Array, corners: BoardCorners, X: Transform, B: Transform) -> Array:
    """Return (N, 13, 13) Gram matrices of each view's rows [J | residual]."""
    boards = np.array([inverse(hand @ X) @ B for hand in hands])
    pixels, J = projection_jacobian(corners.points_m, boards, corners.camera)
    _, to_flange, from_board = linearise(hands, boards, X, B)
    chained = J @ np.linalg.solve(from_board, -to_flange)[:, None]
    rows = np.concatenate([chained, (pixels - corners.corners_px)[..., None]], axis=-1).reshape(len(hands), -1, 13)
    rows = np.where(np.isfinite(rows[:, :, 12:]), rows, 0.0)
    return np.swapaxes(rows, 1, 2) @ rows


def _step(gram: Array) -> Array:
    H = gram[:12, :12]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.sqrt(np.diag(H))
        scaled = H * scale[:, None] * scale
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e12:
        raise ComputeError(
            "the views do not determine the hand-eye transform", remedy="Take views with more rotation"
        )
    return -scale * np.linalg.solve(scaled, scale * gram[:12, 12])


def solve_reprojection(
    hands: Array, corners: BoardCorners, X: Transform, B: Transform
) -> tuple[Transform, Transform]:
    """Minimise the reprojection error over T_flange_camera and T_base_board, with the robot's poses fixed.

    The paper's method, by Gauss–Newton. It attributes the robot's errors, which are many times larger, to the images.

    Args:
        hands: (N, 4, 4) T_base_flange.
        corners: the board's corners in the N views.
        X: initial T_flange_camera.
        B: initial T_base_board.

    Raises:
        ComputeError: the views do not determine the answer, or it did not converge.
    """

    def at(hand_eye: Transform, board: Transform) -> _Iterate:
        gram = _grams(hands, corners, hand_eye, board).sum(axis=0)
        return _Iterate(hand_eye, board, _step(gram), float(gram[12, 12]))

    def candidate(here: _Iterate, share: float) -> _Iterate:
        step = share * here.step
        return at(increment(here.hand_eye, step[:3], step[3:6]), increment(here.board, step[6:9], step[9:]))

    found = halved_gauss_newton(at(X, B), candidate, _gain, _settles, most=_ITERATIONS)
    if not found.settled:
        raise ComputeError("the reprojection error did not converge", remedy="Check robot poses and board size")
    return found.state.hand_eye, found.state.board


@dataclass(frozen=True, slots=True)
class _Iterate:
    """The two transforms, the Gauss–Newton step (12,) from them, and the sum of squares in px²."""

    hand_eye: Transform
    board: Transform
    step: Array
    square_px2: float


def _gain(here: _Iterate, there: _Iterate) -> float:
    """A sum that grows by rounding alone does not count as grown."""
    return here.square_px2 * (1 + 1e-12) - there.square_px2 if np.isfinite(there.square_px2) else -np.inf


def _settles(here: _Iterate, there: _Iterate) -> bool:
    return largest(here.step) < 1e-9 or abs(here.square_px2 - there.square_px2) < 1e-14 * here.square_px2


def resample_reprojection(hands: Array, corners: BoardCorners, X: Transform, B: Transform, counts: Array) -> Array:
    """Return (R, 12) increments of the answer if view i counts `counts[r, i]` times."""
    flat = counts @ _grams(hands, corners, X, B).reshape(len(hands), -1)
    return np.array([_step(row.reshape(13, 13)) for row in flat])
