"""Hand-eye in closed form (OpenCV's five methods), observability from the motion, and half-turned boards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, inverse, rotation_angle_rad, transform
from service.core.units import deg, mm

ClosedForm = Literal["park", "daniilidis", "tsai", "horaud", "andreff"]

CLOSED_FORMS: dict[ClosedForm, int] = {
    "park": cv2.CALIB_HAND_EYE_PARK,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
    "tsai": cv2.CALIB_HAND_EYE_TSAI,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
}
MIN_VIEWS = 6
_MIN_ROTATION_DEG = 15.0  # largest rotation between two views
_MIN_SECOND_AXIS_DEG = 4.0  # root mean square rotation about the second best axis
_SUBSETS, _SUBSET_SIZE = 24, 8
_SPOILT = 2.0  # times larger median deviation: leaving the worst quarter out has not helped
_FAR_BETTER = 3.0  # times smaller misfit without the stated size
_USUAL_NOISE_M = 1e-3  # of an arm, to weigh the stated size of the board against the views


def solve_closed_form(hands: Array, boards: Array, method: ClosedForm) -> Transform:
    """T_flange_camera from poses T_base_flange and T_camera_board, both (N, 4, 4), N ≥ 3.

    Source: Park and Martin 1994, Daniilidis 1999, Tsai and Lenz 1989, Horaud and Dornaika 1995, Andreff et al. 1999,
    as OpenCV implements them.

    Raises:
        ComputeError: the answer is not finite.
    """
    # Arguments by keyword: a fifth positional argument of calibrateHandEye is silently taken as an output array.
    R, t = cv2.calibrateHandEye(
        R_gripper2base=list(hands[:, :3, :3]),
        t_gripper2base=list(hands[:, :3, 3]),
        R_target2cam=list(boards[:, :3, :3]),
        t_target2cam=list(boards[:, :3, 3]),
        method=CLOSED_FORMS[method],
    )
    rotation, translation = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel()
    # Andreff's answer is a rotation only for exact data.
    U, scale, Vt = np.linalg.svd(np.nan_to_num(rotation))
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()) or scale[2] < 0.1:
        raise ComputeError(f"hand-eye calibration by {method} has no answer", remedy="Take views with more rotation")
    return transform(U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt, translation)


def all_closed_forms(hands: Array, boards: Array) -> dict[ClosedForm, Transform]:
    """T_flange_camera by every method that gives an answer."""
    answers: dict[ClosedForm, Transform] = {}
    for method in CLOSED_FORMS:
        try:
            answers[method] = solve_closed_form(hands, boards, method)
        except (cv2.error, ComputeError):  # these are only for comparison; one may fail
            continue
    return answers


def observability(hands: Array) -> tuple[float, float, float]:
    """Largest relative rotation and RMS rotation about the second best axis (degrees), and the condition number.

    Raises:
        ComputeError: these rotations do not determine the translation.
    """
    n = len(hands)
    if n < MIN_VIEWS:
        raise ComputeError(
            f"{n} views for the hand-eye calibration, at least {MIN_VIEWS} are needed",
            remedy="Take more board images",
        )
    i, j = np.triu_indices(n, 1)
    relative = np.swapaxes(hands[i, :3, :3], 1, 2) @ hands[j, :3, :3]
    vectors = Rotation.from_matrix(relative).as_rotvec()
    spread = deg(np.linalg.norm(vectors, axis=1).max())
    axes = np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(vectors.T @ vectors / len(vectors)), 0)))
    second = float(axes[1])
    if spread < _MIN_ROTATION_DEG:
        raise ComputeError(
            f"the flange turned by {spread:.1f}° at most, {_MIN_ROTATION_DEG:.0f}° are needed",
            remedy="Tilt the camera to several sides of the board, 40° or more in all",
        )
    if second < _MIN_SECOND_AXIS_DEG:
        raise ComputeError(
            f"the flange turned about one axis only ({axes[2]:.1f}° about it, {second:.1f}° about any other): "
            "the camera's position along this axis is undetermined",
            remedy="Tilt the camera about a second axis too",
        )
    system = (np.eye(3) - relative).reshape(-1, 3)
    return spread, second, float(np.linalg.cond(system))


def untwist(hands: Array, boards: Array, T_board_turned: Transform) -> tuple[Array, NDArray[np.bool_]]:
    """Correct the views whose board corners were numbered from the other end, so that all views agree with the robot.

    Between two views, flange and camera must rotate by the same angle. Which orientation fits each pair better gives
    a signed graph; its leading eigenvector splits the views into two groups, and the larger one is kept as it is.
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


@dataclass(frozen=True, slots=True)
class RobustStart:
    """T_flange_camera, T_base_board and the board's scale (true size over the stated one)."""

    T_flange_camera: Transform
    T_base_board: Transform
    scale: float

    def placed(self, hands: Array, boards: Array) -> Array:
        """(N, 4, 4) T_base_board from each view alone."""
        return hands @ self.T_flange_camera @ scaled(boards, self.scale)


def scaled(boards: Array, scale: float) -> Array:
    """Board poses (N, 4, 4) in the images of a board that is `scale` times as large as they were computed for."""
    out = boards.copy()
    out[:, :3, 3] *= scale
    return out


def solve_with_scale(hands: Array, boards: Array) -> RobustStart:
    """Park's rotation, which no scale changes, and the positions with the board's scale by linear least squares.

    The stated size counts as one measurement with an error of 100 %, so that views that do not determine the scale
    leave it where it is; if the views fit far better without it, as with lengths in another unit, it does not count.
    """
    R = solve_closed_form(hands, boards, "park")[:3, :3]
    n = len(hands)
    system, right = np.zeros((3 * n + 1, 7)), np.zeros(3 * n + 1)
    system[:-1, :3] = hands[:, :3, :3].reshape(-1, 3)
    system[:-1, 3:6] = np.tile(-np.eye(3), (n, 1))
    system[:-1, 6] = np.einsum("nij,nj->ni", hands[:, :3, :3] @ R, boards[:, :3, 3]).ravel()
    right[:-1] = -hands[:, :3, 3].ravel()
    system[-1, 6] = right[-1] = _USUAL_NOISE_M
    shift = np.linalg.lstsq(system, right)[0]
    free = np.linalg.lstsq(system[:-1], right[:-1])[0]
    misfit = [float(np.linalg.norm(system[:-1] @ answer - right[:-1])) for answer in (shift, free)]
    if free[6] > 0 and _FAR_BETTER * misfit[1] < misfit[0]:
        shift = free
    X, scale = transform(R, np.asarray(shift[:3], dtype=np.float64)), float(shift[6])
    return RobustStart(X, mean_pose(hands @ X @ scaled(boards, scale)), scale)


def robust_start(hands: Array, boards: Array, rng: np.random.Generator) -> RobustStart:
    """The answer of the subset of views that fits half of all views best.

    Least median of squares over random subsets (Rousseeuw 1984) and all views, so that a few wrong poses have no
    influence.
    """
    n = len(hands)
    picks = [np.arange(n)]
    picks += [rng.choice(n, min(_SUBSET_SIZE, n), replace=False) for _ in range(_SUBSETS if n > _SUBSET_SIZE else 0)]
    best: tuple[float, Array, RobustStart] | None = None
    for pick in picks:
        try:
            found = solve_with_scale(hands[pick], boards[pick])
        except (cv2.error, ComputeError):
            continue
        if found.scale <= 0:  # no board has a negative size
            continue
        placed = found.placed(hands, boards)
        mm, _ = deviation(placed, mean_pose(placed[pick]))
        median = float(np.median(mm)) / max(found.scale, 1e-9)  # a board of no size fits everywhere
        if best is None or median < best[0]:
            best = (median, mm, found)
    if best is None:
        raise ComputeError("hand-eye calibration has no answer", remedy="Take views with more rotation")
    keep = np.argsort(best[1], kind="stable")[: max(MIN_VIEWS, (3 * n) // 4)]
    try:
        refined = solve_with_scale(hands[keep], boards[keep])
    except (cv2.error, ComputeError):
        return best[2]
    # Of few views of an arm that errs, the one left out may be the only one that was turned far.
    mm, _ = deviation(refined.placed(hands, boards), refined.T_base_board)
    spoilt = refined.scale <= 0 or float(np.median(mm)) / refined.scale > _SPOILT * best[0]
    return best[2] if spoilt else refined


def mean_pose(poses: Array) -> Transform:
    """Mean position and mean rotation of poses (N, 4, 4)."""
    return transform(Rotation.from_matrix(poses[:, :3, :3]).mean(), poses[:, :3, 3].mean(axis=0))


def deviation(poses: Array, mean: Transform, point_m: Array | None = None) -> tuple[Array, Array]:
    """Distance in mm (of the origin, or of a point (3,) in the poses' frame) and angle in degrees from `mean`."""
    offset = inverse(mean) @ poses
    angle = Rotation.from_matrix(offset[:, :3, :3]).magnitude()
    point = np.zeros(3) if point_m is None else point_m
    moved = offset[:, :3, :3] @ point + offset[:, :3, 3] - point
    return mm(np.linalg.norm(moved, axis=1)), np.degrees(angle)


def distance(a: Transform, b: Transform) -> tuple[float, float]:
    """Distance in mm and angle in degrees between two poses."""
    offset = inverse(a) @ b
    return mm(float(np.linalg.norm(offset[:3, 3]))), deg(rotation_angle_rad(offset))


def _angles(rotations: Array) -> Array:
    return np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))
