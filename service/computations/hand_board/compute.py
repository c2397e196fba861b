"""Job `hand_board`: a hand-held image of the calibration board; its pose, whether it counts, and where to go next."""

from __future__ import annotations

import cv2
import numpy as np

from service.computations import hand_board as job
from service.computations.hand_view.answer import NewImage, answer_to, read_views
from service.computations.inputs import nominal_camera
from service.computations.job import JobAnswer, JobContext
from service.computations.scene import CaptureScene, limits_of
from service.compute.calibration.board import Board, find_board
from service.compute.calibration.intrinsics import coverage_map_of, locate_view
from service.compute.images.photographs import read_grey
from service.core.errors import ComputeError
from service.core.geometry import inverse


def hand_board(context: JobContext[job.Arguments]) -> JobAnswer:
    """Locate the camera by the board, with nominal intrinsics."""
    cv2.setNumThreads(1)
    arguments = context.arguments
    board = Board(arguments.columns, arguments.rows, arguments.square_m)
    grey = read_grey(context.input(arguments.image.sha256))
    size = (grey.shape[1], grey.shape[0])
    camera = nominal_camera(*size, arguments.image.focal_mm, arguments.sensor_width_mm)
    scene = CaptureScene(camera, np.zeros((0, 3)), 0.0, limits_of(arguments.limits), None)
    pose, why, measures, cells = None, "", {}, np.zeros((0, 0), dtype=np.int64)
    try:
        corners = find_board(grey, board)
        T_camera_board, rms_px = locate_view(corners, board, camera)
    except ComputeError as error:
        why = error.what
    else:
        pose, cells = inverse(T_camera_board), coverage_map_of([corners.corners], size)
        measures = {"corners": float(len(corners.indices)), "nominal_rms_px": rms_px}
    up = np.array([0.0, 0.0, -1.0])  # the board's z axis points into the table
    found = NewImage(pose, why, measures, np.zeros((6, 6)), up, board.points().mean(axis=0), cells)
    return answer_to(context, found, scene, read_views(context, scene))
