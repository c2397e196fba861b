"""Describes calibration boards and finds their points in an image: checkerboard, ChArUco, asymmetric circle grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, transform
from service.core.units import mm

Pattern = Literal["checkerboard", "charuco", "circles"]
Grey = NDArray[np.uint8]

_SEARCH_WIDTHS = (1200, 2400)  # px; the board is searched for at these sizes, then measured at full size
_CHARUCO_WIDTHS = (1600, 3200)  # larger, because markers are smaller than squares
_REACH = 0.4  # of the shortest distance between corners: the window must not include the next corner's edges
_MAX_HALF = 30  # px; a larger window gains nothing, and lens distortion bends the edges in it
_SMOOTHING = 0.15  # sigma of the smoothing, in half windows
_MAX_SMOOTHING_PX = 1.5
_MIN_CHARUCO_CORNERS = 8
#: Largest relative error of a board's size if none is given: 0.1 mm in 200 mm, as of boards made for measuring.
SIZE_TOLERANCE = 5e-4
#: Largest bow of a board if none is given: composite plates and glued prints have 0.05 to 0.2 mm.
FLATNESS_M = 2e-4


@dataclass(frozen=True, slots=True)
class Board:
    """A flat board of columns × rows points.

    Attributes:
        columns: number of inner corners (where four squares meet) in a row of a checkerboard or ChArUco board, one
            less than its squares; number of circles in a row of an asymmetric grid.
        rows: number of rows of inner corners or circles.
        square_m: side of a square; for an asymmetric circle grid the distance between two rows, which is half the
            distance between two circles of a row (OpenCV's convention).
        pattern: kind of board.
        marker_m: side of a ChArUco board's markers; None: three quarters of a square.
        dictionary: OpenCV's name for the dictionary of a ChArUco board's markers.
        legacy: a ChArUco board as OpenCV printed it before 4.6 (differs if the number of squares in a column is
            even).
        size_tolerance: largest relative error of `square_m`, as given by the maker.
        flatness_m: largest bow of the board, as given by the maker; 0: exactly flat.
        bow_m: how far the board's middle lies behind its sides, and behind its ends, in metres: the rise of an arc
            along the columns and of one along the rows; negative if the middle comes towards the camera.
    """

    columns: int
    rows: int
    square_m: float
    pattern: Pattern = "checkerboard"
    marker_m: float | None = None
    dictionary: str = "DICT_5X5_1000"
    legacy: bool = False
    size_tolerance: float = SIZE_TOLERANCE
    flatness_m: float = FLATNESS_M
    bow_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not 0 < self.square_m < 10:
            raise DataError(
                f"a board of {self.columns} × {self.rows} points {mm(self.square_m):g} mm apart cannot be used",
                remedy="Give its inner corners (3 × 3 at least) and the side of a square",
            )
        if self.pattern == "charuco" and not 0 < self._marker_m() < self.square_m:
            raise DataError("a ChArUco marker is smaller than its square", remedy="Give the marker's side")

    def points(self) -> Array:
        """Return (columns · rows, 3) in the board frame, metres, row by row: x along the columns, y along the rows.

        They lie in the plane z = 0 if the board is not bent.
        """
        flat = self._flat()
        if any(self.bow_m):
            flat[:, 2] = self.bends() @ self.bow_m
        return flat

    def bends(self) -> Array:
        """Return (columns · rows, 2) displacement along z of each point by a bow of 1 along x, and along y."""
        flat = self._flat()[:, :2]
        half = np.ptp(flat, axis=0) / 2
        return 1 - ((flat - flat.min(axis=0)) / half - 1) ** 2

    def _flat(self) -> Array:
        if self.pattern != "circles":
            return board_points(self.columns, self.rows, self.square_m)
        row, column = np.mgrid[: self.rows, : self.columns]
        x = (2 * column + row % 2).ravel() * self.square_m
        return np.stack([x, row.ravel() * self.square_m, np.zeros(x.size)], axis=1)

    def half_turn(self) -> Transform | None:
        """Return T_board_turned if the board looks the same after half a turn; None if its ends are distinct."""
        if self.pattern == "charuco" or (self.pattern == "circles" and self.rows % 2):
            return None
        if self.pattern == "circles":
            return transform(Rotation.from_euler("z", np.pi), self.points().max(axis=0))
        return half_turn(self.columns, self.rows, self.square_m)

    def _marker_m(self) -> float:
        return 0.75 * self.square_m if self.marker_m is None else self.marker_m

    def charuco(self) -> cv2.aruco.CharucoBoard:
        """Return the board as an OpenCV object.

        Raises:
            DataError: the dictionary is unknown or has too few markers.
        """
        identifier = getattr(cv2.aruco, self.dictionary, None)
        if not self.dictionary.startswith("DICT_") or not isinstance(identifier, int):
            raise DataError(
                f"{self.dictionary} is not a marker dictionary of OpenCV", remedy="Name one, such as DICT_5X5_1000"
            )
        dictionary = cv2.aruco.getPredefinedDictionary(identifier)
        if len(dictionary.bytesList) < (self.columns + 1) * (self.rows + 1) // 2:
            raise DataError(
                f"{self.dictionary} has {len(dictionary.bytesList)} markers, fewer than this board",
                remedy="Name the dictionary that the board was printed with",
            )
        size = (self.columns + 1, self.rows + 1)
        board = cv2.aruco.CharucoBoard(size, self.square_m, self._marker_m(), dictionary)
        board.setLegacyPattern(self.legacy)
        return board

    def reach(self) -> float:
        """Return the radius around a corner, in squares, within which only this corner's own edges are printed."""
        if self.pattern == "charuco":
            return min(_REACH, 0.9 * (1 - self._marker_m() / self.square_m) / 2)
        return _REACH


@dataclass(frozen=True, slots=True)
class BoardView:
    """The points of a board found in one image.

    Attributes:
        indices: (M,) into `Board.points()`.
        corners: (M, 2) pixels.
    """

    indices: NDArray[np.int64]
    corners: Array


def board_points(columns: int, rows: int, square_m: float) -> Array:
    """Return (columns · rows, 3) inner corners in the board frame, row by row, in the unit of `square_m`."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x.ravel() * square_m, y.ravel() * square_m, np.zeros(x.size)], axis=1)


def half_turn(columns: int, rows: int, square_m: float) -> Transform | None:
    """Return T_board_turned of a checkerboard that half a turn leaves alike; None if colours distinguish its ends.

    With one even and one odd number of inner corners, opposite corners have opposite colours.
    """
    if (columns + rows) % 2:
        return None
    centre = np.array([(columns - 1) * square_m, (rows - 1) * square_m, 0.0])
    return transform(Rotation.from_euler("z", np.pi), centre)


def find_board(image_grey: Grey, board: Board) -> BoardView:
    """Find the board's points in an image and measure them at full size.

    A checkerboard or circle grid must be fully visible; a ChArUco board may be cropped or partly covered.

    Raises:
        DataError: the image is not grey with 8 bits, or the board's description is invalid.
        ComputeError: the board was not found.
    """
    _check(image_grey)
    if board.pattern == "checkerboard":
        corners, good = _find_checkerboard(image_grey, board.columns, board.rows)
        return BoardView(np.flatnonzero(good), corners[good])
    return _find_charuco(image_grey, board) if board.pattern == "charuco" else _find_circles(image_grey, board)


def _find_checkerboard(image: Grey, columns: int, rows: int) -> tuple[Array, NDArray[np.bool_]]:
    """Find all corners of a checkerboard, and which of them can be trusted.

    A board with one even and one odd corner count is always numbered from the same physical corner, the one that
    makes the square between the first corners of the first two rows dark.
    """
    found = _search_checkerboard(image, columns, rows)
    corners, good = refine_corners(image, found, half_window(_grid_spacing(found.reshape(rows, columns, 2)), _REACH))
    if np.count_nonzero(good) < 0.8 * len(good):
        raise ComputeError("corners of the board drifted while they were refined", remedy="Take a sharper image")
    if (columns + rows) % 2 and not _first_square_is_dark(image, corners.reshape(rows, columns, 2)):
        return corners[::-1].copy(), good[::-1].copy()
    return corners, good


def _check(image: Grey) -> None:
    if image.ndim != 2 or image.dtype != np.uint8:
        raise DataError(f"the board is searched for in grey 8-bit images, not {image.shape} {image.dtype}")


def _reduced(image: Grey, target: int) -> tuple[Grey, Array]:
    """Return a copy whose longer side is at most `target` px, and the factors (2,) from its pixels to the image's."""
    height, width = image.shape
    factor = min(1.0, target / max(width, height))
    if factor == 1.0:
        return image, np.ones(2)
    size = (round(width * factor), round(height * factor))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return small, np.array([width / size[0], height / size[1]])


def _search_checkerboard(image: Grey, columns: int, rows: int) -> Array:
    tried: list[tuple[int, int]] = []
    near, far = _SEARCH_WIDTHS
    stretched = cv2.CALIB_CB_NORMALIZE_IMAGE
    # First reduced; then unstretched, for dark rooms, where stretching turns noise into texture; then larger, for
    # small boards; then with local contrast, for shadows and glare.
    attempts = ((near, stretched, False), (near, 0, False), (far, stretched, False), (near, stretched, True))
    for target, flags, even in attempts:
        small, scale = _reduced(image, target)
        if (small.shape[1], flags) in tried and not even:
            continue
        tried.append((small.shape[1], flags))
        if even:
            small = np.asarray(cv2.createCLAHE(4.0, (8, 8)).apply(cv2.GaussianBlur(small, (0, 0), 1.0)), np.uint8)
        found, corners = cv2.findChessboardCornersSB(small, (columns, rows), flags=flags)
        if found:
            return (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) * scale - 0.5
    raise ComputeError(
        f"no board of {columns} × {rows} inner corners in the image",
        remedy="The whole board must be visible, sharp and evenly lit; check columns and rows (inner corners)",
    )


def _grid_spacing(grid: Array) -> float:
    """Return the shortest distance between neighbours of a (rows, columns, 2) grid, px."""
    return min(
        float(np.linalg.norm(np.diff(grid, axis=0), axis=2).min()),
        float(np.linalg.norm(np.diff(grid, axis=1), axis=2).min()),
    )


def refine_corners(image: Grey, found: Array, half: int) -> tuple[Array, NDArray[np.bool_]]:
    """Refine corners (N, 2); return also which stayed near their start with their whole window in the image.

    A corner is the point whose directions to all pixels of the window are normal to the gradients there. Four squares
    meet with point symmetry, so neither gamma nor blur moves this point. Smoothing first halves the error:
    differences of neighbouring pixels amplify noise, and a sharp lens is undersampled.
    Source: Förstner and Gülch 1987, as in OpenCV's cornerSubPix; the smoothing: bench/calibration/corner_accuracy.py.
    """
    sigma = float(np.clip(_SMOOTHING * half, 0.5, _MAX_SMOOTHING_PX))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    margin = 2 * half + 6  # the window may move by half its size
    corners = np.empty_like(found)
    for k, (x, y) in enumerate(found.round().astype(int)):
        left, top = max(x - margin, 0), max(y - margin, 0)
        patch = image[top : y + margin + 1, left : x + margin + 1].astype(np.float32)
        patch = cv2.GaussianBlur(patch, (0, 0), sigma)
        start = (found[k] - [left, top]).astype(np.float32).reshape(1, 1, 2)
        refined = cv2.cornerSubPix(patch, start, (half, half), (-1, -1), criteria)
        corners[k] = np.asarray(refined, dtype=np.float64).reshape(2) + np.array([left, top])
    border = np.array(image.shape[::-1]) - 1 - half
    whole = ((corners >= half) & (corners <= border)).all(axis=1)
    near = np.linalg.norm(corners - found, axis=1) <= half
    return corners, whole & near


def half_window(spacing_px: float, reach: float) -> int:
    """Return half the side of the window in which a corner is refined, px; `reach` is `Board.reach`."""
    return int(np.clip(reach * spacing_px, 2, _MAX_HALF))


def _first_square_is_dark(image: Grey, grid: Array) -> bool:
    """Return whether the first square is dark, by the mean brightness at the centres of both colours' squares."""
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    x = np.clip(centres[..., 0].round().astype(int), 0, image.shape[1] - 1)
    y = np.clip(centres[..., 1].round().astype(int), 0, image.shape[0] - 1)
    value = image[y, x].astype(np.float64)
    row, column = np.indices(value.shape)
    even = (row + column) % 2 == 0
    return bool(value[even].mean() < value[~even].mean())


def _find_charuco(image: Grey, board: Board) -> BoardView:
    """Identify corners by their markers in a reduced copy, then refine them at full size."""
    for target in _CHARUCO_WIDTHS:
        small, scale = _reduced(image, target)
        found, identifiers, _, _ = cv2.aruco.CharucoDetector(board.charuco()).detectBoard(small)
        # OpenCV's annotation says that it is never None, but it is when no marker is found.
        if identifiers is not None and len(identifiers) >= _MIN_CHARUCO_CORNERS:  # pyright: ignore[reportUnnecessaryComparison]
            indices = np.asarray(identifiers, dtype=np.int64).ravel()
            corners = (np.asarray(found, dtype=np.float64).reshape(-1, 2) + 0.5) * scale - 0.5
            return _charuco_view(image, board, indices, corners)
        if small is image:
            break
    raise ComputeError(
        f"fewer than {_MIN_CHARUCO_CORNERS} corners of the ChArUco board in the image",
        remedy="Check columns and rows (inner corners), dictionary, sharpness; a board older than OpenCV 4.6: legacy",
    )


def _charuco_view(image: Grey, board: Board, indices: NDArray[np.int64], corners: Array) -> BoardView:
    H, _ = cv2.findHomography(board.points()[indices, :2], corners, cv2.RANSAC, 0.3 * _scatter(corners))
    if H is None:  # pyright: ignore[reportUnnecessaryComparison]
        raise ComputeError("the ChArUco corners do not lie on a plane", remedy="More of the board must be visible")
    grid = cv2.perspectiveTransform(board.points()[None, :, :2], H)[0].reshape(board.rows, board.columns, 2)
    row, column = np.divmod(indices, board.columns)
    part = np.asarray(grid, dtype=np.float64)[row.min() : row.max() + 1, column.min() : column.max() + 1]
    if min(part.shape[:2]) < 2:
        raise ComputeError("only one row of the ChArUco board is seen", remedy="More of the board must be visible")
    refined, good = refine_corners(image, corners, half_window(_grid_spacing(part), board.reach()))
    return BoardView(indices[good], refined[good])


def _scatter(corners: Array) -> float:
    """Return a length that scales with the spacing of the corners, px."""
    return float(np.sqrt(np.prod(np.ptp(corners, axis=0)) / len(corners)))


def _find_circles(image: Grey, board: Board) -> BoardView:
    """Find an asymmetric grid of dark circles in a reduced copy, then the centroid of each at full size.

    The centroid of a tilted circle's image is not the image of its centre: the difference is 0.1 px at 45° and 20 px
    diameter.
    """
    for target in _SEARCH_WIDTHS:
        small, scale = _reduced(image, target)
        settings = cv2.SimpleBlobDetector.Params()
        settings.minArea, settings.maxArea = 20, small.size / (4 * board.columns * board.rows)
        settings.minDistBetweenBlobs = 4
        detector = cv2.SimpleBlobDetector.create(settings)
        for more in (cv2.CALIB_CB_CLUSTERING, 0):
            flags = cv2.CALIB_CB_ASYMMETRIC_GRID | more
            found, centres = cv2.findCirclesGrid(
                small, (board.columns, board.rows), flags=flags, blobDetector=detector
            )
            if found:
                start = (np.asarray(centres, dtype=np.float64).reshape(-1, 2) + 0.5) * scale - 0.5
                return BoardView(np.arange(len(start)), _centroids(image, start))
        if small is image:
            break
    raise ComputeError(
        f"no asymmetric grid of {board.columns} × {board.rows} circles in the image",
        remedy="The whole grid must be visible; OpenCV counts the circles of one row and then the rows",
    )


def _centroids(image: Grey, start: Array) -> Array:
    """Return the centroids (N, 2) of the dark circles, each pixel weighted by how much of it is dark."""
    distance = np.linalg.norm(start[:, None] - start[None], axis=2) + np.diag(np.full(len(start), np.inf))
    half = int(0.5 * distance.min())
    out = start.copy()
    for k, (x, y) in enumerate(start.round().astype(int)):
        patch = image[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1].astype(np.float64)
        dark, bright = np.percentile(patch, (2, 95))
        share = np.clip((bright - patch) / max(bright - dark, 1.0), 0, 1)
        share[share < 0.2] = 0  # paper texture and noise, which would pull towards the patch's centre
        rows, columns = np.indices(share.shape)
        out[k] = np.array([np.sum(columns * share), np.sum(rows * share)]) / share.sum()
        out[k] += [max(x - half, 0), max(y - half, 0)]
    return out
