"""Checkerboard corners and the calibration of the camera's intrinsics from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, transform

_SEARCH_WIDTHS = (1200, 2400)  # px; the board is searched for at these sizes, then measured at full size
_COVERAGE_GRID = (12, 8)
_MIN_VIEWS = 5
_MIN_TILT_SPREAD_DEG = 10.0
_SIGMA_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@dataclass(frozen=True, slots=True)
class ExcludedView:
    """A view that took no part in the calibration, by its index in the input."""

    index: int
    reason: str


@dataclass(frozen=True, slots=True)
class IntrinsicsResult:
    """A calibrated camera and what tells whether to trust it.

    Attributes:
        camera: the camera at the images' size.
        rms_px: root mean square of all corners' reprojection errors (two-dimensional).
        views: (N,) input indices of the views used.
        per_view_rms_px: (N,).
        sigma: standard deviation of each parameter (px, or 1 for the distortion), from corner noise alone.
        T_camera_board: (N, 4, 4); board frame: x along the columns, y along the rows, z away from the camera.
        coverage: share of the image's 12 × 8 cells that hold a corner of some view.
        tilt_deg: (N,) angle between the board's normal and the optical axis.
        excluded: views left out, with reasons.
    """

    camera: CameraModel
    rms_px: float
    views: NDArray[np.int64]
    per_view_rms_px: Array
    sigma: dict[str, float]
    T_camera_board: Array
    coverage: float
    tilt_deg: Array
    excluded: tuple[ExcludedView, ...]


def board_points(columns: int, rows: int, square_m: float) -> Array:
    """(columns · rows, 3) inner corners in the board frame, row after row."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x.ravel() * square_m, y.ravel() * square_m, np.zeros(x.size)], axis=1)


def half_turn(columns: int, rows: int, square_m: float) -> Transform | None:
    """T_board_turned of a board that looks the same after half a turn; None if its colours tell which end is up.

    A board with one even and one odd number of inner corners has opposite colours at opposite corners.
    """
    if (columns + rows) % 2:
        return None
    centre = np.array([(columns - 1) * square_m, (rows - 1) * square_m, 0.0])
    return transform(Rotation.from_euler("z", np.pi), centre)


def detect_board(image_grey: NDArray[np.uint8], columns: int, rows: int) -> Array:
    """Inner corners (columns · rows, 2) in pixels, row after row.

    The board is searched for on a reduced copy and its corners are refined at full size. A board with one even
    and one odd corner count is always numbered from the same physical corner: the square between the first
    corners of the first two rows is dark.

    Raises:
        DataError: not a grey 8-bit image.
        ComputeError: the whole board is not visible.
    """
    if image_grey.ndim != 2 or image_grey.dtype != np.uint8:
        raise DataError(f"the board is searched for in grey 8-bit images, not {image_grey.shape} {image_grey.dtype}")
    found = _search(image_grey, columns, rows)
    grid = found.reshape(rows, columns, 2)
    spacing = min(
        float(np.linalg.norm(np.diff(grid, axis=0), axis=2).min()),
        float(np.linalg.norm(np.diff(grid, axis=1), axis=2).min()),
    )
    # The window must not reach the next corner's edges, nor be so large that distortion bends them.
    half = int(np.clip(0.4 * spacing, 2, 30))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    start = found.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(image_grey, start.copy(), (half, half), (-1, -1), criteria).astype(np.float64)
    corners = refined.reshape(-1, 2)
    if np.abs(corners - found).max() > 0.5 * spacing:
        raise ComputeError("corners of the board drifted while they were refined", remedy="take a sharper image")
    if (columns + rows) % 2 and not _first_square_is_dark(image_grey, corners.reshape(rows, columns, 2)):
        corners = corners[::-1].copy()
    return corners


def _search(image: NDArray[np.uint8], columns: int, rows: int) -> Array:
    height, width = image.shape
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    tried: list[int] = []
    for target in _SEARCH_WIDTHS:
        factor = min(1.0, target / max(width, height))
        if factor < 1.0:
            small = cv2.resize(image, (round(width * factor), round(height * factor)), interpolation=cv2.INTER_AREA)
        else:
            small = image
        tried.append(small.shape[1])
        found, corners = cv2.findChessboardCornersSB(small, (columns, rows), flags=flags)
        if found:
            scale = np.array([width / small.shape[1], height / small.shape[0]])
            return (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) * scale - 0.5
        if factor == 1.0:
            break
    raise ComputeError(
        f"no board of {columns} × {rows} inner corners in the image (searched at widths {tried})",
        remedy="the whole board must be visible, sharp and evenly lit; check columns and rows (inner corners)",
    )


def _first_square_is_dark(image: NDArray[np.uint8], grid: Array) -> bool:
    """Compare the mean brightness at the centres of the squares of either colour."""
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    x = np.clip(centres[..., 0].round().astype(int), 0, image.shape[1] - 1)
    y = np.clip(centres[..., 1].round().astype(int), 0, image.shape[0] - 1)
    value = image[y, x].astype(np.float64)
    row, column = np.indices(value.shape)
    even = (row + column) % 2 == 0
    return bool(value[even].mean() < value[~even].mean())


def calibrate_intrinsics(
    corners: Sequence[Array], square_m: float, columns: int, rows: int, size: tuple[int, int]
) -> IntrinsicsResult:
    """Calibrate fx, fy, cx, cy, k1, k2, p1, p2 from board views (Zhang's method; OpenCV's calibrateCamera).

    Views whose error stands out (more than three times the median) are left out, one round after another, and named.

    Args:
        corners: of each view, (columns · rows, 2) as from `detect_board`.
        square_m: side of a square.
        columns: inner corners in a row.
        rows: inner corners in a column.
        size: width and height of the images.

    Raises:
        DataError: a view has another number of corners.
        ComputeError: too few views, or views so alike in tilt that the focal length is not determined.
    """
    for index, view in enumerate(corners):
        if view.shape != (columns * rows, 2) or not np.isfinite(view).all():
            raise DataError(f"{view.shape} corners instead of ({columns * rows}, 2)", where=f"view {index}")
    points = board_points(columns, rows, square_m).astype(np.float32)
    used = list(range(len(corners)))
    excluded: list[ExcludedView] = []
    while True:
        if len(used) < _MIN_VIEWS:
            raise ComputeError(
                f"{len(used)} usable board views, at least {_MIN_VIEWS} are needed"
                + "".join(f"; view {e.index}: {e.reason}" for e in excluded),
                remedy="take more board images with different tilts",
            )
        _check_tilt(corners, used, points, size)
        flags = cv2.CALIB_FIX_K3
        rms, K, distortion, rvecs, tvecs, deviation, _, per_view = cv2.calibrateCameraExtended(
            [points] * len(used),
            [corners[k].astype(np.float32).reshape(-1, 1, 2) for k in used],
            size,
            np.eye(3),
            np.zeros(5),
            flags=flags,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10),
        )
        view_rms = np.asarray(per_view, dtype=np.float64).ravel()
        limit = max(3 * float(np.median(view_rms)), 0.02)
        worst = [k for k, value in enumerate(view_rms) if value > limit]
        if not worst:
            break
        excluded += [
            ExcludedView(used[k], f"error {view_rms[k]:.2f} px, median {np.median(view_rms):.2f} px") for k in worst
        ]
        used = [index for k, index in enumerate(used) if k not in worst]
    poses = np.stack([_pose(r, t) for r, t in zip(rvecs, tvecs, strict=True)])
    k1, k2, p1, p2 = (float(v) for v in np.asarray(distortion).ravel()[:4])
    camera = CameraModel(*size, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), k1, k2, p1, p2)
    sigma = {name: float(v) for name, v in zip(_SIGMA_NAMES, np.asarray(deviation).ravel(), strict=False)}
    return IntrinsicsResult(
        camera,
        float(rms),
        np.array(used, dtype=np.int64),
        view_rms,
        sigma,
        poses,
        _coverage([corners[k] for k in used], size),
        np.degrees(np.arccos(np.clip(np.abs(poses[:, 2, 2]), 0, 1))),
        tuple(excluded),
    )


def locate_board(
    corners: Array, square_m: float, columns: int, rows: int, camera: CameraModel
) -> tuple[Transform, float]:
    """T_camera_board of one view of a calibrated camera, and its RMS reprojection error in px.

    Raises:
        ComputeError: no pose explains the corners.
    """
    points = board_points(columns, rows, square_m)
    done, rvec, tvec = cv2.solvePnP(points, corners, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_IPPE)
    if not done:
        raise ComputeError("the board's pose could not be computed", remedy="check the corner counts")
    rvec, tvec = cv2.solvePnPRefineLM(points, corners, camera.matrix, camera.distortion, rvec, tvec)
    T = _pose(rvec, tvec)
    residual = camera.project(points @ T[:3, :3].T + T[:3, 3]) - corners
    return T, float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))


def _pose(rvec: npt.ArrayLike, tvec: npt.ArrayLike) -> Transform:
    """Our transform of OpenCV's pair of vectors."""
    return transform(Rotation.from_rotvec(np.asarray(rvec, np.float64).ravel()), np.asarray(tvec, np.float64).ravel())


def _check_tilt(
    corners: Sequence[Array], used: list[int], points: NDArray[np.float32], size: tuple[int, int]
) -> None:
    """Parallel boards leave the focal length undetermined: refuse before the solver invents one.

    Perspective is judged by rough poses under a nominal lens, which is good enough for an angle between normals.
    """
    focal = 1.2 * max(size)
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    normals: list[Array] = []
    for k in used:
        done, rvec, tvec = cv2.solvePnP(points, corners[k], K, np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
        if done:
            normals.append(_pose(rvec, tvec)[:3, 2])
    stack = np.array(normals)
    spread = float(np.degrees(np.arccos(np.clip((stack @ stack.T).min(), -1, 1)))) if normals else 0.0
    if spread < _MIN_TILT_SPREAD_DEG:
        raise ComputeError(
            f"all board views have nearly the same tilt (normals within {spread:.1f}°): focal length undetermined",
            remedy=f"tilt the board or the camera by {_MIN_TILT_SPREAD_DEG:.0f}° or more (30°), to several sides",
        )


def _coverage(corners: Sequence[Array], size: tuple[int, int]) -> float:
    cells = np.array(_COVERAGE_GRID)
    index = np.clip((np.concatenate(corners) / np.array(size) * cells).astype(int), 0, cells - 1)
    return len(np.unique(index, axis=0)) / int(cells.prod())
