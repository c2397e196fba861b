"""Candidate camera poses for which the whole board stays in the frame despite everything not yet known."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from service.compute.calibration.board.board import Board
from service.compute.calibration.board_poses.knowledge import BoardKnowledge
from service.compute.calibration.board_poses.view_range import ViewRange
from service.compute.camera_model import CameraModel
from service.core.geometry import Array, Transform, apply, inverse, look_at, transform

_ANCHORS = tuple(product((0, -1, 1), (0, -1, 1)))  # places in the frame: its middle, edges and corners
_ROUNDS = 4
_MARGIN = 0.006  # of the image's width, on top of all uncertainty
_DRAWS, _CHECKED = 16, 64
_MOST = 800


@dataclass(frozen=True, slots=True)
class Candidates:
    """Camera poses T_base_camera (C, 4, 4), and the board points' expected pixels (C, P, 2)."""

    T_base_camera: Array
    pixels: Array

    def take(self, which: NDArray[np.int64]) -> Candidates:
        """Only the candidates with these indices."""
        return Candidates(self.T_base_camera[which], self.pixels[which])


def board_candidates(
    known: BoardKnowledge,
    board: Board,
    wishes: ViewRange,
    approach: Array,
    *,
    most: int = _MOST,
    seed: int = 0,
    draw: int = 0,
) -> Candidates:
    """Poses that keep the whole printed board in the frame for every truth within the tolerances.

    Args:
        known: nominal values or estimates, with their tolerances.
        board: the board.
        wishes: tilts, rolls and distances.
        approach: (3,) horizontal unit vector from the scene towards the base; images are upright for a viewer there.
        most: number of poses tried, drawn at random from all combinations.
        seed: of the draw.
        draw: 1 for the next so many combinations, which the draw before did not have, and so on.

    Returns:
        Candidates, possibly none.
    """
    grid = _grid(known, board, wishes, approach)
    rng = np.random.default_rng([seed, 0xCA11])
    pick = rng.permutation(len(grid) * len(_ANCHORS))[draw * most : (draw + 1) * most]
    poses = np.array([grid[k // len(_ANCHORS)] for k in pick]).reshape(-1, 4, 4)
    anchors = np.array([_ANCHORS[k % len(_ANCHORS)] for k in pick], dtype=np.float64).reshape(-1, 2)
    outline = _outline(board)
    truth = _ToleranceDraws(known, outline, _DRAWS)
    poses = _pushed(poses, anchors, known.camera, truth)
    poses = poses[_inside(poses, known.camera, truth)]
    poses = poses[_inside(poses, known.camera, _ToleranceDraws(known, outline, _CHECKED, seed=1))]
    return Candidates(poses, expected_pixels(known, board, poses))


def expected_pixels(known: BoardKnowledge, board: Board, T_base_camera: Array) -> Array:
    """(C, P, 2) pixels of the board's points for the estimated camera, mount and board."""
    boards = np.array([inverse(T) @ known.T_base_board for T in T_base_camera]).reshape(-1, 4, 4)
    points = np.einsum("nij,pj->npi", boards[:, :3, :3], board.points()) + boards[:, None, :3, 3]
    return known.camera.project(points.reshape(-1, 3)).reshape(len(boards), len(board.points()), 2)


def _outline(board: Board) -> Array:
    """(8, 3) edge of the printed squares in the board frame; it lies one square beyond the inner corners."""
    points = board.points()[:, :2]
    low, high = points.min(axis=0) - board.square_m, points.max(axis=0) + board.square_m
    share = [(0, 0), (0.5, 0), (1, 0), (1, 0.5), (1, 1), (0.5, 1), (0, 1), (0, 0.5)]
    return np.column_stack([low + np.array(share) * (high - low), np.zeros(len(share))])


class _ToleranceDraws:
    """Draws within the tolerances: the true pose of a camera sent to a pose, and the true place of the board."""

    def __init__(self, known: BoardKnowledge, outline: Array, count: int, seed: int = 0) -> None:
        hands, boards, self.zoom, self.shift_px = known.draws(count, seed)
        self.camera = known.camera
        T_flange_camera = known.T_flange_camera
        self.T_true_sent = np.array([inverse(hand) @ T_flange_camera for hand in hands])  # (D, 4, 4)
        self.outline_base = np.array([apply(board, outline) for board in boards])  # (D, K, 3)

    def pixels(self, T_base_camera: Array) -> tuple[Array, Array]:
        """(C, D, K, 2) pixels of the outline and (C, D, K) its depths, m."""
        R = T_base_camera[:, :3, :3]
        moved = self.outline_base[None] - T_base_camera[:, None, None, :3, 3]
        sent = np.einsum("cji,cdkj->cdki", R, moved)
        turned = (
            np.einsum("dij,cdkj->cdki", self.T_true_sent[:, :3, :3], sent) + self.T_true_sent[None, :, None, :3, 3]
        )
        pixels = self.camera.project(turned.reshape(-1, 3)).reshape(*turned.shape[:3], 2)
        middle = np.array([self.camera.cx, self.camera.cy])
        return (pixels - middle) * self.zoom[:, None, None] + middle + self.shift_px[:, None], turned[..., 2]


def _grid(known: BoardKnowledge, board: Board, wishes: ViewRange, approach: Array) -> list[Transform]:
    middle = apply(known.T_base_board, board.points().mean(axis=0))
    normal = -known.T_base_board[:3, 2]
    towards = approach - (approach @ normal) * normal
    towards /= np.linalg.norm(towards)
    side = np.cross(normal, towards)
    poses: list[Transform] = []
    for tilt in np.radians(wishes.tilts_deg):
        for azimuth in np.arange(wishes.azimuths if tilt > 0 else 1) * 2 * np.pi / wishes.azimuths:
            out = np.cos(tilt) * normal + np.sin(tilt) * (np.cos(azimuth) * towards + np.sin(azimuth) * side)
            for distance, roll in product(wishes.distances_m, np.radians(wishes.rolls_deg)):
                c, s = np.cos(roll), np.sin(roll)
                about = transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
                poses.append(look_at(middle + distance * out, middle, -towards) @ about)
    return poses


def _pushed(poses: Array, anchors: Array, camera: CameraModel, truth: _ToleranceDraws) -> Array:
    """Each pose shifted in its image plane until the board touches the wanted side of the frame, or is centred."""
    size, margin = np.array([camera.width, camera.height]), _MARGIN * camera.width
    poses = poses.copy()
    for _ in range(_ROUNDS):
        pixels, depth = truth.pixels(poses)
        low, high = pixels.min(axis=(1, 2)), pixels.max(axis=(1, 2))
        left, right = margin - low, size - 1 - margin - high  # the range of shifts
        wanted = np.where(anchors < 0, left, np.where(anchors > 0, right, (left + right) / 2))
        # Moving the camera to the left moves the image to the right.
        shift = -wanted * depth.mean(axis=(1, 2))[:, None] / [camera.fx, camera.fy]
        poses[:, :3, 3] += np.einsum("cij,cj->ci", poses[:, :3, :2], shift)
    return poses


def _inside(poses: Array, camera: CameraModel, truth: _ToleranceDraws) -> NDArray[np.bool_]:
    pixels, depth = truth.pixels(poses)
    margin = 0.5 * _MARGIN * camera.width
    within = (pixels >= margin) & (pixels <= np.array([camera.width, camera.height]) - 1 - margin)
    return np.asarray(within.all(axis=(1, 2, 3)) & (depth > 0.05).all(axis=(1, 2)), dtype=np.bool_)
