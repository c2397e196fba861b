"""Folders of photographs of a board with the poses of the robot that held the camera, with known ground truth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import Board
from service.compute.camera_model import CameraModel
from service.compute.poses.pose_files import write_poses_csv
from service.core.geometry import Array, inverse, transform
from tests.support.boards.board_images import Shade, checkerboard, photograph, printed

CAMERA = CameraModel(900, 600, 1260, 1261, 452.0, 301.0, -0.045, 0.03, 4e-4, -5e-4)
T_FLANGE_CAMERA = transform(
    Rotation.from_euler("xyz", [4, -7, 31], degrees=True).as_matrix(), np.array([0.03, -0.05, 0.11])
)
T_BASE_BOARD = transform(
    Rotation.from_euler("xyz", [178, 3, 40], degrees=True).as_matrix(), np.array([0.6, -0.1, 0.02])
)


@dataclass(frozen=True)
class BoardFolder:
    """What a user would have: images, camera.json and the robot's poses."""

    images: Path
    camera: Path
    T_base_flange: dict[str, Array]

    def poses(self, path: Path, T: Sequence[Array] | None = None) -> Path:
        """Write a CSV of the robot's poses, or of other poses for the same images."""
        write_poses_csv(path, dict(zip(self.T_base_flange, T or self.T_base_flange.values(), strict=True)))
        return path


def drawn_charuco(board: Board) -> Shade:
    """A printed ChArUco board."""
    pixels = 60
    size = ((board.columns + 1) * pixels, (board.rows + 1) * pixels)
    picture = np.asarray(board.charuco().generateImage(size), dtype=np.uint8)
    pixel_m = board.square_m / pixels
    return printed(picture, pixel_m, np.array([-board.square_m, -board.square_m]))


def board_folder(folder: Path, board: Board, *, count: int = 9, noise_mm: float = 0.0) -> BoardFolder:
    """Photographs of a board from all sides."""
    images = folder / "images"
    images.mkdir(parents=True)
    shade = drawn_charuco(board) if board.pattern == "charuco" else checkerboard(
        board.columns, board.rows, board.square_m
    )  # fmt: skip
    rng = np.random.default_rng(4)
    poses: dict[str, Array] = {}
    middle = board.points().mean(axis=0)
    for k in range(count):
        R = Rotation.from_euler("zxz", [k * 50, 8 + 3 * k, -k * 50 + (k % 3) * 8], degrees=True).as_matrix()
        place = np.array([0.03 * (k % 3 - 1), 0.02 * (k % 2), 0.52])
        T_camera_board = transform(R, place - R @ middle)
        name = f"b{k}.jpg"
        picture = photograph(shade, CAMERA, T_camera_board, rng, samples=2)
        cv2.imwrite(str(images / name), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
        T = T_BASE_BOARD @ inverse(T_camera_board) @ inverse(T_FLANGE_CAMERA)
        T[:3, 3] += rng.normal(0, 1e-3 * noise_mm, 3)
        poses[name] = T
    camera = folder / "camera.json"
    camera.write_text(json.dumps(CAMERA.record()))
    return BoardFolder(images, camera, poses)
