"""Hand-eye calibration: the camera in the flange frame and the board in the base frame, with their uncertainty."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.compute.arm.correction import ArmCorrection
from service.compute.arm.kinematics import ArmModel
from service.compute.calibration.hand_eye.closed_form import (
    CLOSED_FORMS,
    all_closed_forms,
    deviation,
    distance,
    mean_pose,
    observability,
    untwist,
)
from service.compute.calibration.hand_eye.fit import (
    Answer,
    ArmTerms,
    Measured,
    Method,
    arm_is_possible,
    arm_noise,
    arm_outliers,
    find_outliers,
    fit_method,
    fit_with_arm,
    held_out,
    turned_back,
)
from service.compute.calibration.hand_eye.reprojection import BoardCorners, board_covariance
from service.compute.calibration.hand_eye.setup import Setup, check_setup, inverted
from service.compute.calibration.hand_eye.spread import bootstrap_covariance, camera_share, not_below_held_out
from service.compute.calibration.hand_eye.weighted import Noise
from service.compute.camera_covariance import CameraCovariance
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform
from service.core.units import deg, mm

__all__ = [
    "BoardCorners",
    "BoardPlacement",
    "CorrectedHandEye",
    "HandEyeAnswer",
    "HandEyeResult",
    "Method",
    "calibrate_hand_eye",
    "place_board",
]

_FOLDS = 5
_FEW = 24  # up to this many views, use twice the folds: leaving a fifth out would change the answer
_WORTH = 0.9  # an arm's correction is used if it lowers the held-out error below this share


@dataclass(frozen=True, slots=True)
class HandEyeAnswer:
    """T_flange_camera, T_base_board and measures of their quality; arrays are over the N views.

    Attributes:
        T_flange_camera: the calibration.
        T_base_board: the board's pose.
        sigma_mm: bootstrap standard deviation of the translation (root of the summed variances), over images.
        sigma_deg: bootstrap standard deviation of the rotation.
        covariance: (6, 6) of T_flange_camera from the bootstrap, (d in metres, w in radians) in the flange's axes,
            including `camera_share`.
        camera_share: (6, 6) part of it due to the camera calibration's uncertainty, which more images do not reduce.
        formal_covariance: (6, 6) predicted by the fit's own noise model; None unless the method is weighted.
        robot_noise_mm: standard deviation per axis of the robot's remaining position error; None unless the method is
            weighted.
        robot_noise_deg: the same for its rotation.
        residual_mm: (N,) distance between the board as placed by each view and T_base_board, at the board's middle.
        residual_deg: (N,) the same for its orientation.
        held_out_mm: (N,) as residual_mm, but each view is judged by a calibration without its fold.
        held_out_deg: (N,) the same for its orientation.
    """

    T_flange_camera: Transform
    T_base_board: Transform
    sigma_mm: float
    sigma_deg: float
    covariance: Array
    camera_share: Array
    formal_covariance: Array | None
    robot_noise_mm: float | None
    robot_noise_deg: float | None
    residual_mm: Array
    residual_deg: Array
    held_out_mm: Array
    held_out_deg: Array


@dataclass(frozen=True, slots=True)
class CorrectedHandEye(HandEyeAnswer):
    """The answer for poses corrected by `correction` (`corrected_T_base_flange`).

    Attributes:
        correction: the arm's systematic error.
        terms: which of its parameters were estimated.
    """

    correction: ArmCorrection
    terms: ArmTerms


@dataclass(frozen=True, slots=True)
class HandEyeResult(HandEyeAnswer):
    """The answer for the robot's poses as reported, and the diagnostics of the calibration.

    Attributes:
        method: method that gave T_flange_camera.
        methods: T_flange_camera by every method that gave an answer.
        spread_mm: largest distance between the chosen method's translation and another's (including Tsai's and
            Andreff's, which are the weakest: a large spread warns of weak data).
        spread_deg: the same for the rotation.
        corner_sigma_px: standard deviation of the corners; None if only board poses were given.
        rotation_spread_deg: largest rotation between two views.
        second_axis_deg: root mean square rotation about the second best axis.
        condition: condition number of the translation's linear system; infinite for a single rotation axis.
        turned: (N,) whether the view's board pose was rotated by half a turn.
        excluded: reason by index of each view that no fit used.
        corrected: the answer with the arm's systematic error estimated; None if no joints were given or if it does
            not lower the held-out error.
        arm_held_out_mm: root mean square of held_out_mm for each arm model that was tried ("none": the poses as
            reported).
    """

    method: Method
    methods: dict[Method, Transform]
    spread_mm: float
    spread_deg: float
    corner_sigma_px: float | None
    rotation_spread_deg: float
    second_axis_deg: float
    condition: float
    turned: tuple[bool, ...]
    excluded: dict[int, str]
    corrected: CorrectedHandEye | None
    arm_held_out_mm: dict[ArmTerms, float]


@dataclass(frozen=True, slots=True)
class BoardPlacement:
    """A board located in a robot's base frame through a calibrated hand-eye.

    Attributes:
        T_base_board: mean over the views.
        residual_mm: (N,) distance of each view's board origin from the mean.
        residual_deg: (N,) angle of each view's board from the mean.
        sigma_mm: standard error of the mean position.
    """

    T_base_board: Transform
    residual_mm: Array
    residual_deg: Array
    sigma_mm: float


def calibrate_hand_eye(
    T_base_flange: Array,
    T_camera_board: Array,
    *,
    method: Method = "weighted",
    corners: BoardCorners | None = None,
    joints_rad: Array | None = None,
    arm: ArmModel | None = None,
    T_board_turned: Transform | None = None,
    setup: Setup = "eye-in-hand",
    camera_covariance: CameraCovariance | None = None,
    bootstrap: int = 100,
    seed: int = 0,
) -> HandEyeResult:
    """Solve T_base_flange · T_flange_camera · T_camera_board = T_base_board over the views.

    `weighted`, the default, weights robot and images by the noise that the data show in each (weighted.py). A closed
    form uses no weights, and `reprojection` attributes the robot's errors to the images. Given joints and the arm's
    model, the weighted fit also estimates the arm's systematic error and keeps it if held-out views improve.

    Args:
        T_base_flange: (N, 4, 4) from the robot.
        T_camera_board: (N, 4, 4) from the images.
        method: the one that gives the answer; the others are computed for comparison.
        corners: the boards' corners, from which the board poses' covariance follows; required by `reprojection`.
        joints_rad: (N, 6) as recorded with the poses.
        arm: the arm's model, with `joints_rad`.
        T_board_turned: the half turn of a board that looks the same upside down (`half_turn`); views that were
            numbered from the other end are then turned to agree with the robot.
        setup: eye-to-hand: the camera stands beside the robot and the board is on the flange. T_base_camera and
            T_flange_board then take the places of T_flange_camera and T_base_board in the answer, and the arm's
            systematic error is not estimated.
        camera_covariance: of the calibrated camera; with `corners`, it is added to the answer's covariance.
        bootstrap: number of resamples.
        seed: of the resampling and of the folds.

    Raises:
        DataError: array shapes do not match, values are not finite, or the joints are another arm's.
        ComputeError: too few views, too little rotation, rotation about one axis only, poses that do not fit the
            images (`check_setup` names the reading that does), or more than a third of the images disagree with the
            robot.
    """
    data = _measured(T_base_flange, T_camera_board, corners, joints_rad, arm)
    if setup == "eye-to-hand":
        data = dataclasses.replace(data, hands=inverted(data.hands), joints_rad=None, arm=None)
    spread, second, condition = observability(data.hands)
    turned = np.zeros(len(data.hands), dtype=bool)
    if T_board_turned is not None:
        turned = untwist(data.hands, data.boards, T_board_turned)[1]
    straight, sigma_px = _straightened(data, turned, T_board_turned)
    point = np.zeros(3) if corners is None else corners.points_m.mean(axis=0)
    check_setup(straight.hands, straight.boards, point, setup)
    rng = np.random.default_rng(seed)
    excluded = find_outliers(straight, rng)
    keep = ~np.isin(np.arange(len(data.hands)), list(excluded))
    plain = fit_method(straight.take(keep), method)
    if T_board_turned is not None and (again := turned_back(straight, plain, T_board_turned)).any():
        # The vote of all pairs can be wrong for a view; the answer common to the others is not.
        turned = turned ^ again
        straight, sigma_px = _straightened(data, turned, T_board_turned)
        excluded = find_outliers(straight, rng)
        keep = ~np.isin(np.arange(len(data.hands)), list(excluded))
        plain = fit_method(straight.take(keep), method)
    if not all(np.isfinite(observability(straight.hands[keep]))):
        raise ComputeError("the remaining views do not determine the answer")

    folds = np.random.default_rng(seed).permutation(len(keep)) % min(
        _FOLDS if len(keep) > _FEW else 2 * _FOLDS, len(keep)
    )
    outcomes: dict[ArmTerms, tuple[Answer, Array, Array]] = {
        "none": (plain, *held_out(straight, keep, method, "none", (plain, None), folds, point))
    }
    if method == "weighted" and arm_is_possible(straight.take(keep)):
        for terms in ("geometry", "geometry+gears"):
            noise = arm_noise(straight.take(keep), plain, terms)
            answer, used, noise = _arm_answer(straight, keep, plain, terms, noise)
            errors = held_out(straight, used, method, terms, (plain, noise), folds, point)
            outcomes[terms] = (answer, *errors)
    rms: dict[ArmTerms, float] = {k: float(np.sqrt(np.mean(v[1][keep] ** 2))) for k, v in outcomes.items()}
    best = min(rms, key=lambda terms: rms[terms])
    corrected: CorrectedHandEye | None = None
    good = straight.take(keep)
    share = np.zeros((6, 6))
    if camera_covariance is not None and corners is not None:
        share = camera_share(good, camera_covariance)
    if rms[best] < _WORTH * rms["none"]:
        answer, *errors = outcomes[best]
        assert answer.correction is not None
        quality = _quality(straight, good, method, answer, (errors[0], errors[1]), point, share, bootstrap, seed)
        corrected = CorrectedHandEye(**quality, correction=answer.correction, terms=best)
    methods = _methods(good, method, plain)
    distances = [distance(T, plain.T_flange_camera) for T in methods.values()]
    return HandEyeResult(
        **_quality(straight, good, method, plain, outcomes["none"][1:], point, share, bootstrap, seed),
        method=method,
        methods=methods,
        spread_mm=max(distance_mm for distance_mm, _ in distances),
        spread_deg=max(deg for _, deg in distances),
        corner_sigma_px=sigma_px,
        rotation_spread_deg=spread,
        second_axis_deg=second,
        condition=condition,
        turned=tuple(bool(t) for t in turned),
        excluded=excluded,
        corrected=corrected,
        arm_held_out_mm=rms,
    )


def _quality(
    data: Measured,
    good: Measured,
    method: Method,
    answer: Answer,
    errors: tuple[Array, Array],
    point_m: Array,
    share: Array,
    bootstrap: int,
    seed: int,
) -> dict[str, Any]:
    """The fields of a HandEyeAnswer."""
    residual = deviation(data.placed(answer), answer.T_base_board, point_m)
    covariance = bootstrap_covariance(good, method, answer, bootstrap, np.random.default_rng(seed))
    if method in CLOSED_FORMS:
        covariance = not_below_held_out(covariance, *errors)
    covariance = covariance + share
    return {
        "T_flange_camera": answer.T_flange_camera,
        "T_base_board": answer.T_base_board,
        "sigma_mm": mm(float(np.sqrt(np.trace(covariance[:3, :3])))),
        "sigma_deg": deg(np.sqrt(np.trace(covariance[3:, 3:]))),
        "covariance": covariance,
        "camera_share": share,
        "formal_covariance": None if answer.fit is None else answer.fit.covariance[:6, :6],
        "robot_noise_mm": None if answer.noise is None else mm(answer.noise.robot_m),
        "robot_noise_deg": None if answer.noise is None else deg(answer.noise.robot_rad),
        "residual_mm": residual[0],
        "residual_deg": residual[1],
        "held_out_mm": errors[0],
        "held_out_deg": errors[1],
    }


def _measured(
    T_base_flange: Array,
    T_camera_board: Array,
    corners: BoardCorners | None,
    joints_rad: Array | None,
    arm: ArmModel | None,
) -> Measured:
    hands = np.asarray(T_base_flange, dtype=np.float64)
    boards = np.asarray(T_camera_board, dtype=np.float64)
    if hands.ndim != 3 or hands.shape[1:] != (4, 4) or hands.shape != boards.shape:
        raise DataError(f"robot poses {hands.shape} and board poses {boards.shape} do not match")
    if not (np.isfinite(hands).all() and np.isfinite(boards).all()):
        raise DataError("a robot pose or a board pose is not finite")
    if corners is not None and len(corners.corners_px) != len(hands):
        raise DataError(f"corners of {len(corners.corners_px)} views for {len(hands)} poses")
    joints = None if joints_rad is None else np.asarray(joints_rad, dtype=np.float64)
    if joints is not None and (joints.shape != (len(hands), 6) or not np.isfinite(joints).all()):
        raise DataError(f"joints {joints.shape} instead of ({len(hands)}, 6) finite numbers")
    return Measured(hands, boards, np.zeros((len(hands), 6, 6)), corners, joints, arm)


def _straightened(
    data: Measured, turned: NDArray[np.bool_], T_board_turned: Transform | None
) -> tuple[Measured, float | None]:
    """The views with half-turned boards turned back, their corners renumbered, and the boards' covariance."""
    boards, corners = data.boards, data.corners
    if T_board_turned is not None:
        boards = np.where(turned[:, None, None], boards @ T_board_turned, boards)
    if corners is None:
        return dataclasses.replace(data, boards=boards), None
    pixels = np.where(turned[:, None, None], corners.corners_px[:, ::-1], corners.corners_px)
    corners = BoardCorners(corners.points_m, pixels, corners.camera)
    covariance, sigma_px = board_covariance(corners, boards)
    return dataclasses.replace(data, boards=boards, corners=corners, covariance=covariance), sigma_px


def _arm_answer(
    data: Measured, keep: NDArray[np.bool_], plain: Answer, terms: ArmTerms, noise: Noise
) -> tuple[Answer, NDArray[np.bool_], Noise]:
    """The fit with the arm's errors (refitted without its own outliers), the views used, and the noise."""
    good = data.take(keep)
    answer = fit_with_arm(good, plain, terms, noise)
    wrong = arm_outliers(answer)
    if not wrong.any() or np.mean(wrong) > 0.2:
        return answer, keep, noise
    used = keep.copy()
    used[np.flatnonzero(keep)[wrong]] = False
    good = data.take(used)
    noise = arm_noise(good, plain, terms)
    return fit_with_arm(good, plain, terms, noise), used, noise


def _methods(data: Measured, method: Method, answer: Answer) -> dict[Method, Transform]:
    """T_flange_camera by every method that has an answer."""
    answers: dict[Method, Transform] = {method: answer.T_flange_camera}
    for name, T in all_closed_forms(data.hands, data.boards).items():
        answers.setdefault(name, T)
    others: tuple[Method, ...] = ("weighted", "reprojection")
    for other in others:
        if other not in answers and (other != "reprojection" or data.corners is not None):
            try:
                answers[other] = fit_method(data, other).T_flange_camera
            except ComputeError:  # these are only for comparison; one may fail
                continue
    return answers


def place_board(T_base_flange: Array, T_camera_board: Array, T_flange_camera: Transform) -> BoardPlacement:
    """Mean pose of a board in the base frame of the station that saw it.

    One board joins two stations: T_base1_base2 = T_base1_board · inverse(T_base2_board), if it has not moved in
        between.

    Raises:
        DataError: no view, or array shapes do not match.
    """
    if T_base_flange.shape != T_camera_board.shape or len(T_base_flange) == 0:
        raise DataError(f"robot poses {T_base_flange.shape} and board poses {T_camera_board.shape} do not match")
    placed = T_base_flange @ T_flange_camera @ T_camera_board
    mean = mean_pose(placed)
    residual_mm, residual_deg = deviation(placed, mean)
    n = len(placed)
    sigma = float(np.sqrt(np.sum(residual_mm**2) / max(n - 1, 1) / n))
    return BoardPlacement(mean, residual_mm, residual_deg, sigma)
