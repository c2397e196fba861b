"""Estimates a camera's intrinsics from views of a board, with their covariance, and names outlying views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.compute.calibration.board import Board, BoardView
from service.compute.calibration.intrinsics_adjustment import (
    PARAMETER_COUNT,
    PARAMETERS,
    Adjustment,
    BoardSurface,
    LensModel,
    adjust,
    fit_pose,
    flat_surface,
    pose_matrix,
    start,
    start_pose,
)
from service.compute.camera_model import CameraModel
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform
from service.core.units import deg

COVERAGE_GRID = (12, 8)
_MIN_VIEWS = 3
_MIN_CORNERS = 8
_MIN_TILT_SPREAD_DEG = 10.0
_OUTLIER = 3.0  # times the median error of all views
_OUTLIER_FLOOR_PX = 0.02
_MIN_VIEWS_TO_COMPARE = 6
_MIN_EIGENVALUE = 1e-14  # of the normal matrix scaled to a diagonal of ones


@dataclass(frozen=True, slots=True)
class ExcludedView:
    """A view that was not used in the calibration, by its index in the input."""

    index: int
    reason: str


@dataclass(frozen=True, slots=True)
class IntrinsicsResult:
    """A calibrated camera and measures of its quality.

    Attributes:
        camera: the camera at the images' size.
        model: the lens model that was estimated.
        board: the board in the views, with the bow that they show.
        rms_px: root mean square of all corners' reprojection errors (two-dimensional).
        views: (N,) input indices of the views used.
        corners: (N) their corners.
        per_view_rms_px: (N,) root mean square for each view.
        parameters: (P) names, in the order of the covariance.
        covariance: (P, P), px and 1: from the corners' noise, estimated from the residuals, times `inflation`.
        joint_covariance: (P + S, P + S) covariance of the parameters and the S terms of the board's bow (m); S is 0
            for a board that is exactly flat by its description.
        inflation: ratio of the variance to that from independent corners, at least 1. The corners of one image share
            errors (light, flatness of the board, lens model); the disagreement between images shows how large these
            are.
        sigma: standard deviation of each parameter, the roots of the covariance's diagonal.
        sigma_independent: standard deviations from corner noise alone, as most programs report them.
        sigma_by_image: standard deviations from the disagreement of the images alone; NaN for fewer than 6 views.
        leave_one_out: (N, P) change of the parameters when one view is left out (one Newton step).
        sigma_corner_px: standard deviation of one coordinate of a corner, from the residuals.
        T_camera_board: (N, 4, 4); board frame: x along the columns, y along the rows, z away from the camera.
        coverage: share of the image's 12 × 8 cells that hold a corner of some view.
        coverage_map: (8, 12) corners in each cell.
        tilt_deg: (N,) angle between the board's normal and the optical axis.
        tilt_spread_deg: largest angle between the normals of two views.
        excluded: views left out, with reasons.
        adjustment: the equations at the solution.
    """

    camera: CameraModel
    model: LensModel
    board: Board
    rms_px: float
    views: NDArray[np.int64]
    corners: tuple[BoardView, ...]
    per_view_rms_px: Array
    parameters: tuple[str, ...]
    covariance: Array
    joint_covariance: Array
    inflation: float
    sigma: dict[str, float]
    sigma_independent: dict[str, float]
    sigma_by_image: dict[str, float]
    leave_one_out: Array
    sigma_corner_px: float
    T_camera_board: Array
    coverage: float
    coverage_map: NDArray[np.int64]
    tilt_deg: Array
    tilt_spread_deg: float
    excluded: tuple[ExcludedView, ...]
    adjustment: Adjustment


def calibrate_intrinsics(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], *, model: LensModel = "opencv4"
) -> IntrinsicsResult:
    """Calibrate a camera from views of a board that is flat, or bent within its given flatness.

    The bow of a board acts on the views like another lens: a tenth of a millimetre changes the focal length by ten of
    the standard deviations that a fit without it would report. So its two terms are estimated with the camera.

    Source: Zhang, "A flexible new technique for camera calibration", PAMI 22(11), 2000, with OpenCV's distortion.
    k3 … k6 have a weak prior (`prior_precision`), which takes effect only if the images do not determine them.

    Views with outlying errors (more than three times the median) are excluded with a reason, the worst first; a view
    that fits the final camera after all is readmitted. Outlying corners within a view are downweighted (Huber).

    Args:
        views: views from `find_board`.
        board: the board in the views.
        size: width and height of the images, px.
        model: pinhole (no distortion), radial2 (k1, k2), opencv4 (and p1, p2), opencv5 (and k3), rational (k1 … k6).

    Raises:
        DataError: a view's corners do not belong to this board.
        ComputeError: too few views, or tilts so similar that the focal length is undetermined.
    """
    surface = surface_of(board)
    used, reasons = _usable(views, len(surface.points))
    solution, used = _solve_without_outliers(views, surface, size, model, used, reasons)
    seen = tuple(views[k] for k in used)
    count = PARAMETER_COUNT[model]
    names = PARAMETERS[:count]
    corners_used = sum(len(view.indices) for view in seen)
    freedom = 2 * corners_used - len(solution.prior) - 6 * len(used)
    variance = sum(float(view.weighted @ view.weighted) for view in solution.views) / max(freedom, 1)
    root = _inverse_root(np.sum([view.normal for view in solution.views], axis=0) + np.diag(solution.prior))
    independent = root @ root.T * variance
    inflation, by_image = _inflation(solution, root, variance)
    covariance = independent * inflation
    poses = solution.T_camera_board()
    counts = coverage_map_of([view.corners for view in seen], size)
    squares = sum(float(view.residual @ view.residual) for view in solution.views)
    return IntrinsicsResult(
        camera=solution.camera,
        model=model,
        board=bent(board, solution.bow_m),
        rms_px=float(np.sqrt(squares / corners_used)),
        views=np.array(used, dtype=np.int64),
        corners=seen,
        per_view_rms_px=np.array([view.rms_px for view in solution.views]),
        parameters=names,
        covariance=covariance[:count, :count],
        joint_covariance=covariance,
        inflation=inflation,
        sigma=_sigma(names, covariance[:count, :count]),
        sigma_independent=_sigma(names, independent[:count, :count]),
        sigma_by_image=_sigma(names, by_image[:count, :count]),
        leave_one_out=leave_one_out(solution)[:, :count],
        sigma_corner_px=float(np.sqrt(variance)),
        T_camera_board=poses,
        coverage=float(np.count_nonzero(counts)) / counts.size,
        coverage_map=counts,
        tilt_deg=np.degrees(np.arccos(np.clip(np.abs(poses[:, 2, 2]), 0, 1))),
        tilt_spread_deg=_largest_angle_deg(poses[:, :3, 2]),
        excluded=tuple(ExcludedView(index, reasons[index]) for index in sorted(reasons)),
        adjustment=solution,
    )


def locate_view(view: BoardView, board: Board, camera: CameraModel) -> tuple[Transform, float]:
    """Return T_camera_board of one view by a calibrated camera, and its RMS reprojection error in px.

    Raises:
        ComputeError: no pose explains the corners.
    """
    points = board.points()
    pose, rms_px = fit_pose(view, points, camera, start_pose(view, points, camera))
    return pose_matrix(pose), rms_px


def surface_of(board: Board) -> BoardSurface:
    """Return the board's surface as the given flatness allows it to be bent."""
    flat = replace(board, bow_m=(0.0, 0.0))
    if board.flatness_m == 0:
        return flat_surface(board.points())
    return BoardSurface(flat.points(), flat.bends(), board.flatness_m / np.sqrt(3))


def bent(board: Board, bow_m: Array) -> Board:
    """Return the board with an estimated bow (2,), or as it is for none (0,)."""
    return replace(board, bow_m=(float(bow_m[0]), float(bow_m[1]))) if len(bow_m) else board


def leave_one_out(solution: Adjustment) -> Array:
    """Compute the (N, P + S) change of parameters and bow without each view, by one Newton step at the solution.

    Without view i, the gradient at the solution is minus this view's part, g_i, and the normal matrix is less its
    part, S_i: d = (S - S_i)^-1 g_i. NaN if the other views do not determine the camera.
    """
    normal = np.sum([view.normal for view in solution.views], axis=0) + np.diag(solution.prior)
    scale = np.sqrt(np.diag(normal))
    changes = np.full((len(solution.views), len(scale)), np.nan)
    for k, view in enumerate(solution.views):
        rest = (normal - view.normal) / np.outer(scale, scale)
        if np.linalg.eigvalsh(rest)[0] > _MIN_EIGENVALUE:
            changes[k] = np.linalg.solve(rest, view.gradient / scale) / scale
    return changes


def _usable(views: Sequence[BoardView], n_points: int) -> tuple[list[int], dict[int, str]]:
    """Return the views with enough corners, and the reasons why the others are not used."""
    used: list[int] = []
    reasons: dict[int, str] = {}
    for index, view in enumerate(views):
        _check_view(view, n_points, index)
        if len(view.indices) < _MIN_CORNERS:
            reasons[index] = f"{len(view.indices)} corners of the board, at least {_MIN_CORNERS} are needed"
        else:
            used.append(index)
    return used, reasons


def _solve_without_outliers(
    views: Sequence[BoardView],
    surface: BoardSurface,
    size: tuple[int, int],
    model: LensModel,
    used: list[int],
    reasons: dict[int, str],
) -> tuple[Adjustment, list[int]]:
    """Return the solution and the views used; the reasons for the others are added to `reasons`."""
    count, points = PARAMETER_COUNT[model], surface.points
    suspects: list[int] = []
    begin: tuple[CameraModel, Array] | None = None
    while True:
        if len(used) < _MIN_VIEWS:
            raise ComputeError(
                f"{len(used)} usable board views, at least {_MIN_VIEWS} are needed"
                + "".join(f"; view {index}: {reasons[index]}" for index in sorted(reasons)),
                remedy="Take more board images with different tilts",
            )
        chosen = [views[k] for k in used]
        if begin is None:
            _check_tilt(chosen, points, size)
            begin = start(chosen, points, size, model)
        solution = adjust(chosen, surface, size, *begin, parameters=count)
        errors = np.array([view.rms_px for view in solution.views])
        limit = max(_OUTLIER * float(np.median(errors)), _OUTLIER_FLOOR_PX)
        # One bad view raises the errors of good ones: exclude only those near the worst in each round.
        bad = (errors > limit) & (errors > 0.5 * errors.max())
        if not bad.any():
            break
        for k in np.flatnonzero(bad):
            reasons[used[k]] = f"error {errors[k]:.2f} px, median {np.median(errors):.2f} px"
        suspects += [used[k] for k in np.flatnonzero(bad)]
        used = [index for k, index in enumerate(used) if not bad[k]]
        begin = None
    points = surface.bent(solution.bow_m)
    back = [k for k in suspects if _fits(views[k], points, solution.camera, limit)]
    if not back:
        return solution, used
    for index in back:
        del reasons[index]
    used = sorted([*used, *back])
    chosen = [views[k] for k in used]
    poses = np.stack([start_pose(view, points, solution.camera) for view in chosen])
    return adjust(chosen, surface, size, solution.camera, poses, parameters=count, bow_m=solution.bow_m), used


def _fits(view: BoardView, points: Array, camera: CameraModel, limit_px: float) -> bool:
    return fit_pose(view, points, camera, start_pose(view, points, camera))[1] <= limit_px


def _check_view(view: BoardView, count: int, index: int) -> None:
    corners, indices = view.corners, view.indices
    if corners.ndim != 2 or corners.shape != (len(indices), 2) or len(indices) > count:
        raise DataError(f"{corners.shape} corners instead of ({count}, 2)", where=f"view {index}")
    if not np.isfinite(corners).all() or len(np.unique(indices)) != len(indices):
        raise DataError("a corner is not finite, or occurs twice", where=f"view {index}")
    if len(indices) and (indices.min() < 0 or indices.max() >= count):
        raise DataError(f"a corner's index is outside the board's {count} points", where=f"view {index}")


def _inverse_root(normal: Array) -> Array:
    """Return R (P, P) with R Rᵀ the inverse of the normal matrix, which is the identity in R's coordinates.

    Raises:
        ComputeError: the views do not determine the parameters.
    """
    scale = np.sqrt(np.diag(normal))
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    if values[0] < _MIN_EIGENVALUE:
        raise ComputeError(
            "the views do not determine all terms of the distortion",
            remedy="Choose a model with fewer terms, or show the board in the corners of the image",
        )
    return vectors / np.sqrt(values) / scale[:, None]


def _inflation(solution: Adjustment, root: Array, variance: float) -> tuple[float, Array]:
    """Return the covariances' ratio, images to corners, over all directions, and that from images (P, P).

    Each image's gradient is one sample of the errors that its corners share. It is corrected for the part that the
    solution has absorbed; otherwise few images would look too good. The shape of the covariance is still taken from
    the corners and only its scale from the images: a dozen images do not determine an 8 × 8 matrix.
    Source: Bell and McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage samples",
    Survey Methodology 28, 2002 (CR2).
    """
    count = len(root)
    if len(solution.views) < _MIN_VIEWS_TO_COMPARE:
        return 1.0, np.full_like(root, np.nan)
    total = np.zeros((count, count))
    for view in solution.views:
        share, turn = np.linalg.eigh(root.T @ view.normal @ root)
        free = np.clip(1 - share, 1e-6, None)
        corrected = turn @ ((turn.T @ root.T @ view.gradient) / np.sqrt(free))
        total += np.outer(corrected, corrected)
    return max(1.0, float(np.trace(total)) / count / variance), root @ total @ root.T


def _sigma(names: Sequence[str], covariance: Array) -> dict[str, float]:
    return {name: float(np.sqrt(v)) for name, v in zip(names, np.diag(covariance), strict=True)}


def _check_tilt(views: Sequence[BoardView], points: Array, size: tuple[int, int]) -> None:
    """Refuse views of parallel boards, which leave the focal length undetermined.

    The angles are judged with rough poses under a nominal lens, which suffices for angles between normals.
    """
    focal = 1.2 * max(size)
    camera = CameraModel(*size, focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)
    normals = np.stack([pose_matrix(start_pose(view, points, camera))[:3, 2] for view in views])
    spread = _largest_angle_deg(normals)
    if spread < _MIN_TILT_SPREAD_DEG:
        raise ComputeError(
            f"all board views have nearly the same tilt (normals within {spread:.1f}°): focal length undetermined",
            remedy=f"Tilt the board or the camera by {_MIN_TILT_SPREAD_DEG:.0f}° or more (30°), to several sides",
        )


def _largest_angle_deg(directions: Array) -> float:
    return deg(np.arccos(np.clip((directions @ directions.T).min(), -1, 1)))


def coverage_map_of(corners: Sequence[Array], size: tuple[int, int]) -> NDArray[np.int64]:
    """Return (rows, columns) corners in each cell of the image."""
    edges = [np.linspace(-0.5, size[k] - 0.5, COVERAGE_GRID[k] + 1) for k in (1, 0)]
    everything = np.concatenate(corners)
    inside = np.clip(everything, -0.5, np.array(size) - 0.5)
    return np.histogram2d(inside[:, 1], inside[:, 0], bins=[edges[0], edges[1]])[0].astype(np.int64)
