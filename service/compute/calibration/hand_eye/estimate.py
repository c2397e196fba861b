"""Hand-eye calibration: the camera in the flange frame and the board in the base frame, with honest errors."""

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
_FEW = 24  # up to so many views twice the folds: a fifth less would change the answer
_WORTH = 0.9  # an arm's correction is used when the held-out error falls below this share


@dataclass(frozen=True, slots=True)
class HandEyeAnswer:
    """T_flange_camera, T_base_board and what tells whether to trust them; arrays are over the N views.

    Attributes:
        T_flange_camera: the calibration.
        T_base_board: where the board lay.
        sigma_mm: bootstrap standard deviation of the translation (root of the summed variances), over images.
        sigma_deg: bootstrap standard deviation of the rotation.
        covariance: (6, 6) of T_flange_camera by the bootstrap: (d in metres, w in radians) in the flange's axes; with
            the camera's share.
        camera_share: (6, 6) of it, from what is not known of the camera: no number of images makes it smaller.
        formal_covariance: (6, 6) as the fit's own noise model predicts it; None unless the method is weighted.
        robot_noise_mm: standard deviation for each axis of what is left of the robot's position error; None
            unless the method is weighted, as the next.
        robot_noise_deg: of its rotation.
        residual_mm: (N,) how far the board, placed by each view, is from its place, at the board's middle.
        residual_deg: (N,) the same for its orientation.
        held_out_mm: (N,) as residual_mm, but each view judged by a calibration without its fold.
        held_out_deg: (N,).
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
    """The answer that goes with poses corrected by `correction` (`corrected_T_base_flange`).

    Attributes:
        correction: the arm's systematic error.
        terms: which of its parameters were estimated.
    """

    correction: ArmCorrection
    terms: ArmTerms


@dataclass(frozen=True, slots=True)
class HandEyeResult(HandEyeAnswer):
    """The answer that goes with the robot's poses as it reports them, and all that was learnt on the way.

    Attributes:
        method: of T_flange_camera.
        methods: T_flange_camera by every method that gave an answer.
        spread_mm: largest distance of another method's translation from the chosen one's (Tsai's and Andreff's
            included, which are the weakest: a large spread warns of a weak data set).
        spread_deg: the same for the rotation.
        corner_sigma_px: noise of the corners; None if only board poses were given.
        rotation_spread_deg: largest rotation between two views.
        second_axis_deg: root mean square rotation about the second best axis.
        condition: of the translation's linear system; one rotation axis makes it infinite.
        turned: (N,) views whose board pose was turned by half a turn.
        excluded: views that no fit used, with the reason.
        corrected: the answer with the arm's systematic error estimated; None if no joints were given or it does not
            pay on held-out views.
        arm_held_out_mm: root mean square of held_out_mm for each model of the arm that was tried ("none" is the
            arm as it reports itself).
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
        residual_mm: (N,) distance of each view's board origin from it.
        residual_deg: (N,).
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

    `weighted`, the default, weighs robot and images by the noise that the data show in each (weighted.py); a closed
    form weighs nothing, and `reprojection` blames the images for the robot's errors. With joints and the arm's model,
    the weighted fit also estimates the arm's systematic error and keeps it when held-out views say that it gains.

    Args:
        T_base_flange: (N, 4, 4) from the robot.
        T_camera_board: (N, 4, 4) from the images.
        method: which one gives the answer; the others are computed for comparison.
        corners: the boards' corners: gives the board poses' covariance; `reprojection` cannot do without.
        joints_rad: (N, 6) as recorded with the poses.
        arm: model of the arm, with `joints_rad`.
        T_board_turned: the half turn of a board that looks the same upside down (`half_turn`); views that were
            numbered from the other end are then turned so that they agree with the robot.
        setup: eye-to-hand: the camera stands beside the robot and the board hangs on the flange. Then T_flange_camera
            and T_flange_board change places with T_base_camera and T_base_board: the answer's T_flange_camera is
            T_base_camera, its T_base_board is T_flange_board. The arm's own error is not estimated then.
        camera_covariance: how well the camera of the corners is known; added to the answer's, with `corners`.
        bootstrap: number of resamples.
        seed: of the resampling and of the folds.

    Raises:
        DataError: arrays that do not belong together, or are not finite; joints of another arm.
        ComputeError: too few views, too little rotation, rotation about one axis only, poses that do not fit the
            images (`check_setup` says which reading of them does), or more than a third of the images in
            disagreement with the robot.
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
        # The vote of all pairs can err for a view; its neighbours' common answer does not.
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
        raise DataError(f"robot poses {hands.shape} and board poses {boards.shape} do not belong together")
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
    """The fit with the arm's errors; views that only it shows to be wrong have no say in it."""
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
            except ComputeError:  # a comparison that fails is no reason to lose the answer
                continue
    return answers


def place_board(T_base_flange: Array, T_camera_board: Array, T_flange_camera: Transform) -> BoardPlacement:
    """The board in the base frame of the station that saw it; two stations are joined through one board.

    T_base1_base2 = T_base1_board · inverse(T_base2_board), if the board has not moved in between.

    Raises:
        DataError: no view, or arrays that do not belong together.
    """
    if T_base_flange.shape != T_camera_board.shape or len(T_base_flange) == 0:
        raise DataError(
            f"robot poses {T_base_flange.shape} and board poses {T_camera_board.shape} do not belong together"
        )
    placed = T_base_flange @ T_flange_camera @ T_camera_board
    mean = mean_pose(placed)
    residual_mm, residual_deg = deviation(placed, mean)
    n = len(placed)
    sigma = float(np.sqrt(np.sum(residual_mm**2) / max(n - 1, 1) / n))
    return BoardPlacement(mean, residual_mm, residual_deg, sigma)
