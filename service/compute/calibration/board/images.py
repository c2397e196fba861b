"""The board in many image files at once: who shows it, who does not and why, in parallel processes."""

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

_MANY_FILES = 24
_MANY_BYTES = 30e6
_PROBED = 4  # images, before all are searched


@dataclass(frozen=True, slots=True)
class BoardImage:
    """What one image file shows: `view` is None, and `reason` says why, where it cannot be used."""

    size: tuple[int, int]
    view: BoardView | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class UsableViews:
    """The views that belong together, and every other image with its reason.

    Attributes:
        size: width and height of all of them, px.
        indices: (N) of the images.
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
    """Read every image file and measure the board in it. A file that cannot be read is a reason, not an error.

    Args:
        files: images.
        board: what to look for.
        workers: processes, at most.
        progress: called with images done and in all.

    Raises:
        DataError: a board that cannot be (a ChArUco dictionary too small, say).
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
    with ProcessPoolExecutor(min(workers, len(files)), mp_context=get_context("spawn")) as pool:
        for image in pool.map(work, files):
            found.append(image)
            if progress:
                progress(len(found), len(files))
    return tuple(found)


def probe_board(files: Sequence[Path], board: Board) -> Diagnosis | None:
    """What is wrong with the board's description, by a few of the images; None where it is seen, or nobody knows."""
    some = [files[k] for k in sorted({round(k * (len(files) - 1) / (_PROBED - 1)) for k in range(_PROBED)})]
    greys: list[Grey] = []
    for file in some:
        try:
            greys.append(read_grey(file))
        except DataError:  # told with the other reasons
            continue
    return wrong_board(greys, board)


def usable_views(found: Sequence[BoardImage]) -> UsableViews:
    """Views of the size that most images have; the others are excluded with their reasons.

    Raises:
        ComputeError: no image shows the board.
    """
    sizes = Counter(image.size for image in found if image.view is not None)
    if not sizes:
        reasons = Counter(image.reason for image in found)
        raise ComputeError(
            f"the board is seen in none of {len(found)} images: "
            + "; ".join(f"{reason} ({count})" for reason, count in reasons.most_common(3)),
            remedy="check the board's pattern, its inner corners, light and focus",
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
    """Whether there is more to do than to start processes."""
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
        # Of a ChArUco board a part is enough, and trying its markers takes seconds.
        why = diagnose(grey, board) if board.pattern == "checkerboard" else None
        return BoardImage(size, None, error.what if why is None else why.words)
