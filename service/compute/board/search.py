"""Finds a board in many image files at once, with a reason for each failure, also where only a part shows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.board.board import Board, BoardView, Grey, find_board, half_window, refine_corners
from service.compute.board.diagnosis import Diagnosis, diagnose, wrong_board
from service.compute.board.knowledge import BoardKnowledge
from service.compute.images.photographs import read_grey
from service.compute.intrinsics.adjustment import fit_pose, pose_matrix, start_pose
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, apply, inverse
from service.machine.executors import IN_THIS_PROCESS, mapping, report_each

_MANY_FILES = 24
_MANY_BYTES = 30e6
_PROBED = 4  # images tried before all are searched


@dataclass(frozen=True, slots=True)
class BoardImage:
    """The content of one image file; if it cannot be used, `view` is None and `reason` says why."""

    size: tuple[int, int]
    view: BoardView | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class UsableViews:
    """The views with one common image size, and the reasons for all others.

    Attributes:
        size: common width and height, px.
        indices: (N) indices of the images.
        views: (N) the views.
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
    with mapping(workers if _worth_processes(files) else IN_THIS_PROCESS, len(files)) as map_over:
        return tuple(report_each(map_over(work, files), len(files), progress))


def probe_board(files: Sequence[Path], board: Board) -> Diagnosis | None:
    """Look for a mistake in the board's description in a few images; None if it is found or nothing explains it."""
    some = [files[k] for k in sorted({round(k * (len(files) - 1) / (_PROBED - 1)) for k in range(_PROBED)})]
    greys: list[Grey] = []
    for file in some:
        try:
            greys.append(read_grey(file))
        except DataError:  # reported later with the other reasons
            continue
    return wrong_board(greys, board)


def usable_views(found: Sequence[BoardImage]) -> UsableViews:
    """Return the views in the most common image size; the others are excluded with reasons.

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
    """Return whether the work outweighs the start of processes."""
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


# Finds a partly visible checkerboard: its corners are searched where the arm's pose predicts them.
#
# The corners of a cropped or partly covered checkerboard cannot be numbered by counting. If camera, mount and board
# are known well enough to predict each corner to a fraction of a square, counting is not needed.


_FEWEST = 24  # corners
_FEWEST_LINES = 3  # rows, and columns
_NEAR = 0.25  # of a square: largest accepted shift of the board; from half a square on, corners are confused
_DOUBT, _DRAWS = 0.5, 32
_CONTRAST = 0.25  # least contrast of dark and bright squares at a corner, over that of the whole board
_OUTLIER = 4.0  # times the median distance from the fit
_OUTLIER_FLOOR_PX = 0.3


def find_part(image: Grey, board: Board, known: BoardKnowledge, T_base_camera: Transform) -> BoardView:
    """Find the visible corners of a checkerboard, numbered by their predicted positions.

    Each is refined from its predicted position. It is accepted only if it is a crossing of four squares of the right
    colours and fits one board pose together with the others. All of them may be shifted by up to a quarter of a
    square.

    Args:
        image: grey, 8 bits.
        board: a checkerboard.
        known: camera, mount and board as other images show them.
        T_base_camera: (4, 4) the camera's pose for this image, from the arm's pose and the mount.

    Raises:
        ComputeError: too little of the board is visible, or it is not where it was predicted.
    """
    T_camera_board = inverse(T_base_camera) @ known.T_base_board
    points = apply(T_camera_board, board.points())
    if not (points[:, 2] > 0).all():
        raise ComputeError("the board lies behind the camera")
    expected = known.camera.project(points)
    grid = expected.reshape(board.rows, board.columns, 2)
    spacing = float(np.median(np.linalg.norm(np.diff(grid, axis=1), axis=2)))
    if _doubt_px(board, known, T_base_camera) > _DOUBT * spacing:
        raise ComputeError("camera, mount and board are not known to half a square yet")
    half = half_window(spacing, board.reach())
    inside = ((expected > half + 1) & (expected < np.array(image.shape[::-1]) - 2 - half)).all(axis=1)
    which = np.flatnonzero(inside)
    if len(which) < _FEWEST:
        raise _too_little(len(which))
    found, good = refine_corners(image, expected[which], half)
    good &= _crossings(image, grid, which, found, dark_first=(board.columns + board.rows) % 2 == 1)
    which, found = which[good], found[good]
    if len(which) < _FEWEST:
        raise _too_little(len(which))
    shift = np.linalg.norm(np.median(found - expected[which], axis=0))
    if shift > _NEAR * spacing:
        raise ComputeError(
            f"the board is {shift / spacing:.2f} squares from its predicted place, so its corners cannot be numbered"
        )
    view = _one_plane(BoardView(which, found), board, known)
    rows, columns = np.divmod(view.indices, board.columns)
    if len(view.indices) < _FEWEST or min(len(set(rows)), len(set(columns))) < _FEWEST_LINES:
        raise _too_little(len(view.indices))
    return view


def with_parts(
    images: Sequence[BoardImage],
    greys: Sequence[Grey | None],
    board: Board,
    known: BoardKnowledge,
    T_base_flange: Array,
) -> tuple[BoardImage, ...]:
    """Search images without a whole board for parts of it; where that fails, the reason says why.

    Args:
        images: (N) results of `find_boards`.
        greys: (N) pixels of the images without a view; None for the others.
        board: a checkerboard.
        known: camera, mount and board as the images with a view show them.
        T_base_flange: (N, 4, 4) poses of the flange.
    """
    out: list[BoardImage] = []
    for image, grey, flange in zip(images, greys, T_base_flange, strict=True):
        if image.view is not None or grey is None or image.size != (known.camera.width, known.camera.height):
            out.append(image)
            continue
        try:
            view = find_part(grey, board, known, flange @ known.T_flange_camera)
            out.append(replace(image, view=view, reason=""))
        except ComputeError as error:
            out.append(replace(image, reason=f"{image.reason}; in part: {error.what}"))
    return tuple(out)


def _too_little(count: int) -> ComputeError:
    return ComputeError(f"only {count} corners of the board can be seen", remedy="More of the board must be visible")


def _doubt_px(board: Board, known: BoardKnowledge, T_base_camera: Transform) -> float:
    """Return the largest possible distance of the corners from their predicted positions, px, from random draws."""
    hands, boards, _, _ = known.draws(_DRAWS)
    flange = T_base_camera @ inverse(known.T_flange_camera)
    ends = board.points()[[0, board.columns - 1, -board.columns, -1]]
    expected = known.camera.project(apply(inverse(T_base_camera) @ known.T_base_board, ends))
    off = [
        np.linalg.norm(known.camera.project(apply(inverse(flange @ X) @ B, ends)) - expected, axis=1).mean()
        for X, B in zip(hands, boards, strict=True)
    ]
    return float(np.max(off))


def _crossings(
    image: Grey, grid: Array, which: NDArray[np.int64], found: Array, *, dark_first: bool
) -> NDArray[np.bool_]:
    """Return (M,) whether two dark and two bright squares meet at each corner, as on the board.

    With `dark_first`, the board's first square is dark (the order in which `find_board` numbers it), so a grid that
    is off by one square has the wrong colours.
    """
    columns = grid.shape[1]
    step_x, step_y = np.gradient(grid, axis=1).reshape(-1, 2)[which], np.gradient(grid, axis=0).reshape(-1, 2)[which]

    def at(x: float, y: float) -> Array:
        places = (found + x * step_x + y * step_y).round().astype(int)
        u, v = np.clip(places, 0, np.array(image.shape[::-1]) - 1).T
        return image[v, u].astype(np.float64)

    first, second = (at(-0.3, -0.3), at(0.3, 0.3)), (at(-0.3, 0.3), at(0.3, -0.3))
    difference = (first[0] + first[1] - second[0] - second[1]) / 2
    difference = difference * np.where((which // columns + which % columns) % 2, -1, 1)
    usual = float(np.median(difference))
    if dark_first and usual > 0:
        return np.zeros(len(which), dtype=np.bool_)
    alike = np.maximum(np.abs(first[0] - first[1]), np.abs(second[0] - second[1])) < np.abs(difference)
    return (difference * np.sign(usual) > _CONTRAST * abs(usual)) & alike & (abs(usual) > 8)


def _one_plane(view: BoardView, board: Board, known: BoardKnowledge) -> BoardView:
    """Return the view without corners that do not fit one common board pose."""
    points = board.points()
    for _ in range(3):
        pose, _ = fit_pose(view, points, known.camera, start_pose(view, points, known.camera))
        off = np.linalg.norm(_reprojected(view, points, known, pose) - view.corners, axis=1)
        good = off < max(_OUTLIER * float(np.median(off)), _OUTLIER_FLOOR_PX)
        if good.all() or good.sum() < _FEWEST:
            break
        view = BoardView(view.indices[good], view.corners[good])
    return view


def _reprojected(view: BoardView, points: Array, known: BoardKnowledge, pose: Array) -> Array:
    return known.camera.project(apply(pose_matrix(pose), points[view.indices]))
