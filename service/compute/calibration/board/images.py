"""Finds the board in many image files at once, in parallel processes, with a reason for each failure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import cv2

from service.compute.calibration.board.board import Board, BoardView, Grey, find_board
from service.compute.calibration.board.diagnosis import Diagnosis, diagnose, wrong_board
from service.compute.images.files import read_grey
from service.core.errors import ComputeError, DataError
from service.logs.terminal import show_own_words_only

_MANY_FILES = 24
_MANY_BYTES = 30e6
_PROBED = 4  # images tried before all are searched


@dataclass(frozen=True, slots=True)
class BoardImage:
    """What one image file shows; if it cannot be used, `view` is None and `reason` says why."""

    size: tuple[int, int]
    view: BoardView | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class UsableViews:
    """The views with one common image size, and the reasons for all others.

    Attributes:
        size: common width and height, px.
        indices: (N) indices of the images.
        views: (N).
        excluded: reason by image index.
    """

    size: tuple[int, int]
    indices: tuple[int, ...]
    views: tuple[BoardView, ...]
    excluded: dict[int, str]


def find_boards(
    files: Sequence[Path],
    board: Board,
    *,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[BoardImage, ...]:
    """Find the board in every image file. A file that cannot be read gets a reason and raises no error.

    Args:
        files: images.
        board: the board to find.
        workers: largest number of processes.
        progress: called with the number of images done and the total.

    Raises:
        DataError: the board's description is invalid (for example, its ChArUco dictionary is too small).
    """
    if board.pattern == "charuco":
        board.charuco()
    work = partial(_find, board=board)
    found: list[BoardImage] = []
    if workers <= 1 or not _worth_processes(files):
        for file in files:
            found.append(work(file))
            if progress:
                progress(len(found), len(files))
        return tuple(found)
    pool_of = partial(ProcessPoolExecutor, mp_context=get_context("spawn"), initializer=show_own_words_only)
    with pool_of(min(workers, len(files))) as pool:
        for image in pool.map(work, files):
            found.append(image)
            if progress:
                progress(len(found), len(files))
    return tuple(found)


def probe_board(files: Sequence[Path], board: Board) -> Diagnosis | None:
    """A mistake in the board's description, from a few of the images; None if it is found or nothing explains it."""
    some = [files[k] for k in sorted({round(k * (len(files) - 1) / (_PROBED - 1)) for k in range(_PROBED)})]
    greys: list[Grey] = []
    for file in some:
        try:
            greys.append(read_grey(file))
        except DataError:  # reported later with the other reasons
            continue
    return wrong_board(greys, board)


def usable_views(found: Sequence[BoardImage]) -> UsableViews:
    """Views in the most common image size; the others are excluded with reasons.

    Raises:
        ComputeError: the board is in no image.
    """
    sizes = Counter(image.size for image in found if image.view is not None)
    if not sizes:
        reasons = Counter(image.reason for image in found)
        raise ComputeError(
            f"the board was found in none of {len(found)} images: "
            + "; ".join(f"{reason} ({count})" for reason, count in reasons.most_common(3)),
            remedy="Check the board's pattern, its inner corners, light and focus",
        )
    size = sizes.most_common(1)[0][0]
    indices: list[int] = []
    views: list[BoardView] = []
    excluded: dict[int, str] = {}
    for index, image in enumerate(found):
        if image.view is None:
            excluded[index] = image.reason
        elif image.size != size:
            excluded[index] = f"{image.size[0]} × {image.size[1]} px, the other images {size[0]} × {size[1]}"
        else:
            indices.append(index)
            views.append(image.view)
    return UsableViews(size, tuple(indices), tuple(views), excluded)


def _worth_processes(files: Sequence[Path]) -> bool:
    """Whether the work outweighs the start of processes."""
    return len(files) >= _MANY_FILES or sum(file.stat().st_size for file in files if file.is_file()) > _MANY_BYTES


def _find(file: Path, board: Board) -> BoardImage:
    cv2.setNumThreads(1)  # the processes already use every core
    try:
        grey = read_grey(file)
    except DataError as error:
        return BoardImage((0, 0), None, error.what)
    size = (grey.shape[1], grey.shape[0])
    try:
        return BoardImage(size, find_board(grey, board))
    except ComputeError as error:
        # A ChArUco board needs only a part in view, and trying its markers takes seconds.
        why = diagnose(grey, board) if board.pattern == "checkerboard" else None
        return BoardImage(size, None, error.what if why is None else why.words)
