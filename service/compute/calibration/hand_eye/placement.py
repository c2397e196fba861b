"""A board located in the base frame of a robot whose hand-eye transform is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.compute.calibration.hand_eye.closed_form import deviation, mean_pose
from service.core.errors import DataError
from service.core.geometry import Array, Transform


@dataclass(frozen=True, slots=True)
class BoardPlacement:
    """A board located in a robot's base frame through a calibrated hand-eye.

    Attributes:
        T_base_board: mean over the views.
        residual_mm: (N,) distance of each view's board origin from the mean.
        residual_deg: (N,) angle of each view's board from the mean.
        sigma_mm: standard error of the mean position.
    """

    T_base_board: Transform
    residual_mm: Array
    residual_deg: Array
    sigma_mm: float


def place_board(T_base_flange: Array, T_camera_board: Array, T_flange_camera: Transform) -> BoardPlacement:
    """Mean pose of a board in the base frame of the station that saw it.

    One board joins two stations: T_base1_base2 = T_base1_board · inverse(T_base2_board), if it has not
    moved in between.

    Raises:
        DataError: no view, or array shapes do not match.
    """
    if T_base_flange.shape != T_camera_board.shape or len(T_base_flange) == 0:
        raise DataError(f"robot poses {T_base_flange.shape} and board poses {T_camera_board.shape} do not match")
    placed = T_base_flange @ T_flange_camera @ T_camera_board
    mean = mean_pose(placed)
    residual_mm, residual_deg = deviation(placed, mean)
    n = len(placed)
    sigma = float(np.sqrt(np.sum(residual_mm**2) / max(n - 1, 1) / n))
    return BoardPlacement(mean, residual_mm, residual_deg, sigma)
