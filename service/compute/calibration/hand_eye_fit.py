"""Fits a hand-eye calibration: outlier rejection, the weighted fit, and the arm's systematic error."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from service.compute.arm_kinematics import (
    ArmCorrection,
    check_arm,
    corrected_T_base_flange,
    correction_design,
    correction_of,
    dh_joints,
    gear_count,
)
from service.compute.calibration.hand_eye_setup import (
    MIN_VIEWS,
    RobustStart,
    deviation,
    mean_pose,
    robust_start,
    scaled,
    solve_closed_form,
    solve_with_scale,
)
from service.compute.calibration.reprojection import (
    FLOOR_M,
    GEOMETRY_KINDS,
    BoardCorners,
    BoardViews,
    Fit,
    Noise,
    estimate_noise,
    linearise,
    mahalanobis,
    select_scales,
    solve,
    solve_reprojection,
    start_at,
)
from service.core.arms import ArmModel
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform

Method = Literal["weighted", "reprojection", "park", "daniilidis", "tsai", "horaud", "andreff"]
ArmTerms = Literal["none", "geometry", "geometry+gears"]

# An arm's systematic error alone displaces views by up to three times the others' scatter; these are not outliers. A
# wrong pose, a moved board or a bad detection is farther away than this.
_GROSS = 5.0
_LIMIT = float(chdtri(6, 1e-4))  # when the arm's systematic error is part of the model
_MEDIAN_NORM = 1.538  # median length of three standard normal numbers
_CHI2_MEDIAN = float(chdtri(6, 0.5))
_MAX_EXCLUDED = 1 / 3
_ARM_FLOOR_M = 3e-6  # no arm is more repeatable
_MIN_ARM_VIEWS = 9
_ROUNDS = 6
_DERIVATIVES = 2  # how often the arm's derivative is taken again; after two, a micrometre is left
ANY_SIZE = 1.0  # relative standard deviation of a board's size of which nothing is known


@dataclass(frozen=True, slots=True)
class HandEyeSolution:
    """T_flange_camera and T_base_board, with the model of a weighted fit.

    Attributes:
        T_flange_camera: the calibration.
        T_base_board: the board's pose.
        scale: the board's true size over the given one.
        scale_sigma: standard deviation of `scale`, by the noise model.
        views: the views with the arm parameters in use; weighted fit only.
        noise: weighted fit only.
        fit: weighted fit only.
        correction: the arm's correction, if it was estimated.
    """

    T_flange_camera: Transform
    T_base_board: Transform
    scale: float
    scale_sigma: float
    views: BoardViews | None = None
    noise: Noise | None = None
    fit: Fit | None = None
    correction: ArmCorrection | None = None


@dataclass(frozen=True, slots=True)
class HandEyeMeasurements:
    """All measurements of N views; `corners` and `joints_rad` (N, J) if known.

    `size_sigma` is the relative standard deviation of the board's given size.
    """

    hands: Array
    boards: Array
    covariance: Array
    corners: BoardCorners | None
    joints_rad: Array | None
    arm: ArmModel | None
    size_sigma: float

    def take(self, which: NDArray[np.bool_]) -> HandEyeMeasurements:
        """Select these views."""
        return HandEyeMeasurements(
            self.hands[which],
            self.boards[which],
            self.covariance[which],
            None if self.corners is None else self.corners.take(which),
            None if self.joints_rad is None else self.joints_rad[which],
            self.arm,
            self.size_sigma,
        )

    def resized(self, scale: float) -> HandEyeMeasurements:
        """Return the measurements for a board that is `scale` times as large."""
        corners = self.corners
        if corners is not None:
            corners = BoardCorners(scale * corners.points_m, corners.corners_px, corners.camera)
        return dataclasses.replace(self, boards=scaled(self.boards, scale), corners=corners)

    def views(self) -> BoardViews:
        """Return the views for a weighted fit without parameters of the arm."""
        kind, design = np.zeros(0, dtype=np.int64), np.zeros((len(self.hands), 6, 0))
        return BoardViews(self.hands, self.boards, self.covariance, design, kind, np.zeros(0), self.size_sigma)

    def arm_views(self, terms: ArmTerms, about: Array | None = None) -> BoardViews:
        """Return the views for a weighted fit with these parameters (K,) of the arm, near `about`; None: near zero.

        Raises:
            DataError: the joints are another arm's.
        """
        assert self.arm is not None
        assert self.joints_rad is not None
        check_arm(self.arm, self.joints_rad, self.hands)
        kind = _kinds(self.arm, terms)
        about = np.zeros(len(kind)) if about is None else about
        near = correction_of(self.arm, about, np.zeros(self.arm.axes))
        hands = corrected_T_base_flange(self.joints_rad, self.hands, near)
        design = correction_design(self.arm, self.joints_rad, near)[:, :, : len(kind)]
        known = self.arm.tolerances.weight
        return BoardViews(hands, self.boards, self.covariance, design, kind, about, self.size_sigma, known)

    def placed(self, answer: HandEyeSolution) -> Array:
        """Return (N, 4, 4) T_base_board from each view alone."""
        hands = self.hands
        if answer.correction is not None:
            assert self.joints_rad is not None
            hands = corrected_T_base_flange(self.joints_rad, hands, answer.correction)
        return hands @ answer.T_flange_camera @ scaled(self.boards, answer.scale)


def find_outliers(data: HandEyeMeasurements, rng: np.random.Generator) -> dict[int, str]:
    """Find the views whose robot pose and board pose disagree beyond the others' noise, with reasons by index.

    Raises:
        ComputeError: more than a third of the views disagree.
    """
    # A board of another size must not make outliers of the views that would show it.
    views = dataclasses.replace(data, size_sigma=ANY_SIZE).views()
    fit = _near(robust_start(data.hands, data.boards, rng))
    noise = _noise_at(data, fit)
    keep = np.zeros(len(data.hands), dtype=bool)
    square = np.zeros(len(keep))
    for round_ in range(_ROUNDS):
        square = mahalanobis(views, noise, fit, keep if round_ else None)
        now = square < 6 * _GROSS**2
        if now.sum() < max(MIN_VIEWS, (1 - _MAX_EXCLUDED) * len(keep)):
            raise ComputeError(
                f"{np.count_nonzero(~now)} of {len(keep)} board images disagree with the robot's poses",
                remedy="Check that images and poses belong together, the board's size, and that the board lay still",
            )
        if np.array_equal(now, keep):
            break
        keep = now
        good = views.take(keep)
        noise = estimate_noise(good, fit, noise)
        fit = solve(good, noise, fit)
    mm, deg = deviation(data.placed(_answer_of(fit)), fit.T_base_board)
    return {
        int(
            i
        ): f"{mm[i]:.2f} mm and {deg[i]:.3f}° off the other images, {np.sqrt(square[i] / 6):.0f} times their noise"
        for i in np.flatnonzero(~keep)
    }


def _answer_of(fit: Fit) -> HandEyeSolution:
    return HandEyeSolution(fit.T_flange_camera, fit.T_base_board, fit.scale, fit.scale_sigma)


def _noise_at(data: HandEyeMeasurements, fit: Fit) -> Noise:
    """Return a robust initial estimate of the noise from the increments near an answer."""
    e, _, _ = linearise(data.hands, scaled(data.boards, fit.scale), fit.T_flange_camera, fit.T_base_board)
    lengths = np.linalg.norm(e.reshape(-1, 2, 3), axis=2)
    robot_m, robot_rad = (max(float(v) / _MEDIAN_NORM, FLOOR_M) for v in np.median(lengths, axis=0))
    return Noise(robot_m, robot_rad)


def turned_back(data: HandEyeMeasurements, answer: HandEyeSolution, T_board_turned: Transform) -> NDArray[np.bool_]:
    """Return (N,) views that fit the answer better with the board turned by half a turn."""
    apart = [
        dataclasses.replace(data, boards=boards, corners=None).placed(answer)
        for boards in (data.boards, data.boards @ T_board_turned)
    ]
    as_is, turned = (deviation(placed, answer.T_base_board)[0] for placed in apart)
    return turned < as_is


def fit_method(data: HandEyeMeasurements, method: Method, start: HandEyeSolution | None = None) -> HandEyeSolution:
    """Solve these views with one method, without a model of the arm's error.

    Args:
        data: the measurements without outliers.
        method: the method.
        start: a nearby answer, which saves the search for a start.

    Raises:
        ComputeError: the method has no answer.
    """
    weighted = _fit_weighted(data, start)
    return weighted if method == "weighted" else fit_resized(data, method, weighted, weighted.scale)


def fit_resized(data: HandEyeMeasurements, method: Method, near: HandEyeSolution, scale: float) -> HandEyeSolution:
    """Solve with an unweighted method for a board that is `scale` times as large as given.

    These methods have no noise by which the given size could be weighed against the views: the weighted fit gives
    them the scale.

    Raises:
        ComputeError: the method has no answer.
    """
    resized = data.resized(scale)
    if method == "reprojection":
        if resized.corners is None:
            raise ComputeError("the method `reprojection` needs the corners, not only the board's poses")
        two = solve_reprojection(resized.hands, resized.corners, near.T_flange_camera, near.T_base_board)
        return HandEyeSolution(*two, scale, near.scale_sigma)
    assert method != "weighted"
    X = solve_closed_form(resized.hands, resized.boards, method)
    return HandEyeSolution(X, mean_pose(resized.hands @ X @ resized.boards), scale, near.scale_sigma)


def without_size(data: HandEyeMeasurements, answer: HandEyeSolution | None = None) -> HandEyeSolution:
    """Return the weighted fit's answer if nothing were known of the board's size.

    Args:
        data: the measurements without outliers.
        answer: an answer with the arm's errors, whose noise is then used; None: without them.

    Raises:
        ComputeError: the views do not determine the answer.
    """
    if answer is None or answer.correction is None:
        return _fit_weighted(dataclasses.replace(data, size_sigma=ANY_SIZE), None)
    assert answer.views is not None
    assert answer.noise is not None
    views = dataclasses.replace(answer.views, size_sigma=ANY_SIZE)
    fit = solve(views, answer.noise, _near(answer))
    return dataclasses.replace(_answer_of(fit), views=views, noise=answer.noise, fit=fit)


def _fit_weighted(data: HandEyeMeasurements, start: HandEyeSolution | None) -> HandEyeSolution:
    views = data.views()
    near = _near(solve_with_scale(data.hands, data.boards) if start is None else start)
    noise = _noise_at(data, near) if start is None or start.noise is None else start.noise
    noise = estimate_noise(views, near, Noise(noise.robot_m, noise.robot_rad))
    fit = solve(views, noise, near)
    return dataclasses.replace(_answer_of(fit), views=views, noise=noise, fit=fit)


def arm_noise(data: HandEyeMeasurements, plain: HandEyeSolution, terms: ArmTerms) -> Noise:
    """Return the noise of the model with these arm parameters, before any selection among them.

    Raises:
        DataError: the joints are another arm's.
    """
    assert plain.noise is not None
    views, near = data.arm_views(terms), _near(plain)
    scales = (1.0,) * (int(views.kind.max()) + 1)
    first = Noise(plain.noise.robot_m / 5, plain.noise.robot_rad / 5, scales)
    noise = estimate_noise(views, near, first, floor_m=_ARM_FLOOR_M)
    # What the derivative at the nominal arm leaves of large twists would count as noise.
    views, near = _settled(data, terms, views.kind, noise, near)
    return estimate_noise(views, near, noise, floor_m=_ARM_FLOOR_M)


def _settled(
    data: HandEyeMeasurements, terms: ArmTerms, kind: NDArray[np.int64], noise: Noise, near: Fit
) -> tuple[BoardViews, Fit]:
    """Return the fit with the arm's parameters, and the views with the derivative taken there."""
    views = dataclasses.replace(data.arm_views(terms), kind=kind)
    fit = solve(views, noise, near)
    for _ in range(_DERIVATIVES):
        views = dataclasses.replace(data.arm_views(terms, fit.arm), kind=kind)
        fit = solve(views, noise, fit)
    return views, fit


def _near(answer: HandEyeSolution | RobustStart) -> Fit:
    return start_at(answer.T_flange_camera, answer.T_base_board, answer.scale)


def fit_with_arm(data: HandEyeMeasurements, plain: HandEyeSolution, terms: ArmTerms, start: Noise) -> HandEyeSolution:
    """Return the weighted answer with the arm's systematic error estimated.

    Args:
        data: the measurements without outliers, with joints and arm.
        plain: the weighted answer without it.
        terms: the arm parameters to estimate.
        start: noise from `arm_noise`, of these views or nearly the same.

    Raises:
        ComputeError: there is no answer.
        DataError: the joints are another arm's.
    """
    assert data.arm is not None
    kind, noise = _kinds(data.arm, terms), start
    views, fit = _settled(data, terms, kind, noise, _near(plain))
    if terms == "geometry+gears":
        groups = _groups(data.arm)
        noise = select_scales(views, start, fit, groups)
        views, fit = _settled(data, terms, groups, noise, fit)
    correction = correction_of(data.arm, fit.arm, _observed(data.arm, fit, noise, views.kind))
    return dataclasses.replace(_answer_of(fit), views=views, noise=noise, fit=fit, correction=correction)


def _kinds(arm: ArmModel, terms: ArmTerms) -> NDArray[np.int64]:
    """Return (P,) 0 for a length of the geometry, 1 for a twist, 2 for the zero of a joint, 3 for a gear."""
    geometry = np.concatenate([np.tile([0, 0, 1, 2], arm.axes), np.ones(len(arm.parallel))]).astype(np.int64)
    if terms == "geometry":
        return geometry
    return np.concatenate([geometry, np.full(gear_count(arm), GEOMETRY_KINDS, dtype=np.int64)])


def _groups(arm: ArmModel) -> NDArray[np.int64]:
    """Return (P,) group of each parameter: its kind for the geometry, then one for each harmonic of each joint."""
    joints, waves = np.arange(arm.axes)[:, None, None], np.arange(arm.tolerances.harmonics)
    gears = np.broadcast_to(GEOMETRY_KINDS + joints * len(waves) + waves, (arm.axes, 2, len(waves)))
    return np.concatenate([_kinds(arm, "geometry"), gears.ravel()])


def _observed(arm: ArmModel, fit: Fit, noise: Noise, kind: NDArray[np.int64]) -> Array:
    """Return (J,) share of the prior variance that the data removed, joint by joint."""
    prior = np.array(noise.scales)[kind] ** 2
    left = np.diag(fit.covariance)[-len(kind) :]
    joints = np.arange(arm.axes)
    of = np.concatenate([dh_joints(arm), np.repeat(joints, 2 * arm.tolerances.harmonics)])[: len(kind)]
    return np.array([1 - left[of == j].sum() / prior[of == j].sum() for j in joints])


def arm_outliers(answer: HandEyeSolution) -> NDArray[np.bool_]:
    """Return (N,) views that a fit with the arm's errors does not explain, though a fit without them may."""
    assert answer.views is not None
    assert answer.noise is not None
    assert answer.fit is not None
    square = mahalanobis(answer.views, answer.noise, answer.fit)
    return square > _LIMIT * max(1.0, float(np.median(square)) / _CHI2_MEDIAN)


def arm_is_possible(data: HandEyeMeasurements) -> bool:
    """Return whether joints are known and there are enough views to estimate the arm's errors."""
    return data.arm is not None and data.joints_rad is not None and len(data.hands) >= _MIN_ARM_VIEWS


def held_out(
    data: HandEyeMeasurements,
    keep: NDArray[np.bool_],
    method: Method,
    terms: ArmTerms,
    start: tuple[HandEyeSolution, Noise | None],
    folds: NDArray[np.int64],
    point_m: Array,
) -> tuple[Array, Array]:
    """Return (N,) distance in mm and angle in degrees of each view's board from a fit without this view.

    Args:
        data: all views, including outliers (which no fit uses).
        keep: (N,) whether a view is not an outlier.
        method: the method of the fits.
        terms: arm parameters in the fits.
        start: the answer from all views without the arm's errors, and the noise with them, to start from.
        folds: (N,) fold of each view.
        point_m: (3,) point of the board at which the distance is measured.
    """
    mm, deg = np.zeros(len(folds)), np.zeros(len(folds))
    for k in range(int(folds.max()) + 1):
        test, train = folds == k, keep & (folds != k)
        learnt = data.take(train)
        answer = fit_method(learnt, method, start[0])
        if start[1] is not None:
            answer = fit_with_arm(learnt, answer, terms, start[1])
        mm[test], deg[test] = deviation(data.take(test).placed(answer), answer.T_base_board, point_m)
    return mm, deg
