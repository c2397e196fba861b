"""Says how far to trust a hand-eye answer: its spread over images, the board's size by the robot's lengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import Board, BoardView
from service.compute.calibration.hand_eye_fit import HandEyeMeasurements, HandEyeSolution, Method, fit_resized
from service.compute.calibration.hand_eye_setup import CLOSED_FORMS, solve_closed_form
from service.compute.calibration.intrinsics_adjustment import fit_pose, pose_matrix
from service.compute.calibration.reprojection import BoardCorners, prior_share, resample, resample_reprojection
from service.compute.camera_model import CameraCovariance, CameraModel
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform
from service.core.units import deg, metres, mistaken_length, mm

_MIN_DISTINCT = 4  # distinct views in a bootstrap replicate


def bootstrap_covariance(
    data: HandEyeMeasurements, method: Method, answer: HandEyeSolution, count: int, rng: np.random.Generator
) -> Array:
    """Return (6, 6) covariance of T_flange_camera from resampling whole images.

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
    """Draw up to `count` times n views with replacement; draws of too few different views are left out."""
    picks = [rng.integers(0, n, n) for _ in range(count)]
    return [pick for pick in picks if len(np.unique(pick)) >= _MIN_DISTINCT]


def bootstrap_counts(picks: Sequence[NDArray[np.int64]], n: int) -> Array:
    """Return (R, n) how often each view counts in each draw."""
    return np.array([np.bincount(pick, minlength=n) for pick in picks], dtype=np.float64)


def _resized_share(data: HandEyeMeasurements, method: Method, answer: HandEyeSolution) -> Array:
    """Return (6, 6) covariance of T_flange_camera due to the board's uncertain scale, for an unweighted method."""
    other = fit_resized(data, method, answer, answer.scale + answer.scale_sigma)
    step = _increment(other.T_flange_camera, answer.T_flange_camera)
    return np.outer(step, step)


def _increment(after: Transform, before: Transform) -> Array:
    """Return (6,) shift in metres and turn in radians, in the outer axes."""
    turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
    return np.concatenate([after[:3, 3] - before[:3, 3], turn])


def camera_share(data: HandEyeMeasurements, known: CameraCovariance) -> Array:
    """Return (6, 6) covariance of T_flange_camera due to the camera calibration's uncertainty, common to all images.

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
    """Return T_camera_board of one view refined with another camera, starting from T."""
    seen = np.flatnonzero(np.isfinite(corners.corners_px[index]).all(axis=1))
    view = BoardView(seen, corners.corners_px[index][seen])
    start = np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])
    return pose_matrix(fit_pose(view, corners.points_m, camera, start)[0])


def not_below_held_out(covariance: Array, held_out_mm: Array, held_out_deg: Array) -> Array:
    """Return the covariance (6, 6) with translation and rotation each scaled up to what held-out images require.

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


# The board's size by the robot's lengths: its ratio to the given size, whether that is credible, and what it
# means.
#
# The given size of a board scales the camera's distance from it. The robot is the second ruler: it moves by known
# lengths between the images. Where the two differ by more than the board's tolerance and the uncertainty of the
# comparison, one of them is wrong, and a fit would hide the difference in the camera's position.


_RULER = 3e-4  # relative error of the lengths of an arm that was not measured
_SURE = 3.0  # standard deviations
_UNEXPLAINED = 4.0  # times as much scatter in position as the rotations explain
_USUAL_M = 1.5e-3  # along each axis; joints of which one errs more than the others reach this in position alone
_LIKE = 0.05  # relative difference up to which a ratio counts as a known one
#: Ratios of true to given size that mistakes other than of the unit lead to.
_KNOWN: tuple[tuple[float, str], ...] = (
    (2.0, "the distance of two rows of circles, or half a square, given for the whole has this ratio"),
    (0.5, "the distance of two circles in a row, or two squares, given for one has this ratio"),
    (4 / 3, "the side of a marker given for that of its square has this ratio"),
    (0.75, "the side of a square given for that of its marker has this ratio"),
)
_PRINTED = (0.85, 1.18)  # A4 on Letter and back, and the printers' "fit to page"


@dataclass(frozen=True, slots=True)
class BoardSizeFound:
    """The board's true size over the given one, as the robot's lengths show it.

    Attributes:
        ratio: the ratio by robot and images alone.
        sigma: standard deviation of `ratio`, without that of the robot's own lengths.
        tolerance: the board's given tolerance: the largest relative error of its size.
        used: the ratio used in the answer: `ratio` and the given size, weighted.
        square_m: the given side of a square; None if none was given.
    """

    ratio: float
    sigma: float
    tolerance: float
    used: float
    square_m: float | None

    @property
    def credible(self) -> bool:
        """True if the difference lies within tolerance, uncertainty and the arm's own lengths."""
        return abs(self.ratio - 1) <= _SURE * float(np.hypot(self.sigma, _RULER)) + self.tolerance

    @property
    def words(self) -> str:
        """`the squares are 14.50 ± 0.01 mm by the robot, 15 were given`."""
        if self.square_m is None:
            return f"by the robot the board is {self.ratio:.4f} ± {self.sigma:.4f} times as large as stated"
        found, spread = mm(self.ratio * self.square_m), mm(self.sigma * self.square_m)
        digits = int(np.clip(1 - np.floor(np.log10(max(spread, 1e-9))), 2, 5))
        given = f"{mm(self.square_m):g} were given"
        return f"the squares are {found:.{digits}f} ± {spread:.{digits}f} mm by the robot, {given}"

    def require_credible(self) -> None:
        """Raise ComputeError, with the ratio's likely cause, unless the size is credible."""
        if self.credible:
            return
        likely = _likely(self.ratio)
        raise ComputeError(
            f"{self.words} (ratio {self.ratio:.4f}{likely}); the board's tolerance is {100 * self.tolerance:.2g} %",
            remedy="Measure ten squares with a ruler and give their true size; if it is right, check that the "
            "robot's positions are in the stated unit and that its model is the mounted arm",
        )


def _likely(ratio: float) -> str:
    unit = mistaken_length(ratio, _LIKE)
    if unit:
        return f": {unit} have this ratio"
    for known, words in _KNOWN:
        if abs(ratio / known - 1) < _LIKE:
            return f": {words}"
    low, high = _PRINTED
    return ": a printer that fits pages to paper does this" if low < ratio < high else ""


def size_sigma(tolerance: float) -> float:
    """Return the standard deviation of a size whose error is anything within a tolerance."""
    return tolerance / float(np.sqrt(3))


def size_found(free: HandEyeSolution, used: float, board: Board | None, counts: Array) -> BoardSizeFound:
    """Compute the board's size by robot and images alone.

    Args:
        free: answer of the weighted fit that knows nothing of the board's size.
        used: the board's scale in the answer that weighs the given size too.
        board: the board as described; None: its size is exactly known.
        counts: (R, N) how often each view counts in each replicate of a bootstrap.
    """
    assert free.views is not None
    assert free.noise is not None
    assert free.fit is not None
    scatter = float(np.std(resample(free.views, free.noise, free.fit, counts)[:, 12])) if len(counts) > 1 else 0.0
    tolerance, square_m = (0.0, None) if board is None else (board.size_tolerance, board.square_m)
    return BoardSizeFound(free.scale, max(scatter, free.scale_sigma), tolerance, used, square_m)


def contradictions(data: HandEyeMeasurements, answer: HandEyeSolution) -> tuple[str, ...]:
    """Describe how robot and images contradict each other, though they agree on the board's size.

    An arm errs by its joints' angles, so its positions err by no more than its rotations do at the length of the arm.
    Positions that scatter more than that contradict the images in another way.
    """
    assert answer.noise is not None
    reach_m = float(np.median(np.linalg.norm(data.hands[:, :3, 3], axis=1)))
    images_rad = float(np.sqrt(np.median(np.trace(data.covariance[:, 3:, 3:], axis1=1, axis2=2)) / 3))
    explained_m = reach_m * float(np.hypot(answer.noise.robot_rad, images_rad))
    least_m = max(_UNEXPLAINED * explained_m, _USUAL_M)
    if answer.noise.robot_m <= least_m:
        return ()
    return (
        f"the robot's positions scatter by {mm(answer.noise.robot_m):.2f} mm along each axis, its rotations only by "
        f"{deg(answer.noise.robot_rad):.4f}° (at its reach {mm(explained_m):.2f} mm): look for a board that is bent "
        "or moved, a lens that was refocused, or positions with another tool or payload",
    )
