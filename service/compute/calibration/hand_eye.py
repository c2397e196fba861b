"""Estimates the camera in the flange frame and the board in the base frame, with their uncertainty."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.compute.arm_kinematics import ArmCorrection
from service.compute.calibration.board import Board
from service.compute.calibration.hand_eye_fit import (
    ArmTerms,
    HandEyeMeasurements,
    HandEyeSolution,
    Method,
    arm_is_possible,
    arm_noise,
    arm_outliers,
    find_outliers,
    fit_method,
    fit_resized,
    fit_with_arm,
    held_out,
    turned_back,
    without_size,
)
from service.compute.calibration.hand_eye_setup import (
    CLOSED_FORMS,
    PosesAsRead,
    Setup,
    all_closed_forms,
    check_setup,
    deviation,
    distance,
    inverted,
    observability,
    untwist,
)
from service.compute.calibration.hand_eye_uncertainty import (
    BoardSizeFound,
    bootstrap_counts,
    bootstrap_covariance,
    bootstrap_picks,
    camera_share,
    contradictions,
    not_below_held_out,
    size_found,
    size_sigma,
)
from service.compute.calibration.reprojection import BoardCorners, Noise, board_covariance
from service.compute.camera_model import CameraCovariance
from service.core.arms import ArmModel
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform
from service.core.units import deg, mm


@dataclass(frozen=True, slots=True)
class HandEyeAnswer:
    """T_flange_camera, T_base_board and measures of their quality; arrays are over the N views.

    Attributes:
        T_flange_camera: the calibration.
        T_base_board: the board's pose.
        sigma_mm: bootstrap standard deviation of the translation (root of the summed variances), over images.
        sigma_deg: bootstrap standard deviation of the rotation.
        covariance: (6, 6) covariance of T_flange_camera from the bootstrap, (d in metres, w in radians) in the
            flange's axes, including `camera_share`.
        camera_share: (6, 6) part of it due to the camera calibration's uncertainty, which more images do not reduce.
        formal_covariance: (6, 6) predicted by the fit's own noise model; None unless the method is weighted.
        robot_noise_mm: standard deviation per axis of the robot's remaining position error; None unless the method is
            weighted.
        robot_noise_deg: standard deviation of its orientation error; None unless the method is weighted.
        residual_mm: (N,) distance between the board as placed by each view and T_base_board, at the board's middle.
        residual_deg: (N,) angle between the two.
        held_out_mm: (N,) distance like residual_mm, but each view is judged by a calibration without its fold.
        held_out_deg: (N,) angle like residual_deg, judged in the same way.
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
        terms: the parameters that were estimated.
        size: the board's size by the lengths of the corrected arm.
    """

    correction: ArmCorrection
    terms: ArmTerms
    size: BoardSizeFound


@dataclass(frozen=True, slots=True)
class HandEyeResult(HandEyeAnswer):
    """The answer for the robot's poses as reported, and the diagnostics of the calibration.

    Attributes:
        method: method that gave T_flange_camera.
        methods: T_flange_camera by every method that gave an answer.
        spread_mm: largest distance between the chosen method's translation and another's (including Tsai's and
            Andreff's, which are the weakest: a large spread warns of weak data).
        spread_deg: largest angle between the chosen method's rotation and another's.
        corner_sigma_px: standard deviation of the corners; None if only board poses were given.
        rotation_spread_deg: largest rotation between two views.
        second_axis_deg: root mean square rotation about the second best axis.
        condition: condition number of the translation's linear system; infinite for a single rotation axis.
        turned: (N,) true if the view's board pose was rotated by half a turn.
        excluded: reason by index of each view that no fit used.
        corrected: the answer with the arm's systematic error estimated; None if no joints were given or if it does
            not lower the held-out error.
        arm_held_out_mm: root mean square of held_out_mm for each arm model that was tried ("none": the poses as
            reported).
        size: the board's size by the robot's lengths.
        findings: texts of what the measurements contradict; empty if nothing.
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
    size: BoardSizeFound
    findings: tuple[str, ...]


_FOLDS = 5
_FEW = 24  # up to this many views, use twice the folds: leaving a fifth out would change the answer
_WORTH = 0.9  # an arm's correction is used if it lowers the held-out error below this share
_MODELS: tuple[ArmTerms, ...] = ("geometry", "geometry+gears")


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeViews:
    """N views of a board, as measured.

    Attributes:
        T_base_flange: (N, 4, 4) flange poses by the robot.
        T_camera_board: (N, 4, 4) board poses by the images.
        corners: the boards' corners, from which the board poses' covariance follows; required by `reprojection`.
        joints_rad: (N, J) joints as recorded with the poses.
        arm: the arm's model, with `joints_rad`.
        board: the board as described, with the tolerance of its size; None: its size is exactly known.
        poses: the other ways to read the file of the robot's poses; None if they come from the robot itself.
    """

    T_base_flange: Array
    T_camera_board: Array
    corners: BoardCorners | None = None
    joints_rad: Array | None = None
    arm: ArmModel | None = None
    board: Board | None = None
    poses: PosesAsRead | None = None


def calibrate_hand_eye(
    views: HandEyeViews,
    *,
    method: Method = "weighted",
    T_board_turned: Transform | None = None,
    setup: Setup = "eye-in-hand",
    camera_covariance: CameraCovariance | None = None,
    bootstrap: int = 100,
    seed: int = 0,
) -> HandEyeResult:
    """Solve T_base_flange · T_flange_camera · T_camera_board = T_base_board over the views.

    `weighted`, the default, weights robot and images by the noise that the data show in each (reprojection.py). A
    closed form uses no weights, and `reprojection` attributes the robot's errors to the images. Given joints and the
    arm's model, the weighted fit also estimates the arm's systematic error and keeps it if held-out views improve.

    Args:
        views: the measurements.
        method: the one that gives the answer; the others are computed for comparison.
        T_board_turned: the half turn of a board that looks the same upside down (`half_turn`); views that were
            numbered from the other end are then turned to agree with the robot.
        setup: eye-to-hand: the camera stands beside the robot and the board is on the flange. T_base_camera and
            T_flange_board then take the places of T_flange_camera and T_base_board in the answer, and the arm's
            systematic error is not estimated.
        camera_covariance: covariance of the calibrated camera; with corners, it is added to the answer's covariance.
        bootstrap: number of resamples.
        seed: seed of the resampling and of the folds.

    Raises:
        DataError: array shapes do not match, values are not finite, or the joints are another arm's.
        ComputeError: too few views, too little rotation, rotation about one axis only, poses that do not fit the
            images (`check_setup` names the reading that does), more than a third of the images disagree with the
            robot, or the board's size differs from the given one by more than its tolerance and the uncertainty.
    """
    data, poses = _as_arrays(views), views.poses
    if setup == "eye-to-hand":
        data = dataclasses.replace(data, hands=inverted(data.hands), joints_rad=None, arm=None)
        poses = None if poses is None else poses.inverted()
    spread, second, condition = observability(data.hands)
    point = np.zeros(3) if data.corners is None else data.corners.points_m.mean(axis=0)
    check = partial(check_setup, point_m=point, setup=setup, poses=poses)
    sized = partial(_sized, views.board, bootstrap, seed)
    turns = _agreed(data, T_board_turned, method, check, sized, np.random.default_rng(seed))
    good = turns.data.take(turns.keep)
    size = sized(turns.free, turns.weighted.scale)
    if not all(np.isfinite(observability(good.hands))):
        raise ComputeError("the remaining views do not determine the answer")
    outcomes = _outcomes(turns, method, _folds(len(turns.keep), seed), point)
    rms: dict[ArmTerms, float] = {
        terms: float(np.sqrt(np.mean(o.held_out_mm[turns.keep] ** 2))) for terms, o in outcomes.items()
    }
    share = np.zeros((6, 6))
    if camera_covariance is not None and data.corners is not None:
        share = camera_share(good.resized(turns.plain.scale), camera_covariance)
    quality = partial(_quality, turns.data, point, share, partial(_bootstrap, good, method, bootstrap, seed))
    methods = _methods(good, method, turns.plain)
    distances = [distance(T, turns.plain.T_flange_camera) for T in methods.values()]
    return HandEyeResult(
        **quality(size, outcomes["none"]),
        method=method,
        methods=methods,
        spread_mm=max(distance_mm for distance_mm, _ in distances),
        spread_deg=max(deg for _, deg in distances),
        corner_sigma_px=turns.corner_sigma_px,
        rotation_spread_deg=spread,
        second_axis_deg=second,
        condition=condition,
        turned=tuple(bool(t) for t in turns.turned),
        excluded=turns.excluded,
        corrected=_corrected(outcomes, rms, partial(_with_size, good, sized, quality)),
        arm_held_out_mm=rms,
        findings=contradictions(good, turns.free),
    )


@dataclass(frozen=True, slots=True)
class _Agreed:
    """The views with half-turned boards turned back, the outliers among them, and answers without the arm's errors.

    `plain` is by the method that was asked for, `weighted` by the weighted fit, and `free` by one that knows
    nothing of the board's size.
    """

    data: HandEyeMeasurements
    turned: NDArray[np.bool_]
    corner_sigma_px: float | None
    excluded: dict[int, str]
    plain: HandEyeSolution
    weighted: HandEyeSolution
    free: HandEyeSolution

    @property
    def keep(self) -> NDArray[np.bool_]:
        """(N,) whether a view is an inlier."""
        return ~np.isin(np.arange(len(self.turned)), list(self.excluded))


@dataclass(frozen=True, slots=True)
class _Outcome:
    """An answer, and the distance (N,) of each view's board from an answer without this view."""

    answer: HandEyeSolution
    held_out_mm: Array
    held_out_deg: Array


def _agreed(
    data: HandEyeMeasurements,
    T_board_turned: Transform | None,
    method: Method,
    check: Callable[[Array, Array], None],
    sized: Callable[[HandEyeSolution, float], BoardSizeFound],
    rng: np.random.Generator,
) -> _Agreed:
    """Return the views on which robot and images agree; `check` refuses poses that do not belong together."""

    def solved(turned: NDArray[np.bool_]) -> _Agreed:
        straight, sigma_px = _straightened(data, turned, T_board_turned)
        check(straight.hands, straight.boards)
        excluded = find_outliers(straight, rng)
        keep = ~np.isin(np.arange(len(turned)), list(excluded))
        good = straight.take(keep)
        free = without_size(good)
        sized(free, free.scale)  # before a fit that believes the given size hides the difference in its noise
        weighted = fit_method(good, "weighted")
        answer = weighted if method == "weighted" else fit_resized(good, method, weighted, weighted.scale)
        return _Agreed(straight, turned, sigma_px, excluded, answer, weighted, free)

    turned = np.zeros(len(data.hands), dtype=bool)
    if T_board_turned is None:
        return solved(turned)
    first = solved(untwist(data.hands, data.boards, T_board_turned)[1])
    again = turned_back(first.data, first.plain, T_board_turned)
    # The vote of all pairs can be wrong for a view; the answer common to the others is not.
    return solved(first.turned ^ again) if again.any() else first


def _folds(n: int, seed: int) -> NDArray[np.int64]:
    """Return (n,) fold of each view."""
    count = min(_FOLDS if n > _FEW else 2 * _FOLDS, n)
    return np.random.default_rng(seed).permutation(n) % count


def _outcomes(agreed: _Agreed, method: Method, folds: NDArray[np.int64], point: Array) -> dict[ArmTerms, _Outcome]:
    """Return the answer without the arm's errors, and with each model of them that the views allow."""
    data, keep, plain = agreed.data, agreed.keep, agreed.plain
    outcomes: dict[ArmTerms, _Outcome] = {
        "none": _Outcome(plain, *held_out(data, keep, method, "none", (plain, None), folds, point))
    }
    good = data.take(keep)
    if method == "weighted" and arm_is_possible(good):
        for terms in _MODELS:
            answer, used, noise = _arm_answer(data, keep, plain, terms, arm_noise(good, plain, terms))
            errors = held_out(data, used, method, terms, (plain, noise), folds, point)
            outcomes[terms] = _Outcome(answer, *errors)
    return outcomes


def _corrected(
    outcomes: dict[ArmTerms, _Outcome], rms_mm: dict[ArmTerms, float], quality: Callable[[_Outcome], dict[str, Any]]
) -> CorrectedHandEye | None:
    """Return the answer with the arm's errors that held-out views support best; None if they do not improve."""
    best = min(rms_mm, key=lambda terms: rms_mm[terms])
    correction = outcomes[best].answer.correction
    if correction is None or rms_mm[best] >= _WORTH * rms_mm["none"]:
        return None
    return CorrectedHandEye(**quality(outcomes[best]), correction=correction, terms=best)


def _bootstrap(good: HandEyeMeasurements, method: Method, count: int, seed: int, outcome: _Outcome) -> Array:
    """Return (6, 6) covariance of T_flange_camera by resampling the views."""
    covariance = bootstrap_covariance(good, method, outcome.answer, count, np.random.default_rng(seed))
    if method in CLOSED_FORMS:
        return not_below_held_out(covariance, outcome.held_out_mm, outcome.held_out_deg)
    return covariance


def _with_size(
    good: HandEyeMeasurements,
    sized: Callable[[HandEyeSolution, float], BoardSizeFound],
    quality: Callable[[BoardSizeFound, _Outcome], dict[str, Any]],
    outcome: _Outcome,
) -> dict[str, Any]:
    """Return `quality` of an answer with the arm's errors, which shows the board's size best."""
    return quality(sized(without_size(good, outcome.answer), outcome.answer.scale), outcome)


def _sized(board: Board | None, count: int, seed: int, free: HandEyeSolution, used: float) -> BoardSizeFound:
    """Return the board's size by the robot (`size_found`). Raises ComputeError if it is not credible."""
    assert free.views is not None
    n = len(free.views.T_base_flange)
    counts = bootstrap_counts(bootstrap_picks(n, count, np.random.default_rng(seed)), n)
    size = size_found(free, used, board, counts)
    size.require_credible()
    return size


def _quality(
    data: HandEyeMeasurements,
    point_m: Array,
    share: Array,
    resampled: Callable[[_Outcome], Array],
    size: BoardSizeFound,
    outcome: _Outcome,
) -> dict[str, Any]:
    """Return the fields of a HandEyeAnswer."""
    answer = outcome.answer
    residual = deviation(data.placed(answer), answer.T_base_board, point_m)
    covariance = resampled(outcome) + share
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
        "held_out_mm": outcome.held_out_mm,
        "held_out_deg": outcome.held_out_deg,
        "size": size,
    }


def _as_arrays(views: HandEyeViews) -> HandEyeMeasurements:
    """Return the views as arrays whose shapes agree."""
    corners = views.corners
    hands = np.asarray(views.T_base_flange, dtype=np.float64)
    boards = np.asarray(views.T_camera_board, dtype=np.float64)
    if hands.ndim != 3 or hands.shape[1:] != (4, 4) or hands.shape != boards.shape:
        raise DataError(f"robot poses {hands.shape} and board poses {boards.shape} do not match")
    if not (np.isfinite(hands).all() and np.isfinite(boards).all()):
        raise DataError("a robot pose or a board pose is not finite")
    if corners is not None and len(corners.corners_px) != len(hands):
        raise DataError(f"corners of {len(corners.corners_px)} views for {len(hands)} poses")
    joints = None if views.joints_rad is None else np.asarray(views.joints_rad, dtype=np.float64)
    if joints is not None:
        axes = joints.shape[-1] if views.arm is None else views.arm.axes
        if joints.shape != (len(hands), axes) or not np.isfinite(joints).all():
            raise DataError(f"joints {joints.shape} instead of ({len(hands)}, {axes}) finite numbers")
    sigma = 0.0 if views.board is None else size_sigma(views.board.size_tolerance)
    return HandEyeMeasurements(hands, boards, np.zeros((len(hands), 6, 6)), corners, joints, views.arm, sigma)


def _straightened(
    data: HandEyeMeasurements, turned: NDArray[np.bool_], T_board_turned: Transform | None
) -> tuple[HandEyeMeasurements, float | None]:
    """Return the views with half-turned boards turned back, their corners renumbered, and the boards' covariance."""
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
    data: HandEyeMeasurements, keep: NDArray[np.bool_], plain: HandEyeSolution, terms: ArmTerms, noise: Noise
) -> tuple[HandEyeSolution, NDArray[np.bool_], Noise]:
    """Return the fit with the arm's errors (refitted without its own outliers), the views used, and the noise."""
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


def _methods(data: HandEyeMeasurements, method: Method, answer: HandEyeSolution) -> dict[Method, Transform]:
    """Return T_flange_camera by every method that has an answer."""
    answers: dict[Method, Transform] = {method: answer.T_flange_camera}
    resized = data.resized(answer.scale)
    for name, T in all_closed_forms(resized.hands, resized.boards).items():
        answers.setdefault(name, T)
    others: tuple[Method, ...] = ("weighted", "reprojection")
    for other in others:
        if other not in answers and (other != "reprojection" or data.corners is not None):
            try:
                answers[other] = fit_method(data, other).T_flange_camera
            except ComputeError:  # these are only for comparison; one may fail
                continue
    return answers
