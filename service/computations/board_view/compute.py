"""Job `board_view`: finds the calibration board in an image; and how a calibration uses the result."""

from __future__ import annotations

import os

import cv2
import numpy as np

from service.computations import board_view as job
from service.computations import calibrate as calibrate_job
from service.computations.calibrate.records import KnownBoard
from service.computations.conversion import camera_of
from service.computations.job import JobAnswer, JobContext
from service.computations.records import BoardSize
from service.compute.board.board import Board, BoardView, find_board
from service.compute.board.knowledge import BoardKnowledge
from service.compute.board.search import BoardImage, find_boards, with_parts
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


def boards_of(
    context: JobContext[calibrate_job.Arguments], board: Board
) -> tuple[tuple[BoardImage, ...], dict[int, int]]:
    """Find the board in every image of a `calibrate` job, and count the corners in images that show a part of it.

    Images that `board_view` has searched are not searched again. Parts of the board are used if camera, mount and
    board are known well enough (`known`).
    """
    arguments = context.arguments
    images = arguments.images
    looked = arguments.corners or [None] * len(images)
    search = [k for k, sha256 in enumerate(looked) if sha256 is None]
    files = [context.input(images[k].sha256) for k in search]
    searched = dict(
        zip(
            search,
            find_boards(
                files,
                board,
                workers=os.cpu_count() or 1,
                progress=lambda done, total: context.progress("board images", done, total),
            ),
            strict=True,
        )
    )
    found = tuple(
        searched[k] if sha256 is None else read_corners(job.Corners.model_validate(context.input_json(sha256)))
        for k, sha256 in enumerate(looked)
    )
    if arguments.known is None or board.pattern != "checkerboard":
        return found, {}
    known = _knowledge(arguments.known)
    greys = [
        read_grey(context.input(image.sha256)) if one.view is None and one.size != (0, 0) else None
        for image, one in zip(images, found, strict=True)
    ]
    flanges = np.array([image.T_base_flange for image in images])
    whole = with_parts(found, greys, board, known, flanges)
    parts = {
        k: len(now.view.indices)
        for k, (before, now) in enumerate(zip(found, whole, strict=True))
        if before.view is None and now.view is not None
    }
    return whole, parts


def _knowledge(known: KnownBoard) -> BoardKnowledge:
    return BoardKnowledge(
        camera_of(known.camera),
        np.array(known.T_flange_camera),
        np.array(known.T_base_board),
        np.array(known.spread),
        known.focal,
        known.centre,
        known.measured,
    )
