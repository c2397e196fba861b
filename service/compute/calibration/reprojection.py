"""Hand-eye by least reprojection error, weighted by the noise of robot and images, arm errors as random effects.

According to the images, the flange's pose in view i is  T_base_board · inverse(T_camera_board) ·
inverse(T_flange_camera).  Its increment e from the reported pose, in the flange's axes, is the sum of the robot's and
the images' errors:

    e_i(T_flange_camera, T_base_board, κ) = G_i φ + a_i + J_i c_i,
    a_i ~ N(0, diag(σ_t² 1, σ_r² 1)),  c_i ~ N(0, C_i)

C_i is the covariance of the board's pose in the image; G_i φ is the arm's systematic error (arm_kinematics) with the
prior φ ~ N(0, s²) in units of usual tolerances. Where φ is large, the reported poses are first corrected by a nearby
φ0, and e is the increment from there plus G_i φ0. The variances σ_t², σ_r² and s² maximise the restricted likelihood
(REML; Patterson and Thompson 1971, by Henderson's mixed model equations).

κ is the board's true size over the given one, as the robot's lengths show it, with the prior κ ~ N(1, u²) from the
board's tolerance. It scales the translation of T_camera_board. Without it, a board printed at 97 % moves the camera
along its axis by 3 % of the distance, and where the distance hardly varies, no residual shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import Board, BoardView
from service.compute.calibration.hand_eye_setup import scaled
from service.compute.camera_model import CameraModel
from service.compute.descent import gauss_newton, halved_gauss_newton, largest
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, increment, inverse, skew

FLOOR_M = 2e-7
_ITERATIONS = 8
_SETTLED = 1e-10  # largest step of the transforms (m, rad) at convergence
_SETTLED_ARM = 1e-5  # likewise for the arm's parameters, in units of their tolerances
_SELECTION_ROUNDS = 80
_UNDETERMINED = "the views do not determine the hand-eye transform"
_SINGULAR = 3e-7  # smallest accepted pivot of the scaled normal matrix
_COMMON = 13  # parameters before the arm's: two transforms and the board's scale
_SCALE = 12  # index of the board's scale among them
_LEAST_SIGMA = 1e-9  # of the scale: a board known to 1e-9 is exactly known
GEOMETRY_KINDS = 3  # lengths, twists, zeros of joints: the first scales


@dataclass(frozen=True, slots=True)
class BoardViews:
    """Measurements of N board views.

    Attributes:
        T_base_flange: (N, 4, 4) poses as reported, corrected by the arm's parameters `about`.
        T_camera_board: (N, 4, 4) poses by the images.
        covariance: (N, 6, 6) covariance of T_camera_board: (d, w) in the camera's axes.
        design: (N, 6, K) derivative of the flange's increment by the arm's parameters; K may be 0.
        kind: (K,) index into `Noise.scales` of each parameter's prior scale.
        about: (K,) the arm's parameters at which `design` is the derivative.
        size_sigma: relative standard deviation of the board's given size.
        scales_weight: the scales of the geometry are known to be about 1 as if that many parameters showed it: few
            images show few lengths, and a scale of these alone would vanish where they are right by chance.
    """

    T_base_flange: Array
    T_camera_board: Array
    covariance: Array
    design: Array
    kind: NDArray[np.int64]
    about: Array
    size_sigma: float
    scales_weight: float = 0.0

    @property
    def size_precision(self) -> float:
        """Inverse variance of the board's given size."""
        return 1 / max(self.size_sigma, _LEAST_SIGMA) ** 2

    def take(self, which: NDArray[np.bool_]) -> BoardViews:
        """Select these views."""
        return BoardViews(
            self.T_base_flange[which],
            self.T_camera_board[which],
            self.covariance[which],
            self.design[which],
            self.kind,
            self.about,
            self.size_sigma,
            self.scales_weight,
        )


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations: the robot's per axis (m, rad), and the scales of the arm's parameters."""

    robot_m: float
    robot_rad: float
    scales: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Fit:
    """An answer: the two transforms, the board's scale, the arm's parameters (K,) and their joint covariance."""

    T_flange_camera: Transform
    T_base_board: Transform
    scale: float  # of the board: true size over the given one
    arm: Array
    covariance: Array  # (13 + K, 13 + K): T_flange_camera, T_base_board, each (d, w) in its outer axes; scale; arm

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the board's scale, by the noise model."""
        return float(np.sqrt(self.covariance[_SCALE, _SCALE]))


def linearise(hands: Array, boards: Array, X: Transform, B: Transform) -> tuple[Array, Array, Array]:
    """Return the flange's increments e (N, 6), and derivatives (N, 6, 12) by X and B, (N, 6, 6) by the board's pose.

    All increments are (d, w) of exp(w) R, t + d in the transform's outer axes; those of e in the flange's axes.
    """
    n = len(hands)
    Rh, Rx = np.swapaxes(hands[:, :3, :3], 1, 2), X[:3, :3]
    R_camera = np.swapaxes(boards[:, :3, :3], 1, 2)  # R_board_camera
    T_base_camera_R = B[:3, :3] @ R_camera
    T_base_camera_t = B[:3, 3] - np.einsum("nij,nj->ni", T_base_camera_R, boards[:, :3, 3])
    flange_R = T_base_camera_R @ Rx.T
    flange_t = T_base_camera_t - np.einsum("nij,j->ni", flange_R, X[:3, 3])
    gap_R = Rh @ flange_R
    e = np.empty((n, 6))
    e[:, :3] = np.einsum("nij,nj->ni", Rh, flange_t - hands[:, :3, 3])
    e[:, 3:] = Rotation.from_matrix(gap_R).as_rotvec()
    J = np.zeros((n, 6, 12))
    J[:, :3, :3] = -gap_R
    J[:, :3, 3:6] = -gap_R @ skew(X[None, :3, 3])
    J[:, 3:, 3:6] = -gap_R
    J[:, :3, 6:9] = Rh
    J[:, :3, 9:] = -Rh @ skew(flange_t - B[:3, 3])
    J[:, 3:, 9:] = Rh
    JM = np.zeros((n, 6, 6))
    turned = gap_R @ Rx
    arm = -Rx.T @ X[:3, 3] - boards[:, :3, 3]  # from the board's origin to the flange, camera axes
    JM[:, :3, :3] = -turned
    JM[:, :3, 3:] = turned @ skew(arm)
    JM[:, 3:, 3:] = -turned
    return e, J, JM


def _rows(views: BoardViews, fit: Fit) -> tuple[Array, Array]:
    """Return rows [J | e] (N, 6, P + 1) of views at an answer, P = 13 + K, and the images' covariance (N, 6, 6)."""
    boards = scaled(views.T_camera_board, fit.scale)
    e, J, JM = linearise(views.T_base_flange, boards, fit.T_flange_camera, fit.T_base_board)
    by_scale = np.einsum("nij,nj->ni", JM[:, :, :3], views.T_camera_board[:, :3, 3])
    e += views.design @ views.about
    rows = np.concatenate([J, by_scale[:, :, None], -views.design, e[:, :, None]], axis=2)
    return rows, JM @ views.covariance @ np.swapaxes(JM, 1, 2)


def _grams(views: BoardViews, noise: Noise, fit: Fit) -> Array:
    """Return (N, P + 1, P + 1) Gram matrices of each view's whitened rows."""
    rows, images = _rows(views, fit)
    white = np.linalg.solve(np.linalg.cholesky(_robot(noise) + images), rows)
    return np.swapaxes(white, 1, 2) @ white


def _with_prior(gram: Array, views: BoardViews, scale: float) -> Array:
    """Return a summed Gram matrix with the board's given size as one more row."""
    row = np.zeros(len(gram))
    row[_SCALE], row[-1] = 1.0, scale - 1
    return gram + views.size_precision * np.outer(row, row)


def _robot(noise: Noise) -> Array:
    return np.diag([noise.robot_m**2] * 3 + [noise.robot_rad**2] * 3)


def _prior(noise: Noise, kind: NDArray[np.int64]) -> Array:
    return np.array(noise.scales)[kind] ** 2 if len(kind) else np.zeros(0)


def _minimum(gram: Array, prior: Array) -> tuple[Array, Array, float]:
    """Return step (P,), covariance (P, P) and ½ log|H| from a summed Gram matrix (P + 1, P + 1) and the arm's prior.

    Raises:
        ComputeError: the system is singular.
    """
    H = gram[:-1, :-1].copy()
    H[np.arange(_COMMON, len(H)), np.arange(_COMMON, len(H))] += 1 / prior
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.sqrt(np.diag(H))  # brings metres, radians and tolerances to one size
        scaled = H * scale[:, None] * scale
    L = _factor(scaled)
    half = np.asarray(solve_triangular(L, np.diag(scale), lower=True, check_finite=False), dtype=np.float64)
    covariance = half.T @ half
    log_determinant = float(np.sum(np.log(np.diag(L))) - np.sum(np.log(scale)))
    return -covariance @ gram[:-1, -1], covariance, log_determinant


def _factor(scaled: Array) -> Array:
    """Return the Cholesky factor of a normal matrix with unit diagonal. Raises ComputeError if it is singular."""
    try:
        L = np.asarray(np.linalg.cholesky(scaled), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise ComputeError(_UNDETERMINED, remedy="Take views with more rotation") from error
    if not np.diag(L).min() > _SINGULAR:
        raise ComputeError(_UNDETERMINED, remedy="Take views with more rotation")
    return L


def start_at(X: Transform, B: Transform, scale: float, count: int = 0) -> Fit:
    """Return T_flange_camera, T_base_board and the board's scale as a start, with `count` parameters of the arm."""
    return Fit(X, B, scale, np.zeros(count), np.zeros((_COMMON + count,) * 2))


def solve(views: BoardViews, noise: Noise, start: Fit, *, iterations: int = _ITERATIONS) -> Fit:
    """Solve the least squares weighted by `noise` with Gauss–Newton, in increments scaled by the normal matrix.

    Args:
        views: the measurements.
        noise: standard deviations from `estimate_noise`.
        start: the initial transforms and scale.
        iterations: largest number of iterations.

    Raises:
        ComputeError: the views do not determine the answer.
    """
    prior = _prior(noise, views.kind)

    def minimum_at(fit: Fit) -> tuple[Array, Array]:
        """Return the step from `fit` to the linearised problem's minimum, and the covariance of all parameters."""
        gram = _with_prior(_grams(views, noise, fit).sum(axis=0), views, fit.scale)
        step, covariance, _ = _minimum(gram, prior)
        return np.concatenate([step[:_COMMON], step[_COMMON:] - fit.arm]), covariance

    def moved(fit: Fit, step: Array) -> Fit:
        return Fit(
            increment(fit.T_flange_camera, step[:3], step[3:6]),
            increment(fit.T_base_board, step[6:9], step[9:12]),
            fit.scale + float(step[_SCALE]),
            fit.arm + step[_COMMON:],
            fit.covariance,
        )

    def size(_fit: Fit, step: Array) -> float:
        arm = float(np.abs(step[_COMMON:]).max(initial=0.0))
        return max(largest(step[:_COMMON]) / _SETTLED, arm / _SETTLED_ARM)

    start = start_at(start.T_flange_camera, start.T_base_board, start.scale, len(prior))
    fit = gauss_newton(start, lambda fit: minimum_at(fit)[0], moved, most=iterations, settled=1.0, size=size)
    return replace(fit, covariance=minimum_at(fit)[1])


def estimate_noise(views: BoardViews, near: Fit, start: Noise, *, floor_m: float = FLOOR_M) -> Noise:
    """Estimate the standard deviations that maximise the restricted likelihood, linearised near the answer.

    Args:
        views: the measurements without outliers.
        near: the answer, approximately.
        start: initial values, with one scale for each kind of arm parameter.
        floor_m: smallest robot noise; the same number in radians for the rotation.
    """
    rows, images = _rows(views, near)
    members = np.array([views.kind == g for g in range(len(start.scales))], dtype=np.float64)

    def objective(logs: Array) -> tuple[float, Array]:
        """Return half the deviance and its gradient."""
        noise = _noise(logs)
        prior = _prior(noise, views.kind)
        L = np.linalg.cholesky(_robot(noise) + images)
        white = np.linalg.solve(L, rows)
        flat = white.reshape(-1, rows.shape[2])
        step, covariance, log_H = _minimum(_with_prior(flat.T @ flat, views, near.scale), prior)
        u = np.concatenate([step, [1.0]])
        left = white @ u
        value = np.sum(np.log(np.diagonal(L, axis1=1, axis2=2))) + 0.5 * np.sum(np.log(prior)) + log_H
        value += 0.5 * (np.sum(left**2) + np.sum(step[_COMMON:] ** 2 / prior))
        value += 0.5 * views.size_precision * (near.scale - 1 + step[_SCALE]) ** 2
        squares = np.array(noise.scales[:GEOMETRY_KINDS]) ** 2
        value += 0.5 * views.scales_weight * np.sum(np.log(squares) + 1 / squares)
        # d/dV of each term, only the diagonal: the robot's variances are diagonal.
        inverse_L = np.linalg.inv(L)
        trace = np.sum(inverse_L**2, axis=1)
        solved = np.swapaxes(inverse_L, 1, 2) @ np.concatenate([white[:, :, :-1], left[:, :, None]], axis=2)
        A = solved[:, :, :-1]
        slope = trace - np.sum((A @ covariance) * A, axis=2) - solved[:, :, -1] ** 2
        robot = [noise.robot_m**2 * slope[:, :3].sum(), noise.robot_rad**2 * slope[:, 3:].sum()]
        scales = np.zeros(len(members))
        if len(prior):
            scales += members @ (1 - (np.diag(covariance)[_COMMON:] + step[_COMMON:] ** 2) / prior)
            scales[:GEOMETRY_KINDS] += views.scales_weight * (1 - 1 / squares)
        return float(value), np.array([*robot, *scales])

    first = np.log([max(start.robot_m, floor_m), max(start.robot_rad, floor_m), *start.scales])
    bounds = [(np.log(floor_m), np.log(0.05)), (np.log(floor_m), np.log(0.2))]
    bounds += [(np.log(1e-2), np.log(1e2))] * len(start.scales)
    answer = minimize(objective, first, method="L-BFGS-B", jac=True, bounds=bounds, options={"maxiter": 60})
    return _noise(np.asarray(answer.x, dtype=np.float64))


def _noise(logs: Array) -> Noise:
    values = np.exp(logs)
    return Noise(float(values[0]), float(values[1]), tuple(float(v) for v in values[2:]))


def select_scales(views: BoardViews, noise: Noise, near: Fit, groups: NDArray[np.int64]) -> Noise:
    """Estimate a prior scale for each group of arm parameters; those that the data do not need go to zero.

    Automatic relevance determination (MacKay 1992, Tipping 2001): expectation maximisation first, which is safe, then
    MacKay's fixed point, which is fast. A gear errs at one or two of its harmonics, not at all of them. Once these
    are found, they can be separated from the other joints' errors, and hold beyond the joint angles that were
    visited.

    Args:
        views: the measurements.
        noise: noise with the initial scales, in the groups of `views.kind`.
        near: the answer, approximately.
        groups: (K,) group of each parameter.

    Returns:
        Noise whose scales are those of `groups`.
    """
    gram = _with_prior(_grams(views, noise, near).sum(axis=0), views, near.scale)
    members = (groups == np.arange(groups.max() + 1)[:, None]).astype(np.float64)
    size = members.sum(axis=1)
    known = np.where(np.arange(len(size)) < GEOMETRY_KINDS, views.scales_weight, 0.0)
    square = np.array([float(np.mean(_prior(noise, views.kind)[groups == g])) for g in range(len(size))])
    for round_ in range(_SELECTION_ROUNDS):
        step, covariance, _ = _minimum(gram, square[groups])
        energy, spread = members @ step[_COMMON:] ** 2, members @ np.diag(covariance)[_COMMON:]
        if round_ < _SELECTION_ROUNDS // 2:
            square = (energy + spread + known) / (size + known)
        else:
            square = (energy + known) / np.maximum(size - spread / square + known, 1e-3)
        square = np.clip(square, 1e-6, 1e4)
    return Noise(noise.robot_m, noise.robot_rad, tuple(float(v) for v in np.sqrt(square)))


def resample(views: BoardViews, noise: Noise, fit: Fit, counts: Array) -> Array:
    """Return increments (R, 13 + K) of the answer if view i counts `counts[r, i]` times: replicates of a bootstrap.

    One Gauss-Newton step from the answer, which is exact to second order in the replicates' spread.
    """
    grams = _grams(views, noise, fit)
    prior = _prior(noise, views.kind)
    flat = counts @ grams.reshape(len(grams), -1)
    size = grams.shape[1]
    return np.array([_minimum(_with_prior(row.reshape(size, size), views, fit.scale), prior)[0] for row in flat])


def prior_share(views: BoardViews, noise: Noise, fit: Fit) -> Array:
    """Return (13 + K, 13 + K) part of the answer's covariance that is due to what was known before the images.

    The images pull the board's size and the arm's parameters away from their given values only as far as they
    determine them. The rest of their errors stays, however often the images are resampled.
    """
    pull = fit.covariance[:, _SCALE:]
    precision = np.concatenate([[views.size_precision], 1 / _prior(noise, views.kind)])
    return (pull * precision) @ pull.T


def mahalanobis(views: BoardViews, noise: Noise, fit: Fit, known: NDArray[np.bool_] | None = None) -> Array:
    """Return (N,) squared Mahalanobis distances of views' increments from the model, each of 6 degrees of freedom.

    With `known`, the fit's own uncertainty counts too: it is added to the noise of views not in the fit and
    subtracted from that of views in the fit (studentised residuals).
    """
    if known is None:
        v = np.concatenate([np.zeros(_COMMON), fit.arm, [1.0]])
        return np.einsum("i,nij,j->n", v, _grams(views, noise, fit), v)
    rows, images = _rows(views, fit)
    A, V = rows[:, :, :-1], _robot(noise) + images
    sign = np.where(known, -1.0, 1.0)[:, None, None]
    spread = V + sign * (A @ fit.covariance @ np.swapaxes(A, 1, 2)) * (1 - 1e-6)
    left = rows[:, :, -1] - views.design @ fit.arm
    return np.einsum("ni,ni->n", left, np.linalg.solve(spread, left[:, :, None])[:, :, 0])


_STEP_M = 1e-6
_REPROJECTION_ITERATIONS = 30


@dataclass(frozen=True, slots=True)
class BoardCorners:
    """Detected corners of N board views.

    Attributes:
        points_m: (P, 3) points in the board frame.
        corners_px: (N, P, 2) detected; NaN for corners that were not seen.
        camera: the calibrated camera.
    """

    points_m: Array
    corners_px: Array
    camera: CameraModel

    def __post_init__(self) -> None:
        if self.corners_px.ndim != 3 or self.corners_px.shape[1:] != (len(self.points_m), 2):
            raise DataError(f"{self.corners_px.shape} corners for a board of {len(self.points_m)} points")

    def take(self, which: NDArray[np.bool_]) -> BoardCorners:
        """Select these views."""
        return BoardCorners(self.points_m, self.corners_px[which], self.camera)


def board_corners(views: Sequence[BoardView], board: Board, camera: CameraModel) -> BoardCorners:
    """Return the corners of a board's views, which may be partial, as one array."""
    points = board.points()
    pixels = np.full((len(views), len(points), 2), np.nan)
    for row, view in zip(pixels, views, strict=True):
        row[view.indices] = view.corners
    return BoardCorners(points, pixels, camera)


def projection_jacobian(points_m: Array, T_camera_board: Array, camera: CameraModel) -> tuple[Array, Array]:
    """Return pixels (N, P, 2) and derivatives (N, P, 2, 6) by the increment (d, w) of T_camera_board (N, 4, 4)."""
    points = np.einsum("nij,pj->npi", T_camera_board[:, :3, :3], points_m) + T_camera_board[:, None, :3, 3]
    shape = points.shape[:2]

    def project(p: Array) -> Array:
        return camera.project(p.reshape(-1, 3)).reshape(*shape, 2)

    # Central differences over a micrometre are accurate to nine digits and work for any lens model.
    to_point = np.stack(
        [(project(points + shift) - project(points - shift)) / (2 * _STEP_M) for shift in np.eye(3) * _STEP_M],
        axis=-1,
    )
    arms = (points - T_camera_board[:, None, :3, 3]).reshape(-1, 3)
    turn = -to_point @ skew(arms).reshape(*shape, 3, 3)
    return project(points), np.concatenate([to_point, turn], axis=-1)


def board_covariance(corners: BoardCorners, T_camera_board: Array) -> tuple[Array, float]:
    """Return (N, 6, 6) covariance of each board pose, and the corners' standard deviation in px behind it.

    The latter is the median over the views of their residuals' standard deviation per axis.
    """
    pixels, J = projection_jacobian(corners.points_m, T_camera_board, corners.camera)
    residual = (corners.corners_px - pixels).reshape(len(pixels), -1)
    rows = J.reshape(len(J), -1, 6)
    seen = np.isfinite(residual)
    freedom = np.maximum(seen.sum(axis=1) - 6, 1)
    sigma_px = float(np.median(np.sqrt(np.nansum(residual**2, axis=1) / freedom)))
    rows = np.where(seen[:, :, None], rows, 0.0)
    normal = np.swapaxes(rows, 1, 2) @ rows
    scale = 1 / np.sqrt(np.einsum("nii->ni", normal))
    both = scale[:, :, None] * scale[:, None, :]
    return np.linalg.inv(normal * both) * both * sigma_px**2, sigma_px


def _reprojection_grams(hands: Array, corners: BoardCorners, X: Transform, B: Transform) -> Array:
    """Return (N, 13, 13) Gram matrices of each view's rows [J | residual]."""
    boards = np.array([inverse(hand @ X) @ B for hand in hands])
    pixels, J = projection_jacobian(corners.points_m, boards, corners.camera)
    _, to_flange, from_board = linearise(hands, boards, X, B)
    chained = J @ np.linalg.solve(from_board, -to_flange)[:, None]
    rows = np.concatenate([chained, (pixels - corners.corners_px)[..., None]], axis=-1).reshape(len(hands), -1, 13)
    rows = np.where(np.isfinite(rows[:, :, 12:]), rows, 0.0)
    return np.swapaxes(rows, 1, 2) @ rows


def _step(gram: Array) -> Array:
    H = gram[:12, :12]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / np.sqrt(np.diag(H))
        scaled = H * scale[:, None] * scale
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e12:
        raise ComputeError(
            "the views do not determine the hand-eye transform", remedy="Take views with more rotation"
        )
    return -scale * np.linalg.solve(scaled, scale * gram[:12, 12])


def solve_reprojection(
    hands: Array, corners: BoardCorners, X: Transform, B: Transform
) -> tuple[Transform, Transform]:
    """Minimise the reprojection error over T_flange_camera and T_base_board, with the robot's poses fixed.

    The paper's method, by Gauss–Newton. It attributes the robot's errors, which are many times larger, to the images.

    Args:
        hands: (N, 4, 4) T_base_flange.
        corners: the board's corners in the N views.
        X: initial T_flange_camera.
        B: initial T_base_board.

    Raises:
        ComputeError: the views do not determine the answer, or it did not converge.
    """

    def at(hand_eye: Transform, board: Transform) -> _Iterate:
        gram = _reprojection_grams(hands, corners, hand_eye, board).sum(axis=0)
        return _Iterate(hand_eye, board, _step(gram), float(gram[12, 12]))

    def candidate(here: _Iterate, share: float) -> _Iterate:
        step = share * here.step
        return at(increment(here.hand_eye, step[:3], step[3:6]), increment(here.board, step[6:9], step[9:]))

    found = halved_gauss_newton(at(X, B), candidate, _gain, _settles, most=_REPROJECTION_ITERATIONS)
    if not found.settled:
        raise ComputeError("the reprojection error did not converge", remedy="Check robot poses and board size")
    return found.state.hand_eye, found.state.board


@dataclass(frozen=True, slots=True)
class _Iterate:
    """The two transforms, the Gauss–Newton step (12,) from them, and the sum of squares in px²."""

    hand_eye: Transform
    board: Transform
    step: Array
    square_px2: float


def _gain(here: _Iterate, there: _Iterate) -> float:
    """A sum that grows by rounding alone does not count as grown."""
    return here.square_px2 * (1 + 1e-12) - there.square_px2 if np.isfinite(there.square_px2) else -np.inf


def _settles(here: _Iterate, there: _Iterate) -> bool:
    return largest(here.step) < 1e-9 or abs(here.square_px2 - there.square_px2) < 1e-14 * here.square_px2


def resample_reprojection(hands: Array, corners: BoardCorners, X: Transform, B: Transform, counts: Array) -> Array:
    """Return (R, 12) increments of the answer if view i counts `counts[r, i]` times."""
    flat = counts @ _reprojection_grams(hands, corners, X, B).reshape(len(hands), -1)
    return np.array([_step(row.reshape(13, 13)) for row in flat])
