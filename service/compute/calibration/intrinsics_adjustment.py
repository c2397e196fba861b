"""Least squares over one camera, the board's bow and its pose in every view, with the poses eliminated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from service.compute.calibration.board import BoardView
from service.compute.camera_model import CameraModel
from service.compute.descent import Damping, gauss_newton, largest, levenberg_marquardt
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, transform

LensModel = Literal["pinhole", "radial2", "opencv4", "opencv5", "rational"]
#: Names of all parameters; a model estimates the first ones.
PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
PARAMETER_COUNT: dict[LensModel, int] = {"pinhole": 4, "radial2": 6, "opencv4": 8, "opencv5": 9, "rational": 12}

_HUBER = 3.0  # standard deviations of one coordinate beyond which a corner is downweighted
_MAX_ITERATIONS = 40
_DAMPING = Damping(1e-4)
# In px per unit of a term: pulls k3 … k6 towards 0 ± 1 with the weight of one corner of 0.03 px. If the images
# determine these terms, the effect vanishes; if not, it stops numerator and denominator from cancelling without
# limit, along a valley in which a weaker pull needs three times as many steps.
_PRIOR = 0.03
_SETTLED = 1e-6  # decrease of the cost, in squares of the corners' scale: a thousandth of a standard deviation
_START_VIEWS = 20  # used by OpenCV's solver for a start; the others join in the adjustment


@dataclass(frozen=True, slots=True)
class BoardSurface:
    """The points of a board that may be bent.

    Attributes:
        points: (K, 3) points of the flat board, m.
        bends: (K, S) displacement along z of each point by a unit of each term; S is 0 for a board that is flat.
        sigma_m: standard deviation of each term, before any image.
    """

    points: Array
    bends: Array
    sigma_m: float

    def bent(self, bow_m: Array) -> Array:
        """Return (K, 3) points of the board with these terms (S,)."""
        out = self.points.copy()
        out[:, 2] += self.bends @ bow_m
        return out


def flat_surface(points: Array) -> BoardSurface:
    """Return the surface of a board that is exactly as `points` (K, 3)."""
    return BoardSurface(points, np.zeros((len(points), 0)), 1.0)


@dataclass(frozen=True, slots=True)
class ViewEquations:
    """One view linearised at the solution; the view's own pose is eliminated from the equations.

    Its Q unknowns are the camera's P parameters and the S terms of the board's bow.

    Attributes:
        residual: (2M,) projection minus corner, px; x and y of each corner in turn.
        weighted: (2M,) residual times the root of its robust weight, without the part that a better pose would
            explain.
        reduced: (2M, Q) its derivative by the unknowns, without the part that the pose can compensate.
        compensation: (6, Q + 1) change of the view's pose (rvec, tvec) with the unknowns; the last column is the
            pose's own correction.
        pose_normal: (6, 6) normal matrix of the pose alone.
    """

    residual: Array
    weighted: Array
    reduced: Array
    compensation: Array
    pose_normal: Array

    @property
    def normal(self) -> Array:
        """(Q, Q) this view's part of the reduced normal matrix."""
        return self.reduced.T @ self.reduced

    @property
    def gradient(self) -> Array:
        """(Q,) this view's part of the reduced gradient; the parts of all views sum to zero at the solution."""
        return self.reduced.T @ self.weighted

    @property
    def rms_px(self) -> float:
        """Two-dimensional root mean square of the residual."""
        return rms(self.residual)


@dataclass(frozen=True, slots=True)
class Adjustment:
    """A solution: parameters (P,), poses (N, 6) as rvec and tvec (m) of T_camera_board, and the equations there.

    `bow_m` (S,) is the board's bow, and `prior` (Q,) what is known before the images: the diagonal of its part of the
    normal matrix.
    """

    camera: CameraModel
    parameters: Array
    bow_m: Array
    prior: Array
    poses: Array
    views: tuple[ViewEquations, ...]
    sigma_px: float  # robust standard deviation of one coordinate

    def T_camera_board(self) -> Array:
        """Return (N, 4, 4) poses of the board in the views."""
        return np.stack([pose_matrix(pose) for pose in self.poses])


def rms(residual: Array) -> float:
    """Return the two-dimensional root mean square of residuals (2M,)."""
    return float(np.sqrt(np.sum(residual**2) / (len(residual) / 2)))


def pose_matrix(pose: Array) -> Transform:
    """Return the transform of OpenCV's rvec and tvec (6,)."""
    return transform(Rotation.from_rotvec(pose[:3]), pose[3:])


def camera_of(parameters: Array, size: tuple[int, int]) -> CameraModel:
    """Return the camera of the first P of PARAMETERS; the others are zero."""
    return CameraModel(*size, *(float(v) for v in parameters))


def parameters_of(camera: CameraModel, count: int) -> Array:
    """Return the first `count` PARAMETERS of a camera, the inverse of `camera_of`."""
    return np.array([getattr(camera, name) for name in PARAMETERS[:count]])


def project_with_jacobian(points: Array, pose: Array, camera: CameraModel) -> tuple[Array, Array, Array]:
    """Return pixels (M, 2) of board points (M, 3), and derivatives by pose (2M, 6) and all parameters (2M, 12)."""
    terms = np.zeros(8)
    terms[: len(camera.distortion)] = camera.distortion
    pixels, jacobian = cv2.projectPoints(points, pose[:3], pose[3:], camera.matrix, terms)
    J = np.asarray(jacobian, dtype=np.float64)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2), J[:, :6], J[:, 6:18]


def prior_precision(count: int) -> Array:
    """Return (count,) diagonal that the weak prior on k3 … k6 adds to the normal matrix; zero for the other terms."""
    precision = np.zeros(count)
    precision[8:] = _PRIOR**2
    return precision


def start(
    views: Sequence[BoardView], points: Array, size: tuple[int, int], model: LensModel
) -> tuple[CameraModel, Array]:
    """Estimate an initial camera from some views by OpenCV's calibrateCamera, and the poses (N, 6) of all of them.

    Raises:
        ComputeError: no camera or no pose explains the views.
    """
    pick = np.unique(np.linspace(0, len(views) - 1, min(len(views), _START_VIEWS)).round().astype(int))
    flags = cv2.CALIB_FIX_K3
    if model == "pinhole":
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    if model in ("pinhole", "radial2"):
        flags |= cv2.CALIB_ZERO_TANGENT_DIST
    try:
        _, K, distortion, _, _ = cv2.calibrateCamera(
            [points[views[k].indices].astype(np.float32) for k in pick],
            [views[k].corners.astype(np.float32).reshape(-1, 1, 2) for k in pick],
            size,
            np.eye(3),
            np.zeros(5),
            flags=flags,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-6),
        )
    except cv2.error as error:
        raise ComputeError(f"no camera explains the views ({error.err})", remedy="Check the board's size") from error
    terms = (float(v) for v in np.asarray(distortion).ravel()[:4])
    camera = CameraModel(*size, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), *terms)
    return camera, np.stack([start_pose(view, points, camera) for view in views])


def start_pose(view: BoardView, points: Array, camera: CameraModel) -> Array:
    """Return (6,) rvec and tvec of one view by a known camera.

    Raises:
        ComputeError: no pose explains the corners.
    """
    done, rvec, tvec = cv2.solvePnP(
        points[view.indices] * [1.0, 1.0, 0.0],
        view.corners,
        camera.matrix,
        camera.distortion,
        flags=cv2.SOLVEPNP_IPPE,
    )
    if not done:
        raise ComputeError("the board's pose could not be computed", remedy="Check the corner counts")
    return np.concatenate([np.asarray(rvec, np.float64).ravel(), np.asarray(tvec, np.float64).ravel()])


def fit_pose(view: BoardView, points: Array, camera: CameraModel, pose: Array) -> tuple[Array, float]:
    """Return the pose (6,) of one view refined from `pose` with a known camera, and its RMS error in px."""

    def at(pose: Array) -> _ViewPose:
        pixels, J, _ = project_with_jacobian(points[view.indices], pose, camera)
        return _ViewPose(pose, (pixels - view.corners).ravel(), J)

    found = gauss_newton(
        at(pose),
        lambda here: np.asarray(np.linalg.lstsq(here.J, -here.residual)[0], dtype=np.float64),
        lambda here, step: at(here.pose + step),
        most=10,
        settled=1e-6,
        size=lambda here, step: largest(here.J @ step),  # px
    )
    return found.pose, rms(found.residual)


@dataclass(frozen=True, slots=True)
class _ViewPose:
    """A pose (6,) of one view, with the residual (2M,) and its derivative (2M, 6)."""

    pose: Array
    residual: Array
    J: Array


def adjust(
    views: Sequence[BoardView],
    surface: BoardSurface,
    size: tuple[int, int],
    camera: CameraModel,
    poses: Array,
    *,
    parameters: int,
    bow_m: Array | None = None,
    iterations: int = _MAX_ITERATIONS,
) -> Adjustment:
    """Adjust the camera's first `parameters` PARAMETERS, the board's bow and every pose by Levenberg-Marquardt.

    Corners have Huber weights.

    Each view's pose is eliminated, so the cost of a step grows linearly with the number of views.
    Source: Zhang, "A flexible new technique for camera calibration", PAMI 2000, for the model; Triggs et al.,
    "Bundle adjustment — a modern synthesis", 1999, section 6.1, for the elimination.

    Args:
        views: (N) corners, px.
        surface: the board's surface.
        size: width and height, px.
        camera: initial camera.
        poses: (N, 6) initial rvec and tvec (m).
        parameters: number estimated; the others keep their values in `camera` (zero).
        bow_m: (S,) initial bow; None: flat.
        iterations: largest number of iterations.

    Raises:
        ComputeError: the equations are singular, or the solution did not stay finite.
    """
    terms = surface.bends.shape[1]

    def prior_at(scale: float) -> Array:
        return np.concatenate([prior_precision(parameters), np.full(terms, (scale / surface.sigma_m) ** 2)])

    def at(theta: Array, poses: Array, scale: float | None = None, step: Array | None = None) -> _Linearised:
        equations, cost, present = _linearise(views, surface, theta, poses, size, scale)
        used = present if scale is None else scale
        cost += float(prior_at(used) @ theta**2)
        return _Linearised(theta, poses, equations, cost, used, present, step)

    def candidate(here: _Linearised, damping: float) -> _Linearised:
        prior = prior_at(here.scale)
        normal = np.sum([view.normal for view in here.equations], axis=0) + np.diag(prior)
        gradient = np.sum([view.gradient for view in here.equations], axis=0) + prior * here.theta
        shape = np.sqrt(np.diag(normal))
        if not np.isfinite(shape).all() or shape.min() <= 0:
            raise ComputeError("the views do not determine the camera", remedy="Take views with more tilt")
        scaled = normal / np.outer(shape, shape) + damping * np.eye(len(prior))
        step = -np.linalg.solve(scaled, gradient / shape) / shape
        moved = np.stack([p + _pose_step(view, step) for p, view in zip(here.poses, here.equations, strict=True)])
        return at(here.theta + step, moved, here.scale, step)

    end = levenberg_marquardt(
        at(np.concatenate([parameters_of(camera, parameters), np.zeros(terms) if bow_m is None else bow_m]), poses),
        candidate,
        _gain,
        _settles,
        damping=_DAMPING,
        most=iterations,
        # Far from the solution, the scale of the residuals is not yet known.
        renewed=lambda here: at(here.theta, here.poses) if here.present < 0.7 * here.scale else here,
    ).state
    theta, poses = end.theta, end.poses
    state, _, scale = _linearise(views, surface, theta, poses, size)
    if not np.isfinite(theta).all() or theta[:2].min() <= 0:
        raise ComputeError("the calibration did not converge", remedy="Check the board's size and the views")
    lens, bow = np.split(theta, [parameters])
    return Adjustment(camera_of(lens, size), lens, bow, prior_at(scale), poses, state, scale)


@dataclass(frozen=True, slots=True)
class _Linearised:
    """Camera and poses with the views' equations.

    Attributes:
        scale: robust scale of the corners in px by which the cost was taken.
        present: robust scale of the residuals here.
        step: the camera's step by which it was reached; None at the start.
    """

    theta: Array
    poses: Array
    equations: tuple[ViewEquations, ...]
    cost: float
    scale: float
    present: float
    step: Array | None


def _gain(here: _Linearised, there: _Linearised) -> float:
    """A cost that grows by rounding alone does not count as grown."""
    return here.cost * (1 + 1e-12) - there.cost if np.isfinite(there.cost) else -math.inf


def _settles(here: _Linearised, there: _Linearised) -> bool:
    if _gain(here, there) < 0 or there.step is None:
        return False
    relative = np.abs(there.step / np.maximum(np.abs(here.theta), 1e-3)).max()
    return bool(relative < 1e-9 or here.cost - there.cost < _SETTLED * here.scale**2)


def linearised(boards: Array, points: Array, camera: CameraModel, parameters: int) -> Adjustment:
    """Return the equations for boards T_camera_board (N, 4, 4) whose points (K, 3) are seen exactly as expected.

    Residuals are zero and corners have a standard deviation of 1 px: this predicts what images will determine.
    """
    poses = np.array([np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]]) for T in boards])
    theta = parameters_of(camera, parameters)
    every = np.arange(len(points))
    views = [
        BoardView(every, project_with_jacobian(points, pose, camera_of(theta, (camera.width, camera.height)))[0])
        for pose in poses
    ]
    equations, _, _ = _linearise(views, flat_surface(points), theta, poses, (camera.width, camera.height))
    return Adjustment(camera, theta, np.zeros(0), prior_precision(parameters), poses, equations, 1.0)


def _pose_step(view: ViewEquations, step: Array) -> Array:
    return view.compensation[:, :-1] @ step + view.compensation[:, -1]


def _linearise(
    views: Sequence[BoardView],
    surface: BoardSurface,
    theta: Array,
    poses: Array,
    size: tuple[int, int],
    scale: float | None = None,
) -> tuple[tuple[ViewEquations, ...], float, float]:
    """Return every view's equations, Huber's cost at `scale` (default: the current one), and the current scale."""
    terms = surface.bends.shape[1]
    lens, bow = np.split(theta, [len(theta) - terms])
    camera, points = camera_of(lens, size), surface.bent(bow)
    parts = [
        (*project_with_jacobian(points[view.indices], pose, camera), view.corners)
        for view, pose in zip(views, poses, strict=True)
    ]
    residuals = [(pixels - corners).ravel() for pixels, _, _, corners in parts]
    present = max(float(1.4826 * np.median(np.abs(np.concatenate(residuals)))), 1e-9)
    limit = _HUBER * (present if scale is None else scale)
    equations: list[ViewEquations] = []
    cost = 0.0
    for view, pose, residual, (_, by_pose, by_camera, _) in zip(views, poses, residuals, parts, strict=True):
        length = np.repeat(np.hypot(residual[::2], residual[1::2]), 2) / np.sqrt(2)
        root = np.sqrt(np.minimum(1.0, limit / np.maximum(length, 1e-12)))
        cost += float(np.sum(np.where(length <= limit, length**2, 2 * limit * length - limit**2)))
        J_pose, J = by_pose * root[:, None], by_camera[:, : len(lens)] * root[:, None]
        # A point moved along the board's normal moves as the whole board would.
        along = J_pose[:, 3:] @ pose_matrix(pose)[:3, 2]
        bent = along[:, None] * np.repeat(surface.bends[view.indices], 2, axis=0)
        target = np.column_stack([J, bent, residual * root])
        Q, R = np.linalg.qr(J_pose)
        inside = Q.T @ target
        free = target - Q @ inside
        follow = -np.linalg.solve(R, inside)
        equations.append(ViewEquations(residual, free[:, -1], free[:, :-1], follow, R.T @ R))
    return tuple(equations), cost, present
