"""Projection uncertainty of a calibrated camera over the image, at the specimen's distance."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from service.compute.calibration.board.board import Board, BoardView
from service.compute.calibration.intrinsics.adjustment import Adjustment, project_with_jacobian
from service.compute.calibration.intrinsics.estimate import IntrinsicsResult, surface_of
from service.compute.camera_model import CameraModel
from service.core.errors import DataError
from service.core.geometry import Array, place_jacobian
from service.core.units import mm


@dataclass(frozen=True, slots=True)
class ProjectionUncertainty:
    """Standard deviation of a projected point in its worst direction, on a grid over the image.

    Attributes:
        distance_m: of the points along the optical axis.
        pixels: (rows, columns, 2) positions of the grid.
        sigma_px: (rows, columns).
        sigma_mm: (rows, columns) the same at that distance, perpendicular to the line of sight.
        centre_px: at the middle of the image.
        worst_px: largest over the image.
        rms_px: root mean square over the image.
        centre_mm: at the middle of the image.
        worst_mm: largest over the image.
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
        camera: with `len(adjustment.parameters)` estimated parameters.
        board: the board in the images.
        corners: (N) the board's points in each image.
        adjustment: the equations at the solution.
        covariance: (Q, Q) of the unknowns: the parameters, then the terms of the board's bow.
        bends: (K, S) displacement along the board's normal of each of its points by these terms; S may be 0.
        variance: of one coordinate of a corner, px².
    """

    camera: CameraModel
    board: Board
    corners: tuple[BoardView, ...]
    adjustment: Adjustment
    covariance: Array
    bends: Array
    variance: float


def board_distance_m(result: IntrinsicsResult) -> float:
    """Median distance of the board's middle along the optical axis, m."""
    middle = np.append(result.board.points().mean(axis=0), 1.0)
    return float(np.median((result.T_camera_board @ middle)[:, 2]))


def projection_uncertainty(
    result: IntrinsicsResult, distance_m: float, *, columns: int = 24, rows: int = 16
) -> ProjectionUncertainty:
    """Effect of the calibration's errors on projected points, without the part that the camera's pose absorbs.

    A calibration determines a camera *and* its poses: a wrong principal point acts like a rotated camera. So the
    perturbed camera is first moved by the rigid motion that best aligns its view of the boards with the unperturbed
    one, as any later pose estimation will do. To first order, with b the parameters, e_i the pose of view i, q(b, p)
    the projection and p_ij the board's points in the camera frame:

        db ~ N(0, s² S^-1),   de_i = E_i db + n_i,   n_i ~ N(0, s² C_i^-1)
        dp_ij = L_ij de_i,    tau = argmin Σ |dp_ij - [I, -[p_ij]x] tau|² = K db + Σ H_i n_i
        dq(p) = (dq/db + dq/dp [I, -[p]x] K) db + dq/dp [I, -[p]x] Σ H_i n_i

    and the covariance of dq follows, with the scale s² of `result.covariance` (including inflation).
    Source: Kogan, mrcal, "Projection uncertainty", the form with a fitted implied transformation.

    Args:
        result: from `calibrate_intrinsics`.
        distance_m: of the plane z = distance in the camera frame on which the projected points lie.
        columns: of the grid.
        rows: of the grid.

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
    """`projection_uncertainty` for a camera determined by any images, including planned ones."""
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
    """K (6, Q), and the covariance (6, 6) that the poses' own noise adds; motion (d, w) in metres and radians.

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
    """(3M, 6) derivative of R(rvec) p + t by rvec and tvec."""
    _, dR = cv2.Rodrigues(pose[:3])
    turns = np.asarray(dR, dtype=np.float64).reshape(3, 3, 3)  # by rvec k, then rows and columns of R
    by_rvec = np.einsum("kij,mj->mik", turns, points)
    shift = np.tile(np.eye(3), (len(points), 1, 1))
    return np.concatenate([by_rvec, shift], axis=2).reshape(-1, 6)
