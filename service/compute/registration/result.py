"""Holds the result of a registration, the scan's pose and its covariance, and propagates errors of camera poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from service.compute.markers.records import SphereOutline
from service.compute.registration.problem import (
    Blocks,
    Linearised,
    Marginal,
    Problem,
    State,
    linearise,
    with_outlines,
)
from service.core.errors import DataError
from service.core.geometry import Array, Transform, skew


@dataclass(frozen=True, slots=True)
class OutlineResidual:
    """The residual of one outline at the solution."""

    image: int
    outline: int  # index in the image's outlines
    marker: int
    rms_px: float  # with the camera pose as given
    excluded: bool
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Solution:
    """The solved least-squares problem, from which further results follow without solving it again."""

    problem: Problem
    state: State
    weights: Array  # (O,) of the outlines, 0 for excluded ones
    blocks: Blocks
    marginal: Marginal
    linearised: Linearised  # with the cone cost
    covariance: Array  # (n, n) of all common unknowns, as the adjustment has it
    pose_root: Array  # (N, 6, 6)
    outline_factor: float

    def by_own_light(self) -> Array:
        """Return (n, n) what light of their own on single spheres adds to the covariance of the common unknowns.

        The adjustment knows nothing of it: with C the covariance and P the information on the spheres' centres, a
        displacement e of the centres moves the unknowns by C P e.
        """
        p = self.problem
        if p.sphere_prior is None:
            return np.zeros_like(self.covariance)
        moved = self.covariance[:, p.sphere_column : p.common_column] @ p.sphere_prior
        return np.asarray(p.own_light_m**2 * moved @ moved.T, dtype=np.float64)

    def pose_gain(self) -> Array:
        """Return (N, 6, n) K with xi = K dx + own error of covariance Q: pose errors follow the common unknowns."""
        return -(self.marginal.Q @ self.blocks.JA.transpose(0, 2, 1)) / self.outline_factor


@dataclass(frozen=True, slots=True)
class RegistrationResult:
    """The result of `register`.

    `T_world_scan` with world = the base frame of the first group, in metres; given camera positions are first
    multiplied by `scale`. `T_world_group[g]` maps base frame g to the world. `covariance` is (6, 6), or (7, 7) with
    scale, of (x, y, z in metres, rotation vector in radians[, ln scale]) of a perturbation exp(w) R, t + d in world
    axes. It is the sum of `components`: "outlines" (their own noise), "common" (errors shared by all outlines, and
    the intrinsics if their covariance was given), "poses", "spheres" (errors of the scan's centres, and light of
    their own on single spheres, which displaces each alike in all images), and those that `register_images` adds.
    `rms_px` is over the outlines that were not excluded, with the camera poses as given.
    """

    T_world_scan: Transform
    scale: float
    T_world_group: dict[int, Transform]
    covariance: Array
    rms_px: float
    residuals: tuple[OutlineResidual, ...]
    T_scan_camera: Array = field(repr=False)  # (N, 4, 4) metric, each image through its own group, poses as given
    chi2_reduced: (
        float  # of the outlines with their given covariances, per degree of freedom; near 1 if those are right
    )
    n_images: int
    cost: str
    components: dict[str, Array] = field(repr=False)
    T_scan_camera_refined: Array = field(repr=False)  # (N, 4, 4) corrected by the estimated pose errors
    pose_sigma: tuple[float, float]  # m and rad, rms per coordinate, of single poses' errors; 0 if taken as exact
    outline_factor: float  # factor on the outlines' given variances, estimated from the residuals
    solution: Solution = field(repr=False)

    @property
    def excluded(self) -> tuple[OutlineResidual, ...]:
        """Excluded outlines, with reasons."""
        return tuple(r for r in self.residuals if r.excluded)

    @property
    def refined_covariance(self) -> Array:
        """(6, 6) covariance of the scan relative to `T_scan_camera_refined`, averaged over all images with outlines.

        Of (d, w) of exp(w) R, t + d in world axes, R that of T_world_scan. With refined cameras, pose errors matter
        only as far as the outlines do not determine them; `covariance` is for the poses as given.
        """
        return np.sum(list(self.refined_components().values()), axis=0)

    def refined_components(self) -> dict[str, Array]:
        """Return the parts of `refined_covariance`; the noise of outlines and poses is inseparable and one part."""
        s = self.solution
        problem = s.problem
        by_common, own = self.refined_gain()
        prior, inside = problem.prior(), slice(problem.sphere_column, problem.common_column)
        through = by_common @ s.covariance
        spheres = through[:, inside] @ prior[inside, inside] @ through[:, inside].T
        common = through[:, problem.common_column :]
        common = common @ prior[problem.common_column :, problem.common_column :] @ common.T
        noise = through @ by_common.T + own - spheres - common
        spheres += by_common @ s.by_own_light() @ by_common.T
        return {"outlines and poses": noise, "common": common, "spheres": spheres}

    def refined_gain(self) -> tuple[Array, Array]:
        """Return how errors move the scan relative to `T_scan_camera_refined`, averaged over images with outlines.

        Returns:
            (6, n) by errors of the n common unknowns, and the (6, 6) covariance by the images' own errors.
        """
        s = self.solution
        problem, gain = s.problem, s.pose_gain()
        seen = np.unique(problem.image)
        T_base_camera = s.state.cameras(problem, refined=True)
        by_common, own = np.zeros((6, problem.size)), np.zeros((6, 6))
        for i in seen:
            k = int(problem.station[i])
            base = s.state.bases[k]
            # A point X in base axes moves by d + w x (X - t_base); the camera's error subtracts d' + w' x (X - t_i).
            by_pose = np.eye(6)
            by_pose[:3, 3:] = -skew(base[:3, 3] - T_base_camera[i, :3, 3])
            to_world = np.kron(np.eye(2), self.T_world_scan[:3, :3] @ base[:3, :3].T) / len(seen)
            by_common[:, 6 * k : 6 * k + 6] += to_world
            by_common -= to_world @ by_pose @ gain[i]
            part = to_world @ by_pose
            own += part @ s.marginal.Q[i] @ part.T
        return by_common, own

    def sigma_map_m(self, points_scan_m: Array) -> Array:
        """Predict the target registration error: 3D standard deviation (N,) in m at points (N, 3) of the scan."""
        return np.sqrt(_variance_m2(points_scan_m @ self.T_world_scan[:3, :3].T, self.covariance))

    def sigma_at_m(self, point_scan_m: Array) -> float:
        """Predict the target registration error: 3D standard deviation in metres at a point (3,) of the scan."""
        return float(self.sigma_map_m(np.asarray(point_scan_m)[None])[0])

    def covariance_at_m2(self, point_scan_m: Array) -> Array:
        """Return (3, 3) covariance in m², world axes, of the position of a point (3,) of the scan."""
        return self._at_m2(self.covariance, point_scan_m)

    def part_at_m2(self, component: str, point_scan_m: Array) -> Array:
        """Return (3, 3) the part of `covariance_at_m2` that a component causes."""
        return self._at_m2(self.components[component], point_scan_m)

    def _at_m2(self, covariance: Array, point_scan_m: Array) -> Array:
        J = np.hstack([np.eye(3), -skew(self.T_world_scan[:3, :3] @ point_scan_m)])
        return np.asarray(J @ covariance[:6, :6] @ J.T, dtype=np.float64)


def _variance_m2(turned: Array, covariance: Array) -> Array:
    """Return traces (N,) of the position covariance of points `turned` (N, 3): rotated, from the scan's origin."""
    # The expectation of |d + w x v|^2: tr D + 2 v . E[d x w] + |v|^2 tr W - v' W v
    D, X, W = covariance[:3, :3], covariance[:3, 3:6], covariance[3:6, 3:6]
    twist = np.array([X[1, 2] - X[2, 1], X[2, 0] - X[0, 2], X[0, 1] - X[1, 0]])
    square = np.sum(turned**2, axis=1)
    total = np.trace(D) + 2 * turned @ twist + square * np.trace(W) - np.einsum("ni,ij,nj->n", turned, W, turned)
    return np.maximum(total, 0.0)


@dataclass(frozen=True, slots=True)
class HeldOutRows:
    """Whitened rows of O outlines outside the solution: r + J dx + A xi."""

    image: NDArray[np.int64]
    J: Array  # (O, 3, n)
    A: Array  # (O, 3, 6)
    r: Array  # (O, 3) at the solution, with the pose as given
    whiten: Array  # (O, 3, 3)
    by_centre: Array | None = (
        None  # (O, 3, 3) by a displacement of the sphere in the scan frame, if its centre is uncertain
    )


@dataclass(frozen=True, slots=True)
class Prediction:
    """Error of an outline's prediction, and the predicted size of that error."""

    normalised: float  # rms of the outline's three residuals over their predicted standard deviations
    sigma_rad: float  # predicted rms distance of the outline's points from the prediction


def held_out_rows(
    solution: Solution,
    outlines: Sequence[Sequence[SphereOutline]],
    members: list[tuple[int, int, int]],
    centres_scan_m: Array,
) -> HeldOutRows:
    """Return rows of outlines of other spheres, (C, 3) in the scan frame; members are (image, outline, sphere)."""
    own = solution.problem
    problem = replace(with_outlines(own, outlines, members), centres=np.asarray(centres_scan_m), sphere_prior=None)
    state = replace(solution.state, spheres=np.zeros_like(problem.centres))
    rows = linearise(problem, state, "cone")
    J = np.zeros((len(members), 3, own.size))
    J[:, :, : own.sphere_column] = rows.J[:, :, : own.sphere_column]
    J[:, :, own.common_column :] = rows.J[:, :, own.sphere_column :]
    position = np.arange(3) + 6 * problem.group[:, None]
    shift = np.take_along_axis(rows.J, position[:, None, :], axis=2)
    by_centre = shift @ solution.state.bases[problem.group, :3, :3]
    return HeldOutRows(problem.image, J, rows.A, rows.r, problem.whiten, by_centre)


def predict(
    solution: Solution, rows: HeldOutRows, *, refined: bool, centre_covariance_m2: Array | None = None
) -> list[Prediction]:
    """Predict residuals of outlines, and compare them with their predicted covariance.

    Args:
        solution: the solution without these outlines.
        rows: the outlines' rows, linearised at the solution.
        refined: true if the prediction uses the pose corrected by its estimated error, false for the pose as given.
        centre_covariance_m2: (O, 3, 3) covariance of each outline's sphere, scan frame.
    """
    gain, Q = solution.pose_gain()[rows.image], solution.marginal.Q[rows.image]
    spread = solution.covariance
    if refined:
        r = rows.r + np.einsum("okj,oj->ok", rows.A, solution.state.poses[rows.image])
        both = rows.J + rows.A @ gain
        predicted = both @ spread @ both.transpose(0, 2, 1) + rows.A @ Q @ rows.A.transpose(0, 2, 1)
    else:
        # The pose's full error counts, except the part that the solution has absorbed.
        r = rows.r
        root = solution.pose_root[rows.image]
        cross = rows.J @ spread @ gain.transpose(0, 2, 1) @ rows.A.transpose(0, 2, 1)
        own = rows.A @ root @ root.transpose(0, 2, 1) @ rows.A.transpose(0, 2, 1)
        predicted = rows.J @ spread @ rows.J.transpose(0, 2, 1) + own + cross + cross.transpose(0, 2, 1)
    if centre_covariance_m2 is not None and rows.by_centre is not None:
        predicted = predicted + rows.by_centre @ centre_covariance_m2 @ rows.by_centre.transpose(0, 2, 1)
    V = predicted + solution.outline_factor * np.eye(3)
    square = np.einsum("oi,oi->o", r, np.linalg.solve(V, r[:, :, None])[:, :, 0])
    colour = np.linalg.inv(rows.whiten)
    size = colour @ V @ colour.transpose(0, 2, 1)
    sigma = np.sqrt((size[:, 0, 0] + size[:, 1, 1]) / 2 + size[:, 2, 2])
    return [Prediction(float(np.sqrt(q / 3)), float(s)) for q, s in zip(square, sigma, strict=True)]


def camera_errors(registration: RegistrationResult, *, refined: bool) -> Array:
    """Compute the (6 N, 6 N) joint covariance of `T_scan_camera`, or of `T_scan_camera_refined`.

    It is that of (d, w) of each pose: exp([w]x) R, t + d, in the axes of the scan, m and rad. It is whole: the
    registration's share is in it. Rows of images at stations without outlines are NaN.

    With B = T_base_scan of an image's station, R its rotation and a the vector from its origin to the camera,
    d_scan = R^T (d - d_B + a x w_B) and w_scan = R^T (w - w_B), where xi = (d, w) is the error of the pose in its
    base. The outlines show that xi = xi_0 + K x + own error, with x the error of the common unknowns, whose
    covariance is C, and own errors of covariance Q. Refined poses have xi_0 taken off. Given ones do not: the
    covariance of their xi is P, and that of xi with x is K C.

    Intrinsics, if uncertain, count with their whole covariance, not with what the outlines leave of it: the poses are
    those of the calibrated lens. So does light of their own on single spheres, which is not estimated.

    Raises:
        DataError: the scale was estimated, so that the poses are not metric.
    """
    s = registration.solution
    problem = s.problem
    if problem.with_scale:
        raise DataError("the errors of poses are stated for metric poses only")
    T_base_camera = s.state.cameras(problem, refined=refined)
    by_base = np.full((problem.n_images, 6, problem.size), np.nan)
    to_scan = np.full((problem.n_images, 6, 6), np.nan)
    for i, k in enumerate(problem.station):
        if k < 0:
            continue
        T_base_scan = s.state.bases[k]
        to_scan[i] = np.kron(np.eye(2), T_base_scan[:3, :3].T)
        moved = -np.eye(6)
        moved[:3, 3:] = skew(T_base_camera[i, :3, 3] - T_base_scan[:3, 3])
        by_base[i] = 0.0
        by_base[i, :, 6 * k : 6 * k + 6] = to_scan[i] @ moved
    by_base = by_base.reshape(-1, problem.size)
    by_pose = (to_scan @ s.pose_gain()).reshape(-1, problem.size)
    through = by_base + by_pose
    known, of_lens = _with_calibrated_lens(s)
    not_estimated = of_lens + s.by_own_light()
    joint = through @ known @ through.T
    if refined:
        joint += through @ not_estimated @ through.T
        covariance = s.marginal.Q
    else:
        joint += by_base @ not_estimated @ by_base.T - by_pose @ known @ by_pose.T
        covariance = s.pose_root @ s.pose_root.transpose(0, 2, 1)
    joint += block_diag(*(to_scan @ covariance @ to_scan.transpose(0, 2, 1)))
    return (joint + joint.T) / 2


def _with_calibrated_lens(s: Solution) -> tuple[Array, Array]:
    """Return (n, n) covariances of the common unknowns: with the lens as calibrated, and what its errors then cause.

    An error e of the lens is one of V e of the unknowns, V the regression of their errors on those of the lens.
    """
    lens = slice(s.problem.lens_column, s.problem.size)
    left_open = s.covariance[lens, lens]
    V = np.linalg.solve(left_open, s.covariance[lens]).T
    prior = np.linalg.inv(s.problem.prior()[lens, lens])
    return s.covariance - V @ left_open @ V.T, V @ prior @ V.T


def with_joint_pose_covariance(registration: RegistrationResult, covariance: Array) -> RegistrationResult:
    """Replace the covariance of a registration by the one for poses from a joint adjustment.

    Errors of neighbouring images in a reconstruction are correlated, so they do not average out like independent
    ones. The estimate is linear in them: with H the information on the common unknowns x, and xi the poses' errors,
    dx = -H^-1 sum_i J' R_i^-1 A_i xi_i, so their part of the covariance is K C K'. It replaces the component "poses".
    With a scale, the result is the covariance of the scan's position relative to the cameras, aligned to the true
    ones by their positions: a scale error that moves the scan with all cameras does not count.

    Args:
        registration: the registration of all images in `covariance`, in the same order.
        covariance: (6 N, 6 N) covariance of the poses given to `register` (positions in their unit, rotation
            vectors), from `similarity_covariance`.

    Raises:
        DataError: the covariance is for another number of images.
    """
    s = registration.solution
    n = len(s.blocks.JA)
    if covariance.shape != (6 * n, 6 * n):
        raise DataError(f"a joint covariance of shape {covariance.shape} does not fit {n} poses")
    unit = np.tile([registration.scale] * 3 + [1.0] * 3, n)
    metric = covariance * np.outer(unit, unit)
    f = s.outline_factor
    towards = s.blocks.JA / f - s.blocks.JA @ s.marginal.Q @ s.blocks.AA / f**2  # (N, n, 6)
    gain = s.covariance @ towards.transpose(1, 0, 2).reshape(-1, 6 * n)
    pick = [*range(6), s.problem.scale_column] if s.problem.with_scale else list(range(6))
    part = (gain @ metric @ gain.T)[np.ix_(pick, pick)]
    over = np.eye(len(pick))
    if s.problem.with_scale:
        positions = registration.T_world_scan @ registration.T_scan_camera
        over[:3, 6] = -np.nanmean(positions[:, :3, 3], axis=0)
    components = {
        name: over @ (part if name == "poses" else component) @ over.T
        for name, component in registration.components.items()
    }
    return dataclasses.replace(
        registration, components=components, covariance=np.sum(list(components.values()), axis=0)
    )


def of_inverse(T_a_b: Transform, covariance: Array) -> Array:
    """Return the covariance of T_b_a (6, 6) from that of T_a_b with R, t: d' = -R^T (d + t x w), w' = -R^T w."""
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = -R.T, -R.T
    J[:3, 3:] = -R.T @ skew(t)
    return J @ covariance @ J.T


def of_product(T_a_b: Transform, T_b_c: Transform, covariance_a_b: Array, covariance_b_c: Array) -> Array:
    """Return the covariance of T_a_c (6, 6) from those of its two independent factors."""
    by_a_b, by_b_c = product_jacobians(T_a_b, T_b_c)
    return by_a_b @ covariance_a_b @ by_a_b.T + by_b_c @ covariance_b_c @ by_b_c.T


def product_jacobians(T_a_b: Transform, T_b_c: Transform) -> tuple[Array, Array]:
    """Return the derivatives (6, 6) of T_a_c by T_a_b and by T_b_c."""
    R = T_a_b[:3, :3]
    moved, turned = np.eye(6), np.zeros((6, 6))
    moved[:3, 3:] = -skew(R @ T_b_c[:3, 3])
    turned[:3, :3], turned[3:, 3:] = R, R
    return moved, turned
