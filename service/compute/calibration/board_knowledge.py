"""Holds what is known of the board's place and the camera's mount, and predicts what further images would show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import Board, BoardView
from service.compute.calibration.intrinsics import calibrate_intrinsics, locate_view
from service.compute.calibration.intrinsics_adjustment import (
    Adjustment,
    linearised,
    parameters_of,
    project_with_jacobian,
)
from service.compute.calibration.intrinsics_quality import EstimatedCamera, uncertainty_of
from service.compute.calibration.reprojection import linearise, projection_jacobian
from service.compute.camera_model import CameraModel
from service.compute.descent import gauss_newton
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, increment, inverse, skew, transform

_ARM_M, _ARM_RAD = 0.7e-3, 1e-3  # per axis: pose error of an uncalibrated arm
_MOST_STEPS = 6
_SETTLED = 1e-10  # metres and radians
_SAFETY = 1.3 * np.sqrt(3.0)  # bound over standard deviation; a uniform error within ± b has b / √3
_LENS_VIEWS = 5  # from this many images, the lens is known better than from its engraving
_REFINED_FOCAL, _REFINED_CENTRE = 0.006, 0.003
_ON_LENS = 0.012  # of the distance: error of a board's pose while the lens is not well known


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Tolerances as bounds, for each axis.

    Attributes:
        mount_m, mount_rad: error of the camera on the flange against its drawing.
        place_m: horizontal position of the board's middle, including how well the scene's centre was measured.
        height_m: vertical position of the board's middle.
        turn_rad: rotation of the board about the vertical.
        tilt_rad: tilt of the board from the horizontal.
        focal: focal length, relative.
        centre: principal point, over the image's width.
    """

    mount_m: float = 0.002
    mount_rad: float = float(np.radians(0.9))
    place_m: float = 0.03
    height_m: float = 0.015
    turn_rad: float = float(np.radians(10.0))
    tilt_rad: float = float(np.radians(4.5))
    focal: float = 0.025
    centre: float = 0.006


@dataclass(frozen=True, slots=True)
class BoardKnowledge:
    """The estimates from which board poses are planned, with their tolerances.

    Attributes:
        camera: the nominal camera, or the calibrated one.
        T_flange_camera, T_base_board: the nominal poses, or those estimated from the images.
        spread: (12, 12); the possible increments (d, w) of T_flange_camera and T_base_board are spread @ u for every
            u within ± 1.
        focal: relative tolerance of the focal length.
        centre: tolerance of the principal point, over the image's width.
        measured: number of images used; 0: nominal.
    """

    camera: CameraModel
    T_flange_camera: Transform
    T_base_board: Transform
    spread: Array
    focal: float
    centre: float
    measured: int = 0

    def draws(self, count: int, seed: int = 0) -> tuple[Array, Array, Array, Array]:
        """Draw `count` possible truths within the tolerances.

        Returns:
            T_flange_camera (count, 4, 4), T_base_board (count, 4, 4), ratio of the focal length to the estimate
            (count,) and shift of the principal point (count, 2), px.
        """
        rng = np.random.default_rng([seed, 0xD4A3])
        steps = rng.uniform(-1, 1, (count, 12)) @ self.spread.T
        hands = np.array([increment(self.T_flange_camera, s[:3], s[3:6]) for s in steps])
        boards = np.array([increment(self.T_base_board, s[6:9], s[9:]) for s in steps])
        zoom = 1 + self.focal * rng.uniform(-1, 1, count)
        return hands, boards, zoom, self.centre * self.camera.width * rng.uniform(-1, 1, (count, 2))


def nominal_knowledge(
    camera: CameraModel,
    T_flange_camera: Transform,
    middle_m: Array,
    approach: Array,
    board: Board,
    *,
    long_side_across: bool = True,
    tolerances: Tolerances = Tolerances(),
) -> BoardKnowledge:
    """Return the knowledge before any image.

    Args:
        camera: the nominal camera, for the images' size.
        T_flange_camera: the camera's pose on the flange by the mount's drawing.
        middle_m: (3,) intended place of the board's middle, base frame.
        approach: (3,) horizontal unit vector from the scene towards the base.
        board: lies face up and level.
        long_side_across: true if the board's long side runs across the approach; otherwise it runs along it.
        tolerances: bounds.
    """
    middle = board.points().mean(axis=0)
    down = np.array([0.0, 0.0, -1.0])
    rows_are_long = board.rows >= board.columns
    x = approach if rows_are_long == long_side_across else np.cross(down, approach)
    R = np.column_stack([x, np.cross(down, x), down])
    T_base_board = transform(R, middle_m - R @ middle)
    t = tolerances
    spread = np.zeros((12, 12))
    spread[:3, :3], spread[3:6, 3:6] = t.mount_m * np.eye(3), t.mount_rad * np.eye(3)
    turns = np.diag([t.tilt_rad, t.tilt_rad, t.turn_rad])
    spread[6:9, 6:9] = np.diag([t.place_m, t.place_m, t.height_m])
    spread[6:9, 9:] = skew(R @ middle) @ turns  # rotated about its middle, not about its first corner
    spread[9:, 9:] = turns
    return BoardKnowledge(camera, T_flange_camera, T_base_board, spread, t.focal, t.centre)


def refined_knowledge(
    known: BoardKnowledge, views: Sequence[BoardView], T_base_flange: Array, board: Board, *, lens_known: bool = False
) -> tuple[BoardKnowledge, Array]:
    """Update lens (from five images on), mount and board with the first images.

    Bayes' rule on the linearised hand-eye equations (`linearise`): the nominal values with their tolerances are the
    prior; the arm's error is taken as about a millimetre.

    Args:
        known: the nominal knowledge, or that of calibrations so far.
        views: (N) views of the board, N > 0.
        T_base_flange: (N, 4, 4) poses of the flange.
        board: the board in the views.
        lens_known: true if the camera is calibrated and stays as it is.

    Returns:
        The knowledge, and T_camera_board (N, 4, 4) of the views.

    Raises:
        DataError: there is no view.
        ComputeError: a view has no pose.
    """
    if not views:
        raise DataError("there is no image of the board yet")
    camera, focal, centre = known.camera, known.focal, known.centre
    if not lens_known and len(views) >= _LENS_VIEWS:
        camera, focal, centre = _lens(known, views, board)
    boards = np.array([locate_view(view, board, camera)[0] for view in views])
    start = T_base_flange[0] @ known.T_flange_camera @ boards[0]
    prior_board = _nearer_end(known.T_base_board, start, board)
    turned = board.half_turn()
    if turned is not None:
        boards = np.array([_same_way(T, T_base_flange[i] @ known.T_flange_camera, prior_board, turned)
                           for i, T in enumerate(boards)])  # fmt: skip
    away = float(np.median(np.linalg.norm(boards[:, :3, 3], axis=1)))
    C = np.diag([(centre * away) ** 2] * 2 + [(max(focal, 1e-3) * away) ** 2] + [(_ON_LENS * focal / 0.025) ** 2] * 3)
    X, B, covariance = _posterior(known, prior_board, T_base_flange, boards, C)
    scale = np.sqrt(np.diag(covariance))
    root = np.linalg.cholesky(covariance / np.outer(scale, scale)) * scale[:, None]
    return BoardKnowledge(camera, X, B, _SAFETY * root, focal, centre, len(views)), boards


def _posterior(
    known: BoardKnowledge, prior_board: Transform, hands: Array, boards: Array, C: Array
) -> tuple[Transform, Transform, Array]:
    """Return the posterior T_flange_camera and T_base_board, and their covariance (12, 12)."""
    precision = np.linalg.inv(known.spread @ known.spread.T / 3 + 1e-16 * np.eye(12))
    mount0 = known.T_flange_camera
    noise = np.diag([_ARM_M**2] * 3 + [_ARM_RAD**2] * 3)

    def minimum_at(mount: Transform, board: Transform) -> tuple[Array, Array]:
        """Return the step (12,) and covariance (12, 12)."""
        e, J, JM = linearise(hands, boards, mount, board)
        V = np.linalg.inv(noise + JM @ C @ np.swapaxes(JM, 1, 2))
        H = np.einsum("nia,nij,njb->ab", J, V, J) + precision
        off = np.concatenate([_from(mount0, mount), _from(prior_board, board)])
        gradient = np.einsum("nia,nij,nj->a", J, V, e) + precision @ off
        scale = 1 / np.sqrt(np.diag(H))
        covariance = np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale)
        return -covariance @ gradient, covariance

    mount, board = gauss_newton(
        (mount0, hands[0] @ mount0 @ boards[0]),
        lambda at: minimum_at(*at)[0],
        lambda at, step: (increment(at[0], step[:3], step[3:6]), increment(at[1], step[6:9], step[9:])),
        most=_MOST_STEPS,
        settled=_SETTLED,
    )
    covariance = minimum_at(mount, board)[1]
    return mount, board, (covariance + covariance.T) / 2


def _from(start: Transform, end: Transform) -> Array:
    """Return (6,) increment (d, w) that takes `start` to `end`."""
    w = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    return np.concatenate([end[:3, 3] - start[:3, 3], w])


def _lens(known: BoardKnowledge, views: Sequence[BoardView], board: Board) -> tuple[CameraModel, float, float]:
    """Return a lens from the first images if it is plausible: near the nominal one, and with moderate distortion."""
    size = (known.camera.width, known.camera.height)
    try:
        found = calibrate_intrinsics(views, board, size, model="radial2").camera
    except ComputeError:
        return known.camera, known.focal, known.centre
    near = abs(found.fx / known.camera.fx - 1) < 2 * known.focal + 0.01
    middle = np.abs(parameters_of(found, 4)[2:] - parameters_of(known.camera, 4)[2:]).max()
    if not near or middle > 0.02 * size[0] or max(abs(found.k1), abs(found.k2)) > 1:
        return known.camera, known.focal, known.centre
    return found, _REFINED_FOCAL, _REFINED_CENTRE


def _nearer_end(T_base_board: Transform, seen: Transform, board: Board) -> Transform:
    """Return the nominal pose, or that of the board turned by half a turn, whichever is nearer the observed one."""
    middle = board.points().mean(axis=0)
    other = T_base_board @ transform(Rotation.from_euler("z", np.pi), 2 * middle * [1, 1, 0])
    return min((T_base_board, other), key=lambda T: float(np.linalg.norm(T[:3, :3] - seen[:3, :3])))


def _same_way(
    T_camera_board: Transform, T_base_camera: Transform, T_base_board: Transform, turned: Transform
) -> Array:
    """Choose the orientation that agrees with the other views, for a board that looks the same after half a turn."""
    expected = (inverse(T_base_camera) @ T_base_board)[:3, :3]
    ways = (T_camera_board, T_camera_board @ turned)
    return min(ways, key=lambda T: float(np.linalg.norm(T[:3, :3] - expected)))


_PARAMETERS = 8  # fx … p2
# Prior before any image: focal lengths (relative), principal point (over the width), distortion.
_PRIOR_SIGMA = (0.05, 0.05, 0.02, 0.02, 0.2, 0.4, 2e-3, 2e-3)
_REPEATED_ARM_M, _REPEATED_ARM_RAD = 0.5e-3, 0.5e-3  # scatter of an arm's poses, per axis
_DISTANCE_M = 0.7  # at which projections are judged in the choice
_GRID = (12, 8)
_EVERY = 2  # use every second corner of rows and columns; more would only average noise


def lens_prior(camera: CameraModel) -> Array:
    """Return (8, 8) prior information from the nominal values."""
    scale = np.array([camera.fx, camera.fy, camera.width, camera.width, 1, 1, 1, 1])
    return np.diag(1 / (np.array(_PRIOR_SIGMA) * scale) ** 2)


def lens_information(boards: Array, camera: CameraModel, board: Board, corner_sigma_px: float) -> Array:
    """Return (C, 8, 8) information about fx … p2 from boards T_camera_board (C, 4, 4) of unknown pose."""
    some = (
        np.arange(board.columns * board.rows, dtype=np.int64)
        .reshape(board.rows, board.columns)[::_EVERY, ::_EVERY]
        .ravel()
    )
    weight = board.columns * board.rows / len(some) / corner_sigma_px**2
    return np.array([view.normal for view in _equations(boards, camera, board, some).views]) * weight


def lens_field(camera: CameraModel) -> Array:
    """Return (8, 8) F such that trace(F C) is the mean variance, px², of projected points, less a camera motion.

    C is the covariance of fx … p2. Whatever a rigid motion of the camera can absorb is not a calibration error.
    """
    x, y = np.linspace(0, camera.width - 1, _GRID[0]), np.linspace(0, camera.height - 1, _GRID[1])
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = np.column_stack([camera.normalise(pixels), np.ones(len(pixels))]) * _DISTANCE_M
    _, by_pose, by_camera = project_with_jacobian(points, np.zeros(6), camera)
    J = by_camera[:, :_PARAMETERS]
    Q, _ = np.linalg.qr(by_pose)
    free = J - Q @ (Q.T @ J)
    return free.T @ free / len(pixels)


def hand_eye_information(T_base_camera: Array, known: BoardKnowledge, board: Board, corner_sigma_px: float) -> Array:
    """Return (C, 12, 12) information of each pose about T_flange_camera and T_base_board."""
    points = board.points()
    corners = points.reshape(board.rows, board.columns, 3)[:: board.rows - 1, :: board.columns - 1].reshape(-1, 3)
    share = len(points) / len(corners)
    X, B = known.T_flange_camera, known.T_base_board
    flanges = T_base_camera @ inverse(X)
    boards = np.array([inverse(T) @ B for T in T_base_camera])
    _, J_px = projection_jacobian(corners, boards, known.camera)
    rows = J_px.reshape(len(boards), -1, 6)
    covariance = inverse_of(np.swapaxes(rows, 1, 2) @ rows * share) * corner_sigma_px**2
    _, J, from_board = linearise(flanges, boards, X, B)
    noise = np.diag([_REPEATED_ARM_M**2] * 3 + [_REPEATED_ARM_RAD**2] * 3)
    V = noise + from_board @ covariance @ np.swapaxes(from_board, 1, 2)
    return np.swapaxes(J, 1, 2) @ np.linalg.solve(V, J)


def uncertainty_mm(boards: Array, camera: CameraModel, board: Board, corner_sigma_px: float) -> float:
    """Predict the `projection_uncertainty`, worst in the image, of a calibration from T_camera_board (N, 4, 4).

    At the boards' median distance; NaN if they do not determine the camera.
    """
    everything = np.arange(board.columns * board.rows, dtype=np.int64)
    solution = _equations(boards, camera, board, everything)
    normal = np.sum([view.normal for view in solution.views], axis=0)
    variance = corner_sigma_px**2
    scale = 1 / np.sqrt(np.diag(normal))
    if np.linalg.eigvalsh(normal * np.outer(scale, scale))[0] < 1e-13:
        return float("nan")
    views = tuple(BoardView(everything, np.zeros((len(everything), 2))) for _ in boards)
    covariance = inverse_of(normal[None])[0] * variance
    flat = np.zeros((len(everything), 0))
    known = EstimatedCamera(camera, board, views, solution, covariance, flat, variance)
    middle = np.append(board.points().mean(axis=0), 1.0)
    return uncertainty_of(known, float(np.median((boards @ middle)[:, 2]))).worst_mm


def inverse_of(information: Array) -> Array:
    """Return (N, K, K) inverses of positive definite matrices, scaled first because their units differ widely."""
    scale = 1 / np.sqrt(np.einsum("nii->ni", information))
    both = scale[:, :, None] * scale[:, None, :]
    return np.linalg.inv(information * both) * both


def _equations(boards: Array, camera: CameraModel, board: Board, which: NDArray[np.int64]) -> Adjustment:
    return linearised(boards, board.points()[which], camera, _PARAMETERS)
