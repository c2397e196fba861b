"""Hand-eye calibration: the camera in the flange frame and the board in the base frame, with honest errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, inverse, rotation_angle_rad, transform

Method = Literal["park", "daniilidis", "tsai", "horaud", "andreff"]

_METHODS: dict[Method, int] = {
    "park": cv2.CALIB_HAND_EYE_PARK,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
    "tsai": cv2.CALIB_HAND_EYE_TSAI,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
}
_MIN_VIEWS = 6
_MIN_ROTATION_DEG = 15.0  # largest rotation between two views
_MIN_SECOND_AXIS_DEG = 4.0  # root mean square rotation about the second best axis
_FOLDS = 5


@dataclass(frozen=True, slots=True)
class HandEyeResult:
    """T_flange_camera and what tells whether to trust it; arrays are over the N views.

    Attributes:
        T_flange_camera: the calibration.
        T_base_board: where the board lay (mean over the views).
        method: of T_flange_camera.
        methods: T_flange_camera by every method that gave an answer.
        spread_mm: largest distance of another method's translation from the chosen one's (Tsai's and Andreff's
            included, which are the weakest: a large spread warns of a weak data set).
        spread_deg: the same for the rotation.
        sigma_mm: bootstrap standard deviation of the translation (root of the summed variances), over images.
        sigma_deg: bootstrap standard deviation of the rotation.
        residual_mm: (N,) how far the board, placed by each view, is from its mean place.
        residual_deg: (N,) the same for its orientation.
        held_out_mm: (N,) as residual_mm, but each view judged by a calibration without its fold.
        held_out_deg: (N,).
        rotation_spread_deg: largest rotation between two views.
        second_axis_deg: root mean square rotation about the second best axis.
        condition: of the translation's linear system; one rotation axis makes it infinite.
        turned: (N,) views whose board pose was turned by half a turn.
    """

    T_flange_camera: Transform
    T_base_board: Transform
    method: Method
    methods: dict[Method, Transform]
    spread_mm: float
    spread_deg: float
    sigma_mm: float
    sigma_deg: float
    residual_mm: Array
    residual_deg: Array
    held_out_mm: Array
    held_out_deg: Array
    rotation_spread_deg: float
    second_axis_deg: float
    condition: float
    turned: tuple[bool, ...]


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
    method: Method = "park",
    T_board_turned: Transform | None = None,
    bootstrap: int = 60,
    seed: int = 0,
) -> HandEyeResult:
    """Solve T_base_flange · T_flange_camera · T_camera_board = constant over the views.

    Source: Park and Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group", IEEE TRA 10(5),
    1994, as OpenCV implements it; it is the least disturbed by an arm whose kinematics are slightly wrong.

    Args:
        T_base_flange: (N, 4, 4) from the robot.
        T_camera_board: (N, 4, 4) from the images.
        method: which of OpenCV's methods gives the answer; all others are computed for comparison.
        T_board_turned: the half turn of a board that looks the same upside down (`intrinsics.half_turn`); views
            that were numbered from the other end are then turned so that they agree with the robot.
        bootstrap: number of resamples.
        seed: of the resampling and of the folds.

    Raises:
        DataError: arrays that do not belong together, or are not finite.
        ComputeError: too few views, too little rotation, or rotation about one axis only.
    """
    hands = np.asarray(T_base_flange, dtype=np.float64)
    boards = np.asarray(T_camera_board, dtype=np.float64)
    if hands.ndim != 3 or hands.shape[1:] != (4, 4) or hands.shape != boards.shape:
        raise DataError(f"robot poses {hands.shape} and board poses {boards.shape} do not belong together")
    if not (np.isfinite(hands).all() and np.isfinite(boards).all()):
        raise DataError("a robot pose or a board pose is not finite")
    spread, second, condition = _observability(hands)
    turned = np.zeros(len(hands), dtype=bool)
    if T_board_turned is not None:
        boards, turned = _untwist(hands, boards, T_board_turned)
    X = _solve(hands, boards, method)
    base_board = _mean_pose(hands @ X @ boards)
    residual = _deviation(hands @ X @ boards, base_board)
    methods = _all_methods(hands, boards, {method: X})
    distances = [_distance(T, X) for T in methods.values()]
    sigma = _bootstrap(hands, boards, method, X, bootstrap, np.random.default_rng(seed))
    held_out = _held_out(hands, boards, method, np.random.default_rng(seed))
    return HandEyeResult(
        X,
        base_board,
        method,
        methods,
        max(mm for mm, _ in distances),
        max(deg for _, deg in distances),
        *sigma,
        *residual,
        *held_out,
        spread,
        second,
        condition,
        tuple(bool(t) for t in turned),
    )


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
    mean = _mean_pose(placed)
    residual_mm, residual_deg = _deviation(placed, mean)
    n = len(placed)
    sigma = float(np.sqrt(np.sum(residual_mm**2) / max(n - 1, 1) / n))
    return BoardPlacement(mean, residual_mm, residual_deg, sigma)


def _observability(hands: Array) -> tuple[float, float, float]:
    """Largest relative rotation, RMS rotation about the second axis (both degrees), and the condition number.

    Raises:
        ComputeError: the translation cannot be determined from these rotations.
    """
    n = len(hands)
    if n < _MIN_VIEWS:
        raise ComputeError(
            f"{n} views for the hand-eye calibration, at least {_MIN_VIEWS} are needed",
            remedy="take more board images",
        )
    i, j = np.triu_indices(n, 1)
    relative = np.swapaxes(hands[i, :3, :3], 1, 2) @ hands[j, :3, :3]
    vectors = Rotation.from_matrix(relative).as_rotvec()
    spread = float(np.degrees(np.linalg.norm(vectors, axis=1).max()))
    axes = np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(vectors.T @ vectors / len(vectors)), 0)))
    second = float(axes[1])
    if spread < _MIN_ROTATION_DEG:
        raise ComputeError(
            f"the flange turned by {spread:.1f}° at most, {_MIN_ROTATION_DEG:.0f}° are needed",
            remedy="tilt the camera to several sides of the board, 40° or more in all",
        )
    if second < _MIN_SECOND_AXIS_DEG:
        raise ComputeError(
            f"the flange turned about one axis only ({axes[2]:.1f}° about it, {second:.1f}° about any other): "
            "the camera's position along this axis is undetermined",
            remedy="tilt the camera about a second axis too",
        )
    system = (np.eye(3) - relative).reshape(-1, 3)
    return spread, second, float(np.linalg.cond(system))


def _untwist(hands: Array, boards: Array, T_board_turned: Transform) -> tuple[Array, NDArray[np.bool_]]:
    """Turn the views that were numbered from the board's other end, so that all agree with the robot.

    Between two views the flange and the camera must turn by the same angle. Which choice fits each pair better
    gives a signed graph; its leading eigenvector splits the views in two groups, and the larger one is kept.
    """
    n = len(hands)
    turned = boards @ T_board_turned
    vote = np.zeros((n, n))
    for i in range(n):
        arm = _angles(np.swapaxes(hands[i : i + 1, :3, :3], 1, 2) @ hands[:, :3, :3])
        same = _angles(boards[i, :3, :3] @ np.swapaxes(boards[:, :3, :3], 1, 2))
        other = _angles(boards[i, :3, :3] @ np.swapaxes(turned[:, :3, :3], 1, 2))
        vote[i] = np.clip(np.abs(arm - other) - np.abs(arm - same), -0.2, 0.2)
    np.fill_diagonal(vote, 0.0)
    leading = np.linalg.eigh(vote + vote.T)[1][:, -1]
    flip = leading < 0 if np.count_nonzero(leading < 0) * 2 <= n else leading >= 0
    return np.where(flip[:, None, None], turned, boards), flip


def _angles(rotations: Array) -> Array:
    return np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))


def _solve(hands: Array, boards: Array, method: Method) -> Transform:
    # By keyword: a fifth positional argument of calibrateHandEye silently means something else.
    R, t = cv2.calibrateHandEye(
        R_gripper2base=list(hands[:, :3, :3]),
        t_gripper2base=list(hands[:, :3, 3]),
        R_target2cam=list(boards[:, :3, :3]),
        t_target2cam=list(boards[:, :3, 3]),
        method=_METHODS[method],
    )
    rotation, translation = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel()
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise ComputeError(f"hand-eye calibration by {method} has no answer", remedy="take views with more rotation")
    return transform(rotation, translation)


def _all_methods(hands: Array, boards: Array, known: dict[Method, Transform]) -> dict[Method, Transform]:
    answers = dict(known)
    for method in _METHODS:
        if method not in answers:
            try:
                answers[method] = _solve(hands, boards, method)
            except (cv2.error, ComputeError):  # a comparison that fails is no reason to lose the answer
                continue
    return answers


def _mean_pose(poses: Array) -> Transform:
    return transform(Rotation.from_matrix(poses[:, :3, :3]).mean(), poses[:, :3, 3].mean(axis=0))


def _deviation(poses: Array, mean: Transform) -> tuple[Array, Array]:
    """Distance in mm and angle in degrees of poses (N, 4, 4) from `mean`."""
    offset = inverse(mean) @ poses
    angle = Rotation.from_matrix(offset[:, :3, :3]).magnitude()
    return np.linalg.norm(offset[:, :3, 3], axis=1) * 1e3, np.degrees(angle)


def _distance(a: Transform, b: Transform) -> tuple[float, float]:
    offset = inverse(a) @ b
    return float(np.linalg.norm(offset[:3, 3]) * 1e3), float(np.degrees(rotation_angle_rad(offset)))


def _bootstrap(
    hands: Array, boards: Array, method: Method, X: Transform, count: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Spread over resamples of whole images: holds for systematic errors that differ between poses too."""
    shifts: list[Array] = []
    turns: list[Array] = []
    for _ in range(count):
        pick = rng.integers(0, len(hands), len(hands))
        if len(np.unique(pick)) < 4:
            continue
        offset = inverse(X) @ _solve(hands[pick], boards[pick], method)
        shifts.append(offset[:3, 3])
        turns.append(Rotation.from_matrix(offset[:3, :3]).as_rotvec())
    if len(shifts) < 2:
        return float("nan"), float("nan")
    shift_mm = np.sqrt(np.var(np.array(shifts), axis=0, ddof=1).sum()) * 1e3
    return float(shift_mm), float(np.degrees(np.sqrt(np.var(np.array(turns), axis=0, ddof=1).sum())))


def _held_out(hands: Array, boards: Array, method: Method, rng: np.random.Generator) -> tuple[Array, Array]:
    n = len(hands)
    fold = rng.permutation(n) % min(_FOLDS, n)
    mm, deg = np.zeros(n), np.zeros(n)
    for k in range(int(fold.max()) + 1):
        test, train = fold == k, fold != k
        X = _solve(hands[train], boards[train], method)
        place = _mean_pose(hands[train] @ X @ boards[train])
        mm[test], deg[test] = _deviation(hands[test] @ X @ boards[test], place)
    return mm, deg
