"""Finds a board in many image files at once, also where only a part shows; where there is none, says why."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.calibration.board import Board, BoardView, Grey, find_board, half_window, refine_corners
from service.compute.calibration.board_knowledge import BoardKnowledge
from service.compute.calibration.intrinsics_adjustment import fit_pose, pose_matrix, start_pose
from service.compute.images.photographs import read_grey
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, apply, inverse
from service.core.units import mm
from service.machine.executors import IN_THIS_PROCESS, mapping, report_each

_WIDTH = 1200  # px, of the reduced copies
_CHARUCO_WIDTH = 1600
_LEAST = 3  # corners per side for a grid to count as a board
_FEWEST_MARKERS = 4
_BORDER = 1.6  # corner spacings between the last visible corner and the frame: the next one would be outside
_FEWEST_CORNERS = 8
_FEWEST_CIRCLES = 12
_ROUND = 0.85  # circularity of a dark spot that is no square: a square has 0.79, a circle at 45° 0.9
_MARKER_OFF = 0.05  # relative error of a marker's side that is reported
_DICTIONARIES = tuple(
    sorted(
        (name for name in dir(cv2.aruco) if name.startswith("DICT_") and "APRILTAG" not in name),
        key=lambda name: (name.rsplit("_", 1)[0], len(name), name),
    )
)


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """A reason why an image does not show the described board.

    Attributes:
        words: the text for people, without a full stop.
        remedy: the advice to the user.
        of_board: true if the description is wrong, and so fails for every image; otherwise only this image is at
            fault.
    """

    words: str
    remedy: str
    of_board: bool


def diagnose(image: Grey, board: Board) -> Diagnosis | None:
    """Return why `find_board` may have found nothing; None if none of the usual mistakes explains it.

    Takes a fraction of a second for a checkerboard and some seconds for a ChArUco board.
    """
    if board.pattern == "checkerboard":
        return _checkerboard(image, board)
    return _charuco(image, board) if board.pattern == "charuco" else _circles(image, board)


def wrong_board(images: Sequence[Grey], board: Board) -> Diagnosis | None:
    """Find the mistake in the board's description that explains two images; None if any image shows the board.

    A single image may just show a partly covered board, so one is enough only if there is no other.
    """
    said: list[Diagnosis] = []
    for image in images:
        if _is_seen(image, board):
            return _wrong_markers(images, board) if board.pattern == "charuco" else None
        found = diagnose(image, board)
        if found is not None and found.of_board:
            if found in said or len(images) == 1:
                return found
            said.append(found)
    return None


def _is_seen(image: Grey, board: Board) -> bool:
    if board.pattern == "checkerboard":
        seen = _find_grid(_small(image, _WIDTH))
        return seen is not None and sorted(seen[0]) == sorted((board.columns, board.rows))
    if board.pattern == "charuco":
        return _corners(_small(image, _CHARUCO_WIDTH), board) >= _FEWEST_CORNERS
    size = (board.columns, board.rows)
    return cv2.findCirclesGrid(_small(image, _WIDTH), size, flags=cv2.CALIB_CB_ASYMMETRIC_GRID)[0]


def _small(image: Grey, width: int) -> Grey:
    factor = width / max(image.shape)
    if factor >= 1:
        return image
    size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


# --- checkerboard -----------------------------------------------------------------------------------------


def _find_grid(image: Grey) -> tuple[tuple[int, int], Array] | None:
    """Return the columns and rows of the largest corner grid in the image, and the corners (rows, columns, 2)."""
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(image, (_LEAST, _LEAST), flags)
    if not found:
        return None
    rows, columns = meta.shape[:2]
    return (columns, rows), np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2)


def _checkerboard(image: Grey, board: Board) -> Diagnosis | None:
    small = _small(image, _WIDTH)
    seen = _find_grid(small)
    wanted, given = sorted((board.columns, board.rows)), f"{board.columns} × {board.rows}"
    if (seen is None or sorted(seen[0]) == [_LEAST, _LEAST]) and _circles_in(small) >= _FEWEST_CIRCLES:
        return Diagnosis(
            "the image shows circles, not squares",
            "Give --pattern circles, the circles of one row and the rows (an asymmetric grid; symmetric ones are "
            "not read)",
            True,
        )
    if seen is None:
        if _best_dictionary(_small(image, _CHARUCO_WIDTH))[1] >= _FEWEST_MARKERS:
            return Diagnosis(
                "there are markers in the squares: it is a ChArUco board", "Give --pattern charuco", True
            )
        return None
    (columns, rows), corners = seen
    found = sorted((columns, rows))
    if found == wanted:
        return None  # the board is there; find_board's own reason holds
    if _at_frame(corners, small.shape) and all(a <= b for a, b in zip(found, wanted, strict=True)):
        return Diagnosis(
            f"the board is cropped by the image's edge: {columns} × {rows} of its {given} inner corners are seen",
            "The whole board must be in the image",
            False,
        )
    # Report the counts in the order in which the description gives them.
    first, second = found if board.columns <= board.rows else found[::-1]
    words = f"the board has {first} × {second} inner corners, not {given}"
    if found == [wanted[0] - 1, wanted[1] - 1]:
        words += ", which counts its squares"
    return Diagnosis(words, f"Inner corners are where four squares meet: give {first}x{second}", True)


def _at_frame(corners: Array, shape: tuple[int, ...]) -> bool:
    """Return whether the next row or column of corners would lie outside the image."""
    spacing = max(
        float(np.median(np.linalg.norm(np.diff(corners, axis=0), axis=2))),
        float(np.median(np.linalg.norm(np.diff(corners, axis=1), axis=2))),
    )
    flat = corners.reshape(-1, 2)
    gap = min(float(flat.min()), float((np.array(shape[1::-1]) - flat).min()))
    return gap < _BORDER * spacing


# --- ChArUco ----------------------------------------------------------------------------------------------


def _charuco(image: Grey, board: Board) -> Diagnosis | None:
    small = _small(image, _CHARUCO_WIDTH)
    name, best = _best_dictionary(small)
    own = _markers(small, board.dictionary)
    if best >= _FEWEST_MARKERS and best > 2 * own:
        return Diagnosis(
            f"the markers are of {name}, not of {board.dictionary}",
            f"Give --dictionary {name}",
            True,
        )
    if own < _FEWEST_MARKERS:
        seen = _find_grid(_small(image, _WIDTH))
        if seen is not None and min(seen[0]) > _LEAST:
            return Diagnosis("the image shows a board without markers", "Give --pattern checkerboard", True)
        return None
    now = _corners(small, board)
    for other, words, remedy in _variants(board):
        if _corners(small, other) >= max(_FEWEST_CORNERS, 2 * now):
            return Diagnosis(words, remedy, True)
    return None


def _variants(board: Board) -> list[tuple[Board, str, str]]:
    """Return boards that are often confused, each with the text of the mistake and the option that corrects it."""
    c, r = board.columns, board.rows
    counts = (
        ((c, r), ""),
        ((r, c), "columns and rows are swapped"),
        ((c - 1, r - 1), "squares were counted, not inner corners"),
        ((r - 1, c - 1), "squares were counted, and columns and rows are swapped"),
    )
    out: list[tuple[Board, str, str]] = []
    for (columns, rows), words in counts:
        for legacy in (board.legacy, not board.legacy):
            if min(columns, rows) < _LEAST or ((columns, rows) == (c, r) and legacy == board.legacy):
                continue
            other = dataclasses.replace(board, columns=columns, rows=rows, legacy=legacy)
            printed = "" if legacy == board.legacy else _LEGACY_WORDS[legacy]
            give = "" if (columns, rows) == (c, r) else f"--board {columns}x{rows}"
            switch = "" if legacy == board.legacy else "--legacy" if legacy else "no --legacy"
            out.append(
                (
                    other,
                    ", and ".join(part for part in (words, printed) if part),
                    "Give " + " and ".join(part for part in (give, switch) if part),
                )
            )
    return out


def _wrong_markers(images: Sequence[Grey], board: Board) -> Diagnosis | None:
    """Return the true side of a ChArUco board's markers if another one is described."""
    ratios = [ratio for image in images for ratio in _marker_ratios(_small(image, _CHARUCO_WIDTH), board)]
    if not ratios or abs(float(np.median(ratios)) - 1) < _MARKER_OFF:
        return None
    given = mm(board.charuco().getMarkerLength())
    found = float(np.median(ratios)) * given
    return Diagnosis(
        f"the markers have sides of {found:.1f} mm, not {given:.1f} mm, in squares of {mm(board.square_m):g} mm",
        f"Measure a marker and give --marker-mm {found:.1f}",
        True,
    )


def _marker_ratios(image: Grey, board: Board) -> Array:
    """Return the ratio of true to described side of each marker in an image whose place on the board is known."""
    described = board.charuco()
    corners, identifiers, _ = _marker_detector(board.dictionary).detectMarkers(image)
    if identifiers is None or len(identifiers) < _FEWEST_MARKERS:  # pyright: ignore[reportUnnecessaryComparison]
        return np.zeros(0)
    places = dict(zip(np.asarray(described.getIds()).ravel().tolist(), described.getObjPoints(), strict=True))
    known = [(np.asarray(c, dtype=np.float64).reshape(4, 2), places[i]) for c, i in
             zip(corners, np.asarray(identifiers).ravel().tolist(), strict=True) if i in places]  # fmt: skip
    if len(known) < _FEWEST_MARKERS:
        return np.zeros(0)
    seen, at = np.array([c for c, _ in known]), np.array([np.asarray(p)[:, :2] for _, p in known])
    H, inlier = cv2.findHomography(seen.mean(axis=1), at.mean(axis=1), cv2.RANSAC, 0.1 * board.square_m)
    if H is None:  # pyright: ignore[reportUnnecessaryComparison]
        return np.zeros(0)
    flat = cv2.perspectiveTransform(seen[inlier.ravel() > 0].reshape(1, -1, 2), H).reshape(-1, 4, 2)
    sides = np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=2).mean(axis=1)
    return np.asarray(sides, dtype=np.float64) / described.getMarkerLength()


def _marker_detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)), parameters)


_LEGACY_WORDS = {
    True: "it is printed as OpenCV did before version 4.6",
    False: "it is printed as OpenCV does since version 4.6",
}


def _corners(image: Grey, board: Board) -> int:
    """Return the number of corners that lie on one plane in this board's arrangement."""
    try:
        found, identifiers, _, _ = cv2.aruco.CharucoDetector(board.charuco()).detectBoard(image)
    except cv2.error:
        return 0
    if identifiers is None or len(identifiers) < 4:  # pyright: ignore[reportUnnecessaryComparison]
        return 0
    points = board.points()[np.asarray(identifiers, dtype=np.int64).ravel(), :2]
    pixels = np.asarray(found, dtype=np.float64).reshape(-1, 2)
    _, inlier = cv2.findHomography(points, pixels, cv2.RANSAC, 3.0)
    return 0 if inlier is None else int(np.count_nonzero(inlier))  # pyright: ignore[reportUnnecessaryComparison]


def _markers(image: Grey, dictionary: str) -> int:
    identifier = getattr(cv2.aruco, dictionary, None)
    if not isinstance(identifier, int):
        return 0
    found = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(identifier)).detectMarkers(image)[1]
    return 0 if found is None else len(np.unique(found))  # pyright: ignore[reportUnnecessaryComparison]


def _best_dictionary(image: Grey) -> tuple[str, int]:
    """Return the dictionary with the most markers in the image (the smallest one in a tie), and their number."""
    # Quadrilaterals are searched for once, and compared with all dictionaries.
    _, identifiers, _, dictionary = _detector_of_all().detectMarkersMultiDict(image)
    best = ("", 0)
    if identifiers is None:  # pyright: ignore[reportUnnecessaryComparison]
        return best
    for k, name in enumerate(_DICTIONARIES):
        if (count := len(np.unique(np.asarray(identifiers)[np.asarray(dictionary) == k]))) > best[1]:
            best = (name, count)
    return best


@cache
def _detector_of_all() -> cv2.aruco.ArucoDetector:
    """Return a detector that knows all dictionaries, in their order."""
    known = [cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)) for name in _DICTIONARIES]
    return cv2.aruco.ArucoDetector(known, cv2.aruco.DetectorParameters(), cv2.aruco.RefineParameters())


# --- circles ----------------------------------------------------------------------------------------------


def _circles_in(image: Grey) -> int:
    """Return the number of dark round spots."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.minArea, settings.maxArea = 20, image.size / 100
    settings.filterByCircularity, settings.minCircularity = True, _ROUND
    settings.minDistBetweenBlobs = 4
    return len(cv2.SimpleBlobDetector.create(settings).detect(image))


def _circles(image: Grey, board: Board) -> Diagnosis | None:
    small = _small(image, _WIDTH)
    if cv2.findCirclesGrid(small, (board.rows, board.columns), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)[0]:
        return Diagnosis(
            "columns and rows are swapped",
            f"Give --board {board.rows}x{board.columns}: the circles of one row, then the rows",
            True,
        )
    for size in ((board.columns, board.rows), (board.rows, board.columns)):
        if cv2.findCirclesGrid(small, size, flags=cv2.CALIB_CB_SYMMETRIC_GRID)[0]:
            return Diagnosis(
                "the circles lie in a symmetric grid", "Print an asymmetric one; symmetric ones are not read", True
            )
    seen = _find_grid(small)
    if seen is not None and min(seen[0]) > _LEAST and _circles_in(small) < _FEWEST_CIRCLES:
        return Diagnosis("the image shows squares, not circles", "Give --pattern checkerboard", True)
    return None


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
