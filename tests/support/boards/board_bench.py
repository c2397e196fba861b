"""An in-memory rig whose camera photographs a checkerboard; poses, mount and lens differ from their stated values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import Board
from service.compute.camera_model import CameraModel
from service.core.geometry import Transform, apply, inverse, transform
from tests.support.boards.board_images import checkerboard, photograph
from tests.support.rig.bench_rig import BenchRig
from tests.support.runs.bench_run import Bench
from tests.support.runs.computing_run import compute_jobs

BOARD = Board(7, 10, 0.030)
LENS = CameraModel(600, 400, 848.0, 848.5, 301.5, 198.0, -0.05, 0.02, 2e-4, -2e-4)
MOUNT = transform(Rotation.from_rotvec([0.006, -0.008, 0.009]), np.array([0.0012, -0.0009, 0.1008]))  # drawn: 0 0 0.1

Picture = NDArray[np.uint8]


def board_pose(shift_m: tuple[float, float, float] = (0.015, -0.012, 0.004), turn_deg: float = 5.0) -> Transform:
    """T_base_board of a board near its place in PROTOCOL: face up above the scene's centre, its long side across."""
    laid = np.column_stack([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    R = Rotation.from_euler("xyz", [1.5, -2.0, turn_deg], degrees=True).as_matrix() @ laid
    middle = np.array([0.0, 0.8, 0.09]) + shift_m
    return transform(R, middle - R @ BOARD.points().mean(axis=0))


@dataclass
class BoardRoom:
    """What the bench's camera sees, and what happens to its images.

    Attributes:
        spoil: turns a good picture into a spoilt one, by the exposure's number.
        cut: exposures in which the board was cut off.
    """

    rig: BenchRig
    T_base_board: Transform = field(default_factory=board_pose)
    spoil: Callable[[int, Picture], Picture] = lambda _exposure, picture: picture
    cut: list[int] = field(default_factory=list[int])

    def picture(self, exposure: int) -> Picture:
        """The photograph from the arm's current pose."""
        flange = self.rig.arm.state().sample.T_base_flange
        T_camera_board = inverse(flange @ MOUNT) @ self.T_base_board
        corners = LENS.project(apply(T_camera_board, BOARD.points()))
        if not ((corners > 8) & (corners < np.array([LENS.width, LENS.height]) - 9)).all():
            self.cut.append(exposure)
        shade = checkerboard(BOARD.columns, BOARD.rows, BOARD.square_m)
        grey = photograph(shade, LENS, T_camera_board, np.random.default_rng(exposure), samples=2)
        return self.spoil(exposure, grey)


def board_room(bench: Bench) -> BoardRoom:
    """Give a bench this camera, and a worker that serves while the runner waits."""
    room = BoardRoom(bench.rig)
    bench.rig.shutter.picture = room.picture
    bench.operator.on_show = lambda _what: _serve(bench)
    return room


def _serve(bench: Bench) -> None:
    compute_jobs(bench.store)


PROTOCOL = """
id: bench
version: "1"
title: A calibration
spheres: {radius_mm: 15, registration: 10, control: 3}
board: {columns: 7, rows: 10, square_mm: 30}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
motion: {dwell_s: 0.0}
settle: {window_s: 0.01, timeout_s: 5}
steps:
  - id: calibration
    kind: calibration
    title: Calibrate
    params:
      solve: [intrinsics, hand_eye]
      board_poses: {station: station_1, prefix: b, count: 14, coverage: 1.0}
    gates:
      - {measure: views, min: 14}
      - {measure: coverage, min: 0.9}
      - {measure: tilt_deg, min: 30}
      - {measure: uncertainty_mm, max: 0.2}
      - {measure: rotation_spread_deg, min: 40}
      - {measure: hand_eye_sigma_mm, max: 0.5}
    recovery: {retries: 2, wait_s: 0}
"""
