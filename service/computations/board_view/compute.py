"""Job `board_view`: finds the calibration board in an image."""

from __future__ import annotations

import cv2
import numpy as np

from service.computations import board_view as job
from service.computations.job import JobAnswer, JobContext
from service.computations.records import BoardSize
from service.compute.calibration.board import Board, BoardView, find_board
from service.compute.calibration.board_search import BoardImage
from service.compute.images.photographs import image_quality, read_grey
from service.core.errors import ComputeError

_WHITE = 245.0  # an image counts as white if nearly all grey levels exceed this


def board_of(size: BoardSize) -> Board:
    """Return the board of a job's arguments."""
    return Board(size.columns, size.rows, size.square_m)


def board_view(context: JobContext[job.Arguments]) -> JobAnswer:
    """Find the whole board in an image, or the reason why not; and measure the sharpness of the image."""
    image = context.arguments.image
    cv2.setNumThreads(1)  # the capture goes on in parallel
    grey = read_grey(context.input(image.sha256))
    size = (grey.shape[1], grey.shape[0])
    quality = image_quality(grey)
    measures = {} if np.isnan(quality.edge_px) else {"image_edge_px": quality.edge_px}

    def answer(reason: str = "") -> job.Answer:
        return job.Answer(viewpoint=image.viewpoint, size=size, seen=not reason, reason=reason, black=quality.black)

    try:
        view = find_board(grey, board_of(context.arguments))
    except ComputeError as error:
        bright = float(np.percentile(grey, 1)) > _WHITE
        reason = "the image is black" if quality.black else "the image is white" if bright else plain_reason(error)
        return JobAnswer(measures, (), answer(reason))
    corners = np.round(view.corners, 4).tolist()
    record = job.Corners(size=size, indices=view.indices.tolist(), corners=corners)
    ref = context.keep_json(record.plain(), kind="board_corners", name=f"{image.viewpoint}.corners.json")
    return JobAnswer(measures | {"corners": float(len(view.indices))}, (ref,), answer())


def plain_reason(error: ComputeError) -> str:
    """Return why no board was found, without the details of the search."""
    return error.what.partition(" (searched")[0]


def read_corners(record: job.Corners) -> BoardImage:
    """Return the board in an image, from the file of `board_view`."""
    indices, corners = np.array(record.indices, dtype=np.int64), np.array(record.corners, dtype=np.float64)
    return BoardImage(record.size, BoardView(indices, corners))
