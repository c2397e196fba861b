"""A partly visible checkerboard: its corners are identified by the arm's pose, or not at all."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import find_board
from service.compute.calibration.board_knowledge import BoardKnowledge
from service.compute.calibration.board_search import BoardImage, find_part, with_parts
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse, look_at, transform
from tests.support.boards.board_bench import BOARD, LENS, Picture
from tests.support.boards.board_images import checkerboard, photograph

KNOWN = BoardKnowledge(LENS, np.eye(4), np.eye(4), 1e-3 * np.eye(12), 0.005, 0.003, 8)
SHADE = checkerboard(BOARD.columns, BOARD.rows, BOARD.square_m)
MIDDLE = BOARD.points().mean(axis=0)


def camera_pose(shift_m: tuple[float, float]) -> Transform:
    """T_base_camera, with the board's frame as base: tilted, and shifted so that the board is partly cut off."""
    away = Rotation.from_euler("x", 20, degrees=True).apply([0.0, 0.0, -0.62])
    T = look_at(MIDDLE + away, MIDDLE, np.array([1.0, 0.0, 0.0]))
    return T @ transform(np.eye(3), np.array([*shift_m, 0.0]))


def taken_from(T_base_camera: Transform) -> tuple[Picture, Array]:
    """An image and its true corners."""
    grey = photograph(SHADE, LENS, inverse(T_base_camera), np.random.default_rng(4), samples=3)
    return grey, LENS.project(apply(inverse(T_base_camera), BOARD.points()))


@pytest.mark.parametrize("shift_m", [(0.12, 0.0), (-0.1, 0.06), (0.0, -0.09)])
def test_the_corners_of_a_cut_board_are_found_where_they_are(shift_m: tuple[float, float]) -> None:
    T = camera_pose(shift_m)
    image, truth = taken_from(T)
    with pytest.raises(ComputeError):
        find_board(image, BOARD)
    believed = T @ transform(Rotation.from_rotvec([0.002, -0.002, 0.003]), np.array([0.002, -0.001, 0.002]))
    view = find_part(image, BOARD, KNOWN, believed)
    assert 24 <= len(view.indices) < len(truth)
    assert np.linalg.norm(view.corners - truth[view.indices], axis=1).max() < 0.2


def test_corners_are_not_named_where_half_a_square_is_in_doubt() -> None:
    T = camera_pose((0.12, 0.0))
    image, _ = taken_from(T)
    for off in (0.35, 0.5, 0.75, 1.0):
        with pytest.raises(ComputeError):
            find_part(image, BOARD, KNOWN, T @ transform(np.eye(3), np.array([off * BOARD.square_m, 0.0, 0.0])))
    vague = dataclasses.replace(KNOWN, spread=0.02 * np.eye(12))
    with pytest.raises(ComputeError, match="half a square"):
        find_part(image, BOARD, vague, T)
    with pytest.raises(ComputeError, match="corners of the board can be seen"):
        find_part(np.full_like(image, 120), BOARD, KNOWN, T)


def test_a_board_that_is_covered_in_part_counts_by_what_is_seen() -> None:
    T = camera_pose((0.0, 0.0))
    image, truth = taken_from(T)
    image[:, :280] = 60
    unseen = BoardImage((LENS.width, LENS.height), None, "no board")
    (one,) = with_parts([unseen], [image], BOARD, KNOWN, T[None])
    assert one.view is not None
    assert one.view.corners[:, 0].min() > 280
    assert np.linalg.norm(one.view.corners - truth[one.view.indices], axis=1).max() < 0.2
    (none,) = with_parts(
        [BoardImage((LENS.width, LENS.height), None, "no board")], [np.zeros_like(image)], BOARD, KNOWN, T[None]
    )
    assert none.view is None
    assert none.reason.startswith("no board; in part: only")
