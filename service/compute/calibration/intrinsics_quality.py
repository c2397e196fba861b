"""Says how good a calibration is: its projection uncertainty over the image, cross-validation, warnings, plots."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.calibration.board import Board, BoardView
from service.compute.calibration.intrinsics import IntrinsicsResult, calibrate_intrinsics, leave_one_out, surface_of
from service.compute.calibration.intrinsics_adjustment import Adjustment, adjust, fit_pose, project_with_jacobian, rms
from service.compute.camera_model import CameraModel
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, place_jacobian
from service.core.units import mm


@dataclass(frozen=True, slots=True)
class ProjectionUncertainty:
    """Standard deviation of a projected point in its worst direction, on a grid over the image.

    Attributes:
        distance_m: distance of the points along the optical axis.
        pixels: (rows, columns, 2) positions of the grid.
        sigma_px: (rows, columns) standard deviation.
        sigma_mm: (rows, columns) standard deviation at that distance, perpendicular to the line of sight.
        centre_px: standard deviation at the middle of the image.
        worst_px: largest standard deviation over the image.
        rms_px: root mean square over the image.
        centre_mm: standard deviation at the middle of the image.
        worst_mm: largest standard deviation over the image.
        rms_mm: root mean square over the image.
    """

    distance_m: float
    pixels: Array
    sigma_px: Array
    sigma_mm: Array
    centre_px: float
    worst_px: float
    rms_px: float
    centre_mm: float
    worst_mm: float
    rms_mm: float


@dataclass(frozen=True, slots=True)
class EstimatedCamera:
    """A camera as determined by board images: the input of its projection uncertainty.

    Attributes:
        camera: the camera with `len(adjustment.parameters)` estimated parameters.
        board: the board in the images.
        corners: (N) the board's points in each image.
        adjustment: the equations at the solution.
        covariance: (Q, Q) covariance of the unknowns: the parameters, then the terms of the board's bow.
        bends: (K, S) displacement along the board's normal of each of its points by these terms; S may be 0.
        variance: variance of one coordinate of a corner, px².
    """

    camera: CameraModel
    board: Board
    corners: tuple[BoardView, ...]
    adjustment: Adjustment
    covariance: Array
    bends: Array
    variance: float


def board_distance_m(result: IntrinsicsResult) -> float:
    """Return the median distance of the board's middle along the optical axis, m."""
    middle = np.append(result.board.points().mean(axis=0), 1.0)
    return float(np.median((result.T_camera_board @ middle)[:, 2]))


def projection_uncertainty(
    result: IntrinsicsResult, distance_m: float, *, columns: int = 24, rows: int = 16
) -> ProjectionUncertainty:
    """Propagate the calibration's errors to projected points, without the part that the camera's pose absorbs.

    A calibration determines a camera *and* its poses: a wrong principal point acts like a rotated camera. So the
    perturbed camera is first moved by the rigid motion that best aligns its view of the boards with the unperturbed
    one, as any later pose estimation will do. To first order, with b the parameters, e_i the pose of view i, q(b, p)
    the projection and p_ij the board's points in the camera frame:

        db ~ N(0, s² S^-1),   de_i = E_i db + n_i,   n_i ~ N(0, s² C_i^-1)
        dp_ij = L_ij de_i,    tau = argmin Σ |dp_ij - [I, -[p_ij]x] tau|² = K db + Σ H_i n_i
        dq(p) = (dq/db + dq/dp [I, -[p]x] K) db + dq/dp [I, -[p]x] Σ H_i n_i

    and the covariance of dq follows, with the scale s² of `result.covariance` (including inflation).
    Source: Kogan, mrcal, "Projection uncertainty", the version with a fitted implied transformation.

    Args:
        result: the result of `calibrate_intrinsics`.
        distance_m: distance, along z of the camera frame, of the plane on which the projected points lie.
        columns: number of the grid's columns.
        rows: number of the grid's rows.

    Raises:
        DataError: the distance is not positive.
    """
    variance = result.sigma_corner_px**2 * result.inflation
    known = EstimatedCamera(
        result.camera,
        result.board,
        result.corners,
        result.adjustment,
        result.joint_covariance,
        surface_of(result.board).bends,
        variance,
    )
    return uncertainty_of(known, distance_m, columns=columns, rows=rows)


def uncertainty_of(
    result: EstimatedCamera, distance_m: float, *, columns: int = 24, rows: int = 16
) -> ProjectionUncertainty:
    """Compute `projection_uncertainty` for a camera determined by any images, including planned ones."""
    if not 0 < distance_m < np.inf:
        raise DataError(f"a distance of {distance_m} m is not in front of the camera")
    K, noise = _implied_motion(result)
    camera = result.camera
    x = np.linspace(0, camera.width - 1, columns)
    y = np.linspace(0, camera.height - 1, rows)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    # The image's middle is added as one more point.
    pixels = np.vstack([grid.reshape(-1, 2), [(camera.width - 1) / 2, (camera.height - 1) / 2]])
    rays = np.column_stack([camera.normalise(pixels), np.ones(len(pixels))])
    points = rays * distance_m
    _, by_pose, by_camera = project_with_jacobian(points, np.zeros(6), camera)
    # At a zero rvec, OpenCV's derivatives by rvec and tvec are those of a small rotation and shift of the points.
    J_motion = np.column_stack([by_pose[:, 3:], by_pose[:, :3]]).reshape(-1, 2, 6)
    count, every = len(result.adjustment.parameters), len(result.covariance)
    J_camera = np.zeros((len(pixels), 2, every))
    J_camera[:, :, :count] = by_camera[:, :count].reshape(-1, 2, count)
    A = J_camera + J_motion @ K
    covariance = A @ result.covariance @ A.swapaxes(1, 2) + J_motion @ noise @ J_motion.swapaxes(1, 2)
    sigma_px = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    # Back to the plane z = distance: dp = distance · (dq/dxy)^-1 dq.
    by_point = by_pose[:, 3:].reshape(-1, 2, 3)[:, :, :2]
    inverse = np.linalg.inv(by_point)
    sigma_m = np.sqrt(np.linalg.eigvalsh(inverse @ covariance @ inverse.swapaxes(1, 2))[:, -1])
    field_px, field_mm = sigma_px[:-1].reshape(rows, columns), mm(sigma_m[:-1].reshape(rows, columns))
    return ProjectionUncertainty(
        distance_m=distance_m,
        pixels=grid,
        sigma_px=field_px,
        sigma_mm=field_mm,
        centre_px=float(sigma_px[-1]),
        worst_px=float(field_px.max()),
        rms_px=float(np.sqrt(np.mean(field_px**2))),
        centre_mm=mm(float(sigma_m[-1])),
        worst_mm=float(field_mm.max()),
        rms_mm=float(np.sqrt(np.mean(field_mm**2))),
    )


def _implied_motion(result: EstimatedCamera) -> tuple[Array, Array]:
    """Return K (6, Q), and the covariance (6, 6) that the poses' own noise adds; motion (d, w) in metres and radians.

    A point p in the camera frame before a change of parameters and poses is at p + d + w x p after it.
    """
    board = result.board.points()
    count = len(result.covariance)
    normal = np.zeros((6, 6))
    by_parameters = np.zeros((6, count))
    spread = np.zeros((6, 6))
    boards = result.adjustment.T_camera_board()
    for k, (view, corners) in enumerate(zip(result.adjustment.views, result.corners, strict=True)):
        T = boards[k]
        points = board[corners.indices] @ T[:3, :3].T + T[:3, 3]
        M = place_jacobian(points).reshape(-1, 6)
        L = _point_by_pose(board[corners.indices], result.adjustment.poses[k])
        pull = M.T @ L
        normal += M.T @ M
        by_parameters += pull @ view.compensation[:, :-1]
        by_parameters[:, count - result.bends.shape[1] :] += M.T @ np.kron(result.bends[corners.indices], T[:3, 2:3])
        spread += pull @ np.linalg.solve(view.pose_normal, pull.T)
    H = np.linalg.inv(normal)
    return H @ by_parameters, result.variance * H @ spread @ H


def _point_by_pose(points: Array, pose: Array) -> Array:
    """Return (3M, 6) derivative of R(rvec) p + t by rvec and tvec."""
    _, dR = cv2.Rodrigues(pose[:3])
    turns = np.asarray(dR, dtype=np.float64).reshape(3, 3, 3)  # by rvec k, then rows and columns of R
    by_rvec = np.einsum("kij,mj->mik", turns, points)
    shift = np.tile(np.eye(3), (len(points), 1, 1))
    return np.concatenate([by_rvec, shift], axis=2).reshape(-1, 6)


MIN_VIEWS_TO_VALIDATE = 4
_FOLDS = 5
# Limits for warnings (the reasons are in the messages).
_VIEWS = 60
_RMS_PX = 0.5
_COVERAGE = 0.9
_TILT_DEG = 30.0
_HELD_OUT_FACTOR = 1.3
_INFLATION = 4.0
_SIMPLE = ("pinhole", "radial2", "opencv4", "opencv5")  # models that a wide lens does not follow
_WIDE = 0.5  # times as large residuals with the rational model indicate a wide lens


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """Errors of views that were not used in the calibration; only the view's own pose is fitted to it.

    Attributes:
        folds: number of parts into which the views were split.
        five_fold_rms_px: root mean square over all views, each held out once.
        five_fold_view_px: (N,) error of each view.
        leave_one_out_rms_px: each view judged by a calibration without it (one Newton step).
        leave_one_out_view_px: (N,); NaN if the other views do not determine the camera.
    """

    folds: int
    five_fold_rms_px: float
    five_fold_view_px: Array
    leave_one_out_rms_px: float
    leave_one_out_view_px: Array


def cross_validate(result: IntrinsicsResult, *, seed: int = 0) -> CrossValidation:
    """Validate a calibration over its views, five-fold and leave-one-out.

    Raises:
        ComputeError: fewer than four views.
    """
    n = len(result.corners)
    if n < MIN_VIEWS_TO_VALIDATE:
        raise ComputeError(f"{n} views cannot be cross-validated", remedy="Take more board images")
    surface = surface_of(result.board)
    size = (result.camera.width, result.camera.height)
    folds = min(_FOLDS, n)
    fold = np.random.default_rng(seed).permutation(n) % folds
    solution = result.adjustment
    held_out = np.zeros(n)
    for k in range(folds):
        train = np.flatnonzero(fold != k)
        without = adjust(
            [result.corners[i] for i in train],
            surface,
            size,
            solution.camera,
            solution.poses[train],
            parameters=len(result.parameters),
            bow_m=solution.bow_m,
            iterations=6,
        )
        points = surface.bent(without.bow_m)
        for i in np.flatnonzero(fold == k):
            held_out[i] = fit_pose(result.corners[i], points, without.camera, solution.poses[i])[1]
    one_out = np.array(
        [
            rms(view.residual + view.reduced @ change)
            for view, change in zip(solution.views, leave_one_out(solution), strict=True)
        ]
    )
    counts = np.array([len(view.indices) for view in result.corners])
    return CrossValidation(folds, _pooled(held_out, counts), held_out, _pooled(one_out, counts), one_out)


def _pooled(per_view_px: Array, counts: Array) -> float:
    return float(np.sqrt(np.sum(per_view_px**2 * counts) / np.sum(counts)))


def residual_field(result: IntrinsicsResult, columns: int = 24, rows: int = 16) -> tuple[Array, NDArray[np.int64]]:
    """Return the mean residual (rows, columns, 2), px, and number (rows, columns) of corners in each image cell.

    Noise averages out; what remains is the error of the lens model.
    """
    corners = np.concatenate([view.corners for view in result.corners])
    residual = np.concatenate([view.residual.reshape(-1, 2) for view in result.adjustment.views])
    cells = np.array([columns, rows])
    size = np.array([result.camera.width, result.camera.height])
    cell = np.clip((corners + 0.5) / size * cells, 0, cells - 1).astype(int)
    flat = cell[:, 1] * columns + cell[:, 0]
    count = np.bincount(flat, minlength=columns * rows)
    total = np.stack([np.bincount(flat, residual[:, k], columns * rows) for k in (0, 1)], axis=1)
    mean = total / np.maximum(count, 1)[:, None]
    return mean.reshape(rows, columns, 2), count.reshape(rows, columns).astype(np.int64)


def _wide_lens(result: IntrinsicsResult) -> list[str]:
    """Warn that a lens is too wide for its model, if the rational one fits the same views far better."""
    size = (result.camera.width, result.camera.height)
    try:
        wide = calibrate_intrinsics(result.corners, result.board, size, model="rational")
    except ComputeError:  # these views do not determine so many terms
        return []
    if wide.rms_px > _WIDE * result.rms_px or len(wide.views) < len(result.views) - 1:
        return []
    return [
        f"a wide lens: the model {result.model} fits to {result.rms_px:.2f} px, rational to {wide.rms_px:.2f} px "
        f"(fx {wide.camera.fx:.1f} ± {wide.sigma['fx']:.1f}): calibrate with --model rational"
    ]


def _undetermined(result: IntrinsicsResult, uncertainty: ProjectionUncertainty) -> list[str]:
    """Return warnings that the images do not determine terms of the distortion."""
    if result.model == "rational":
        # Terms of a quotient may cancel each other: what they mean together is in the projection's uncertainty.
        if uncertainty.worst_px <= _RMS_PX:
            return []
        return [
            "the quotient of k1 … k6 is not determined in all of the image: show the board in its corners, or use "
            "fewer terms"
        ]
    return [
        f"{name} is not determined ({getattr(result.camera, name):.3g} ± {sigma:.2g}): use fewer terms"
        for name, sigma in result.sigma.items()
        if name in ("k2", "k3") and sigma > abs(getattr(result.camera, name))
    ]


def calibration_warnings(
    result: IntrinsicsResult, validation: CrossValidation | None, uncertainty: ProjectionUncertainty
) -> tuple[str, ...]:
    """Return reasons to trust this calibration less; empty if there are none."""
    found: list[str] = []
    n = len(result.views)
    if n < _VIEWS:
        found.append(f"{n} views; {_VIEWS} or more average the errors that corners of one image share")
    if result.rms_px > _RMS_PX:
        found.append(f"{result.rms_px:.2f} px rms, more than {_RMS_PX} px: blur, motion, bent board, wrong model")
    if result.coverage < _COVERAGE:
        share = f"{floor(1000 * result.coverage) / 10:g} %"  # rounded down, so that it never reaches its limit
        found.append(f"corners in {share} of the image, less than {_COVERAGE:.0%}: show the board there")
    if result.tilt_deg.max() < _TILT_DEG:
        found.append(f"largest tilt {result.tilt_deg.max():.0f}°, less than {_TILT_DEG:.0f}°: focal length is weak")
    if result.inflation > _INFLATION:
        found.append(
            f"images disagree {np.sqrt(result.inflation):.1f} times as much as their corners' noise explains "
            "(light, a bent board or a wrong model); the sigmas are enlarged by this"
        )
    if result.model in _SIMPLE and (result.rms_px > _RMS_PX or result.inflation > _INFLATION):
        found += _wide_lens(result)
    found += _undetermined(result, uncertainty)
    bow_m = max(result.board.bow_m, key=abs)
    if abs(bow_m) > result.board.flatness_m:
        found.append(
            f"the board is bent by {mm(abs(bow_m)):.2f} mm, more than its stated flatness of "
            f"{mm(result.board.flatness_m):g} mm: the camera is corrected for an even bow, not for waves"
        )
    if result.board.pattern == "circles":
        found.append("the middle of a tilted circle's image is not its centre: a checkerboard is more accurate")
    if validation is None:
        found.append("too few views for cross-validation")
    elif validation.five_fold_rms_px > _HELD_OUT_FACTOR * result.rms_px:
        found.append(
            f"held-out views err by {validation.five_fold_rms_px:.2f} px, views in the fit by {result.rms_px:.2f} px"
        )
    if uncertainty.worst_px > _RMS_PX:
        found.append(
            f"projection is uncertain by {uncertainty.worst_px:.2f} px ({uncertainty.worst_mm:.3f} mm at "
            f"{uncertainty.distance_m:.2f} m) where it is worst in the image"
        )
    return tuple(found)


_WIDTH = 1080
_MARGIN = 56
_ENOUGH = 5  # corners in a cell for an arrow
_BLACK, _GREY, _BLUE, _RED = (20, 20, 20), (190, 190, 190), (180, 90, 20), (40, 40, 210)

Canvas = NDArray[np.uint8]


def calibration_plots(result: IntrinsicsResult, uncertainty: ProjectionUncertainty) -> dict[str, bytes]:
    """Return PNG files by name: coverage, residuals, uncertainty.

    Raises:
        ComputeError: an image cannot be encoded.
    """
    return {
        "coverage.png": _png(_coverage(result)),
        "residuals.png": _png(_residuals(result)),
        "uncertainty.png": _png(_uncertainty(result, uncertainty)),
    }


def _coverage(result: IntrinsicsResult) -> Canvas:
    """Return the number of corners in each cell, and the corners themselves."""
    counts = result.coverage_map.astype(np.float64)
    canvas, scale = _frame(result, f"{result.coverage:.0%} of the cells hold a corner; {len(result.views)} views")
    _heat(canvas, 1 - 0.45 * counts / max(counts.max(), 1), cv2.COLORMAP_BONE, cv2.INTER_NEAREST)
    for view in result.corners:
        for point in view.corners:
            cv2.circle(canvas, _at(point, scale), 1, _BLUE, -1, cv2.LINE_AA)
    height, width = counts.shape
    for (row, column), count in np.ndenumerate(counts):
        centre = (np.array([column, row]) + 0.5) / [width, height] * [result.camera.width, result.camera.height]
        x, y = _at(centre, scale)
        _text(canvas, f"{count:.0f}", (x - 12, y + 5), _RED if count == 0 else _BLACK, 0.45)
    return canvas


def _residuals(result: IntrinsicsResult) -> Canvas:
    """Draw the mean residual in each of 24 × 16 cells, which shows what the lens model misses, and views' errors."""
    field, counts = residual_field(result)
    mean, enough = field.reshape(-1, 2), np.flatnonzero(counts >= _ENOUGH)
    cells = np.array(counts.shape[::-1])
    size = np.array([result.camera.width, result.camera.height])
    largest = float(np.linalg.norm(mean[enough], axis=1).max(initial=1e-6))
    length = 0.8 * float((size / cells).min())
    canvas, scale = _frame(
        result, f"{result.rms_px:.3f} px rms; arrows: mean residual of a cell, longest {largest:.3f} px"
    )
    for k in enough:
        middle = (np.array([k % cells[0], k // cells[0]]) + 0.5) / cells * size
        tip = middle + mean[k] / largest * length
        cv2.arrowedLine(canvas, _at(middle, scale), _at(tip, scale), _BLUE, 1, cv2.LINE_AA, tipLength=0.3)
    bars = np.full((170, _WIDTH, 3), 255, dtype=np.uint8)
    _text(bars, "rms of each view, px", (_MARGIN, 20), _BLACK, 0.5)
    errors = result.per_view_rms_px
    step = (_WIDTH - 2 * _MARGIN) / len(errors)
    for k, error in enumerate(errors):
        left = round(_MARGIN + k * step)
        top = round(150 - 115 * error / errors.max())
        cv2.rectangle(bars, (left, top), (max(left + 1, round(left + 0.7 * step)), 150), _BLUE, -1)
    _text(bars, f"{errors.max():.3f}", (4, 42), _BLACK, 0.45)
    return np.vstack([canvas, bars])


def _uncertainty(result: IntrinsicsResult, uncertainty: ProjectionUncertainty) -> Canvas:
    """Return the standard deviation of a projected point, with its values on the grid."""
    field = uncertainty.sigma_px
    canvas, scale = _frame(
        result,
        f"sigma of projection at {uncertainty.distance_m:.2f} m: {uncertainty.centre_px:.3f} px in the centre, "
        f"{uncertainty.worst_px:.3f} px ({uncertainty.worst_mm:.4f} mm) at worst",
    )
    low, high = np.log(field.min()), np.log(field.max())
    _heat(canvas, (np.log(field) - low) / max(high - low, 1e-9), cv2.COLORMAP_VIRIDIS, cv2.INTER_CUBIC)
    for row in range(1, field.shape[0], 3):
        for column in range(1, field.shape[1], 3):
            x, y = _at(uncertainty.pixels[row, column], scale)
            _text(canvas, f"{field[row, column]:.3f}", (x - 20, y + 5), (255, 255, 255), 0.45)
    return canvas


def _frame(result: IntrinsicsResult, title: str) -> tuple[Canvas, float]:
    """Return a white canvas with the image's outline, and the canvas pixels per image pixel."""
    scale = (_WIDTH - 2 * _MARGIN) / result.camera.width
    height = round(result.camera.height * scale)
    canvas = np.full((height + 2 * _MARGIN, _WIDTH, 3), 255, dtype=np.uint8)
    cv2.rectangle(canvas, (_MARGIN - 1, _MARGIN - 1), (_WIDTH - _MARGIN, height + _MARGIN), _GREY, 1)
    _text(canvas, title, (_MARGIN, 34), _BLACK, 0.52)
    _text(
        canvas, f"{result.camera.width} x {result.camera.height} px", (_MARGIN, height + _MARGIN + 28), _BLACK, 0.45
    )
    return canvas, scale


def _heat(canvas: Canvas, share: Array, colours: int, interpolation: int) -> None:
    inside = canvas[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
    values = np.clip(share * 255, 0, 255).astype(np.uint8)
    size = (inside.shape[1], inside.shape[0])
    inside[:] = cv2.applyColorMap(
        np.asarray(cv2.resize(values, size, interpolation=interpolation), np.uint8), colours
    )


def _at(pixel: Array, scale: float) -> tuple[int, int]:
    return round(_MARGIN + (pixel[0] + 0.5) * scale), round(_MARGIN + (pixel[1] + 0.5) * scale)


def _text(canvas: Canvas, text: str, at: tuple[int, int], colour: tuple[int, int, int], size: float) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def _png(canvas: Canvas) -> bytes:
    done, data = cv2.imencode(".png", canvas)
    if not done:
        raise ComputeError("a plot cannot be written as PNG")
    return data.tobytes()
