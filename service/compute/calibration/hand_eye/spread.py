"""Uncertainty of a hand-eye answer: the bootstrap over images, the camera's share, and held-out images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.calibration.board.board import BoardView
from service.compute.calibration.hand_eye.closed_form import CLOSED_FORMS, solve_closed_form
from service.compute.calibration.hand_eye.fit import HandEyeMeasurements, HandEyeSolution, Method, fit_resized
from service.compute.calibration.hand_eye.reprojection import BoardCorners, resample_reprojection
from service.compute.calibration.hand_eye.weighted import prior_share, resample
from service.compute.calibration.intrinsics.adjustment import fit_pose, pose_matrix
from service.compute.camera_covariance import CameraCovariance
from service.compute.camera_model import CameraModel
from service.core.geometry import Array, Transform
from service.core.units import metres

_MIN_DISTINCT = 4  # distinct views in a bootstrap replicate


def bootstrap_covariance(
    data: HandEyeMeasurements, method: Method, answer: HandEyeSolution, count: int, rng: np.random.Generator
) -> Array:
    """(6, 6) covariance of T_flange_camera from resampling whole images.

    It also covers systematic errors, as far as they differ from pose to pose.
    """
    n = len(data.hands) if answer.views is None else len(answer.views.T_base_flange)
    picks = bootstrap_picks(n, count, rng)
    counts = bootstrap_counts(picks, n)
    X = answer.T_flange_camera
    if answer.views is not None:
        assert answer.noise is not None
        assert answer.fit is not None
        steps = resample(answer.views, answer.noise, answer.fit, counts)
        return np.cov(steps[:, :6].T) + prior_share(answer.views, answer.noise, answer.fit)[:6, :6]
    resized = data.resized(answer.scale)
    if method in CLOSED_FORMS:
        replicas = [solve_closed_form(resized.hands[pick], resized.boards[pick], method) for pick in picks]
        steps = np.array([_increment(T, X) for T in replicas])
    else:
        assert resized.corners is not None
        steps = resample_reprojection(resized.hands, resized.corners, X, answer.T_base_board, counts)
    return np.cov(steps[:, :6].T) + _resized_share(data, method, answer)


def bootstrap_picks(n: int, count: int, rng: np.random.Generator) -> list[NDArray[np.int64]]:
    """Up to `count` draws of n views with replacement; draws of too few different views are left out."""
    picks = [rng.integers(0, n, n) for _ in range(count)]
    return [pick for pick in picks if len(np.unique(pick)) >= _MIN_DISTINCT]


def bootstrap_counts(picks: Sequence[NDArray[np.int64]], n: int) -> Array:
    """(R, n) how often each view counts in each draw."""
    return np.array([np.bincount(pick, minlength=n) for pick in picks], dtype=np.float64)


def _resized_share(data: HandEyeMeasurements, method: Method, answer: HandEyeSolution) -> Array:
    """(6, 6) covariance of T_flange_camera due to the uncertainty of the board's scale, for an unweighted method."""
    other = fit_resized(data, method, answer, answer.scale + answer.scale_sigma)
    step = _increment(other.T_flange_camera, answer.T_flange_camera)
    return np.outer(step, step)


def _increment(after: Transform, before: Transform) -> Array:
    """(6,) shift in metres and turn in radians, in the outer axes."""
    turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
    return np.concatenate([after[:3, 3] - before[:3, 3], turn])


def camera_share(data: HandEyeMeasurements, known: CameraCovariance) -> Array:
    """(6, 6) covariance of T_flange_camera due to the camera calibration's uncertainty, common to all images.

    Board poses and then the mount are found again with cameras displaced by one standard deviation; by Park's closed
    form, which reacts to the camera's error as the other methods do.
    """
    corners = data.corners
    assert corners is not None
    total = np.zeros((6, 6))
    before = solve_closed_form(data.hands, data.boards, "park")
    for camera in known.deviations(corners.camera):
        boards = np.array(
            [_located(corners, k, T, camera) for k, T in enumerate(data.boards)],
        )
        step = _increment(solve_closed_form(data.hands, boards, "park"), before)
        total += np.outer(step, step)
    return total


def _located(corners: BoardCorners, index: int, T: Transform, camera: CameraModel) -> Transform:
    """T_camera_board of one view refined with another camera, starting from T."""
    seen = np.flatnonzero(np.isfinite(corners.corners_px[index]).all(axis=1))
    view = BoardView(seen, corners.corners_px[index][seen])
    start = np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])
    return pose_matrix(fit_pose(view, corners.points_m, camera, start)[0])


def not_below_held_out(covariance: Array, held_out_mm: Array, held_out_deg: Array) -> Array:
    """The covariance (6, 6) with translation and rotation each scaled up to what held-out images require.

    A closed form has no noise model, and views with similar errors give similar resamples. But the mean of N views is
    not known better than their held-out scatter over the root of N.

    Args:
        covariance: (d in metres, w in radians).
        held_out_mm: (N,) errors of views judged by a calibration without them.
        held_out_deg: (N,) the same for the rotation.
    """
    root = np.sqrt(len(held_out_mm))
    least = np.array([metres(float(np.median(held_out_mm))), np.radians(np.median(held_out_deg))]) / root
    stated = np.sqrt([np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])])
    factor = np.repeat(np.maximum(1.0, least / np.maximum(stated, 1e-12)), 3)
    return covariance * np.outer(factor, factor)
