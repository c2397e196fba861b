"""Registers: finds the pose of the scan in the world from sphere outlines in posed images of all stations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from service.compute.descent import halved_gauss_newton
from service.compute.markers.records import SphereOutline
from service.compute.registration.identity import Assignment
from service.compute.registration.problem import (
    Blocks,
    Cost,
    Linearised,
    Problem,
    RegistrationSettings,
    State,
    assemble,
    compress,
    inverse_symmetric,
    linearise,
    marginalise,
    outline_and_pose_shares,
    pose_errors,
    solve_symmetric,
)
from service.compute.registration.result import OutlineResidual, RegistrationResult, Solution
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, apply, inverse, transform

_ROUNDS = 8
_REWEIGHTED = 3  # times, in the approach to the answer
_STEPS = 25
_CONVERGED = 1e-10  # decrement: a hundred-thousandth of a standard deviation
_DEFAULT = RegistrationSettings()


def register(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    images: PosedImages,
    spheres: ScanSpheres,
    settings: RegistrationSettings = _DEFAULT,
) -> RegistrationResult:
    """Estimate T_world_scan (and scale, and every station's base) by Gauss–Newton over all outlines.

    An outline contributes its three parameters, weighted by their covariance. Errors of the camera poses, which move
    all spheres of an image together, are marginalised, with their size as given or estimated from the residuals.
    Errors of the spheres, of the intrinsics and those shared by all outlines are estimated, with their given sizes
    as priors.

    Args:
        outlines: the detector's outlines of each image.
        assignments: outline index → marker index of each image, and an initial pose (from `identify`).
        images: the images with their poses; images of one station share a base frame.
        spheres: the registration spheres.
        settings: the unknowns, the residual, and how well the inputs are known.

    Raises:
        ComputeError: the outlines do not determine the answer, or no convergence.
        DataError: a covariance has the wrong shape.
    """
    problem = assemble(outlines, assignments, images, spheres, settings)
    _require(problem, np.ones(len(problem.members), dtype=bool))
    start = _starting_state(problem, assignments, images)
    noise = _noise(problem, settings.pose_covariance, start.scale)
    solution = _solve(problem, start, noise, robust=settings.robust, cost=settings.cost)
    return _result(solution, images.stations, settings.cost)


def _noise(problem: Problem, given: Array | Literal["estimate", "exact", "free"], scale: float) -> PoseNoise:
    n = problem.n_images
    if isinstance(given, str):
        return {"estimate": unknown_pose_noise, "exact": no_pose_noise, "free": free_poses}[given](n)
    if given.shape != (n, 6, 6):
        raise DataError(f"covariances of poses have the shape {given.shape}, not {(n, 6, 6)}")
    unit = np.array([scale] * 3 + [1.0] * 3)
    return given_pose_noise(given * unit[:, None] * unit)


def _require(problem: Problem, keep: NDArray[np.bool_]) -> None:
    for k, g in enumerate(problem.groups):
        seen = set(problem.marker[keep & (problem.group == k)].tolist())
        if len(seen) < 3:
            raise ComputeError(
                f"station {g} has only {len(seen)} markers whose outlines agree with one another; three are needed",
                where=f"station {g}",
                remedy="Check the camera poses of this station, the sphere list and the radius",
            )


@dataclass(frozen=True, slots=True)
class _Weighting:
    """The current weighting of the rows."""

    outlines: Array  # (O,)
    pose_root: Array  # (N, 6, 6)
    factor: float


def _blocks(problem: Problem, rows: Linearised, weights: Array) -> Blocks:
    return compress(rows.J, rows.A, rows.r, problem.image, problem.n_images, weights)


@dataclass(frozen=True, slots=True)
class _Iterate:
    """A state with its rows, its objective, and the Gauss–Newton step from it.

    Attributes:
        state: state of the common unknowns and the pose errors.
        rows: rows of the outlines there.
        objective: weighted sum of squares, with the priors.
        dx: (n,) step of the common unknowns.
        poses: (N, 6) pose errors after the whole step.
        decrement: decrease of the objective by the step, if the problem were linear.
    """

    state: State
    rows: Linearised
    objective: float
    dx: Array
    poses: Array
    decrement: float


def _descend(problem: Problem, start: State, weighting: _Weighting, cost: Cost) -> _Iterate:
    """Descend by Gauss–Newton; a step that would increase the objective is halved.

    Halving, not damping: the poses' errors are eliminated with their own covariance, and a shorter step shortens them
    in proportion.

    Raises:
        ComputeError: the objective is not finite.
    """
    prior = problem.prior()

    def at(state: State) -> _Iterate:
        rows = linearise(problem, state, cost)
        blocks = _blocks(problem, rows, weighting.outlines)
        m = marginalise(blocks, weighting.pose_root, weighting.factor)
        held = state.prior_values(problem)
        objective = m.quadratic + float(held @ prior @ held)
        if not np.isfinite(objective):
            raise ComputeError("the registration did not converge", remedy="Check the camera poses and the spheres")
        g = m.g + prior @ held
        dx = -solve_symmetric(m.H + prior, g)
        poses = pose_errors(blocks, m, dx, weighting.factor)
        return _Iterate(state, rows, objective, dx, poses, float(-g @ dx))

    def candidate(here: _Iterate, share: float) -> _Iterate:
        before = here.state.poses
        poses = here.poses if share == 1.0 else before + share * (here.poses - before)
        return at(here.state.moved(problem, share * here.dx, poses))

    return halved_gauss_newton(
        at(start),
        candidate,
        _gain,
        lambda here, _there: here.decrement < _CONVERGED,
        most=_STEPS,
    ).state


def _gain(here: _Iterate, there: _Iterate) -> float:
    """Return the decrease of the objective; growth by rounding alone does not count."""
    return here.objective * (1 + 1e-9) + 1e-9 - there.objective


def _solve(problem: Problem, start: State, noise: PoseNoise, *, robust: bool, cost: Cost) -> Solution:
    """Alternate between the weights of the outlines, the variance components and a descent, until they settle."""
    prior = problem.prior()
    scales, factor = np.full(len(noise.parts), 1.0), 1.0
    root = noise.root(scales)
    here = _begin(problem, start)
    keep, weights = np.ones(len(problem.members), dtype=bool), np.ones(len(problem.members))
    for turn in range(_ROUNDS if robust else 3):
        settled = False
        if robust:
            new_keep, new_weights = _robust_weights(problem, here, _Weighting(weights, root, factor), keep)
            settled = turn > 1 and np.array_equal(new_keep, keep) and np.abs(new_weights - weights).max() < 0.02
            keep, weights = new_keep, new_weights
            _require(problem, keep)
        blocks = _blocks(problem, here.rows, weights)
        before = np.maximum(scales, 0.3)
        factor, scales = estimate(blocks, noise, prior, prior @ here.state.prior_values(problem), (factor, before))
        settled = settled and bool(np.all(scales < 2 * before))
        root = noise.root(scales)
        here = _descend(problem, here.state, _Weighting(weights, root, factor), "cone")
        if settled:
            break
    if cost != "cone":
        here = _descend(problem, here.state, _Weighting(weights, root, factor), cost)
    rows = here.rows if cost == "cone" else linearise(problem, here.state, "cone")
    blocks = _blocks(problem, rows, weights)
    m = marginalise(blocks, root, factor)
    return Solution(
        problem, here.state, weights, blocks, m, rows, inverse_symmetric(m.H + prior), root, factor,
    )  # fmt: skip


def _begin(problem: Problem, start: State) -> _Iterate:
    """Bring the poses of the assignments close to the solution, with equal but robust weights of the outlines."""
    none = np.zeros((problem.n_images, 6, 6))
    size = np.einsum("oij,oij->o", problem.whiten, problem.whiten)

    def weighted(rows: Linearised) -> _Weighting:
        seen = np.linalg.norm(np.linalg.solve(problem.whiten, rows.r[:, :, None])[:, :2, 0], axis=1)
        # From a tenth of a radius on, an outline is doubtful; given covariances are not used here.
        soft = 1 / (1 + (seen / problem.cones.half_angles / 0.1) ** 2)
        return _Weighting(soft / size * float(np.median(size)), none, 1.0)

    here = _descend(problem, start, weighted(linearise(problem, start, "cone")), "cone")
    for _ in range(_REWEIGHTED):
        here = _descend(problem, here.state, weighted(here.rows), "cone")
    return here


def _robust_weights(
    problem: Problem, here: _Iterate, weighting: _Weighting, keep: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], Array]:
    """Select the outlines (O,) by the median of those selected so far, and their weights (O,), 0 for the rest."""
    d, px = _distances(problem, here, weighting)
    typical = float(np.median(px[keep]))
    typical_d = float(np.median(d[keep])) / 1.54  # the median norm of three standard normals
    kept = px < max(5.0 * typical, 0.8)
    return kept, np.where(kept, np.minimum(1.0, 3.0 * typical_d / np.maximum(d, 1e-12)), 0.0)


def _distances(problem: Problem, here: _Iterate, weighting: _Weighting) -> tuple[Array, Array]:
    """Return norms of outlines' residuals (O,), in standard deviations and in px, with pose errors removed."""
    blocks = _blocks(problem, here.rows, weighting.outlines)
    m = marginalise(blocks, weighting.pose_root, weighting.factor)
    xi = pose_errors(blocks, m, np.zeros(problem.size), weighting.factor)
    r = here.rows.r + np.einsum("okj,oj->ok", here.rows.A, xi[problem.image])
    return np.linalg.norm(r, axis=1) / np.sqrt(weighting.factor), rms_px(problem, r)


def rms_px(problem: Problem, whitened: Array) -> Array:
    """Return the RMS (O,) in px, over an outline, of its cone's displacement, given as whitened rows (O, 3)."""
    r = np.linalg.solve(problem.whiten, whitened[:, :, None])[:, :, 0]
    # Angles are stretched in the image plane by 1 / cos^2 in the radial direction and by 1 / cos across it.
    stretch = problem.focal_px / problem.cones.axes[:, 2] ** 1.5
    return stretch * np.sqrt(np.sum(r[:, :2] ** 2, axis=1) / 2 + r[:, 2] ** 2)


def _result(s: Solution, stations: NDArray[np.int64], cost: Cost) -> RegistrationResult:
    problem, state = s.problem, s.state
    keep = s.weights > 0
    given_px = rms_px(problem, s.linearised.r)
    residuals = _residuals(s, given_px)
    pick = [*range(6), problem.scale_column] if problem.with_scale else list(range(6))
    plain = marginalise(s.blocks, s.pose_root, 1.0)
    free = 3.0 * float(np.sum(np.minimum(s.weights, 1.0))) - 6 * len(problem.groups) - int(problem.with_scale)
    variances = np.diagonal(s.pose_root @ s.pose_root.transpose(0, 2, 1), axis1=1, axis2=2)
    return RegistrationResult(
        T_world_scan=state.bases[0],
        scale=state.scale,
        T_world_group={g: state.bases[0] @ inverse(state.bases[k]) for k, g in enumerate(problem.groups)},
        covariance=(s.covariance + s.by_own_light())[np.ix_(pick, pick)],
        rms_px=float(np.sqrt(np.mean(given_px[keep] ** 2))),
        residuals=residuals,
        T_scan_camera=_cameras_in_scan(s, stations, refined=False),
        chi2_reduced=plain.quadratic / max(1.0, free),
        n_images=len({r.image for r in residuals if not r.excluded}),
        cost=cost,
        components={name: part[np.ix_(pick, pick)] for name, part in _components(s).items()},
        T_scan_camera_refined=_cameras_in_scan(s, stations, refined=True),
        pose_sigma=(float(np.sqrt(variances[:, :3].mean())), float(np.sqrt(variances[:, 3:].mean()))),
        outline_factor=s.outline_factor,
        solution=s,
    )


def _residuals(s: Solution, given_px: Array) -> tuple[OutlineResidual, ...]:
    """List outlines' residuals; excluded ones with a reason. `given_px` (O,) is with the camera poses as given."""
    problem = s.problem
    own = s.linearised.r + np.einsum("okj,oj->ok", s.linearised.A, s.state.poses[problem.image])
    refined_px, keep = rms_px(problem, own), s.weights > 0
    typical_px = float(np.median(refined_px[keep]))
    return tuple(
        OutlineResidual(
            i, j, m, float(given_px[o]), not bool(keep[o]),
            "" if keep[o] else f"{refined_px[o]:.1f} px from its predicted outline, the others {typical_px:.2f} px",
        )
        for o, (i, j, m) in enumerate(problem.members)
    )  # fmt: skip


def _cameras_in_scan(s: Solution, stations: NDArray[np.int64], *, refined: bool) -> Array:
    """Return T_scan_camera (N, 4, 4), each through the base of its station; NaN for stations without outlines."""
    T = s.state.cameras(s.problem, refined=refined)
    position = {g: k for k, g in enumerate(s.problem.groups)}
    return np.array(
        [
            inverse(s.state.bases[position[int(g)]]) @ T[i] if int(g) in position else np.full((4, 4), np.nan)
            for i, g in enumerate(stations)
        ]
    )


def _components(s: Solution) -> dict[str, Array]:
    """Return (n, n) parts of the common unknowns' covariance by source, from each one's share of the information."""
    outline, pose = outline_and_pose_shares(s.blocks, s.marginal, s.pose_root, s.outline_factor)
    prior, p = s.problem.prior(), s.problem
    spheres, common = np.zeros_like(prior), np.zeros_like(prior)
    inside = slice(p.sphere_column, p.common_column)
    spheres[inside, inside] = prior[inside, inside]
    common[p.common_column :, p.common_column :] = prior[p.common_column :, p.common_column :]
    parts = {"outlines": outline, "common": common, "poses": pose, "spheres": spheres}
    caused = {name: s.covariance @ part @ s.covariance for name, part in parts.items()}
    return {**caused, "spheres": caused["spheres"] + s.by_own_light()}


def _starting_state(problem: Problem, assignments: Sequence[Assignment], images: PosedImages) -> State:
    """Return initial bases and scale by the assignments' poses: means of the half of a station's images that agree.

    Raises:
        ComputeError: a station has no image with a pose, or the poses do not determine the scale.
    """
    poses, groups = images.poses, images.stations
    scale = 1.0
    if problem.with_scale:
        scales = [a.scale for a in assignments if a.scale is not None]
        scale = float(np.median(scales)) if scales else _scale(problem, assignments, poses, groups)
    bases: list[Transform] = []
    for g in problem.groups:
        candidates: list[Transform] = []
        for i, a in enumerate(assignments):
            if int(groups[i]) == g and a.T_camera_scan is not None:
                T = np.array(poses[i], dtype=np.float64)
                T[:3, 3] *= scale
                candidates.append(T @ a.T_camera_scan)
        if not candidates:
            raise ComputeError(f"no image of station {g} has a starting pose", where=f"station {g}")
        middle = problem.centres.mean(axis=0)
        places = np.array([apply(T, middle) for T in candidates])
        far = np.linalg.norm(places - np.median(places, axis=0), axis=1)
        near = np.argsort(far)[: max(1, (len(far) + 1) // 2)]
        R = Rotation.from_matrix(np.array([candidates[k][:3, :3] for k in near])).mean()
        bases.append(transform(R, places[near].mean(axis=0) - R.apply(middle)))
    n = problem.n_images
    return State(
        np.array(bases),
        scale,
        np.zeros_like(problem.centres),
        np.zeros(problem.size - problem.common_column),
        np.zeros((n, 6)),
    )


def _scale(problem: Problem, assignments: Sequence[Assignment], poses: Array, groups: NDArray[np.int64]) -> float:
    """Return the initial scale by the assignments' poses: R_i c_i + scale p_i (positions p_i) is equal for all i."""
    middle = problem.centres.mean(axis=0)
    upper, lower = 0.0, 0.0
    for g in problem.groups:
        mine = {
            i: poses[i][:3, :3] @ apply(a.T_camera_scan, middle)
            for i, a in enumerate(assignments)
            if int(groups[i]) == g and a.T_camera_scan is not None
        }
        if len(mine) < 2:
            continue
        seen = np.array(list(mine.values()))
        position = poses[list(mine), :3, 3] - poses[list(mine), :3, 3].mean(axis=0)
        upper -= float(np.sum(position * (seen - seen.mean(axis=0))))
        lower += float(np.sum(position**2))
    if upper <= 0.0 or lower <= 0.0:
        raise ComputeError(
            "the scale of the camera positions cannot be determined from the images alone",
            remedy="Use poses of several images of the same scene, from different places",
        )
    return upper / lower


_FACTOR = (0.02, 1e4)  # range for the outlines' variance
_POSE = (1e-3, 1e3)  # range for the square roots below
_GROWTH = 5.0  # largest growth of the square roots of the pose noise in one estimate


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Square roots of the covariances of the pose errors, as a sum of parts with one factor each.

    `parts` (K, N, 6, 6) must act on different rows (translation, rotation), or there is only one; `least` is the
    smallest allowed factor; `free` says whether the factors are estimated.
    """

    parts: Array
    least: float
    free: bool

    def root(self, factors: Array) -> Array:
        """Return (N, 6, 6) such that root @ root.T is the covariance."""
        return np.einsum("k,knij->nij", factors, self.parts)


def no_pose_noise(n_images: int) -> PoseNoise:
    """Return no pose errors: poses are taken as exact."""
    return PoseNoise(np.zeros((1, n_images, 6, 6)), 1.0, free=False)


def free_poses(n_images: int) -> PoseNoise:
    """Return noise of 0.1 m and 0.1 rad: hundreds of times what the outlines of four spheres leave open."""
    return PoseNoise(np.tile(0.1 * np.eye(6), (1, n_images, 1, 1)), 1.0, free=False)


def unknown_pose_noise(n_images: int) -> PoseNoise:
    """Return isotropic noise of position and orientation, equal for all images, in units of 0.1 mm and 0.1 mrad."""
    parts = np.zeros((2, n_images, 6, 6))
    parts[0, :, :3, :3] = 1e-4 * np.eye(3)
    parts[1, :, 3:, 3:] = 1e-4 * np.eye(3)
    return PoseNoise(parts, _POSE[0], free=True)


def given_pose_noise(covariance: Array) -> PoseNoise:
    """Return the given covariances (N, 6, 6); the residuals can increase them, never decrease them."""
    values, vectors = np.linalg.eigh((covariance + covariance.transpose(0, 2, 1)) / 2)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return PoseNoise(root[None], 1.0, free=True)


def estimate(
    blocks: Blocks, noise: PoseNoise, prior: Array, prior_gradient: Array, start: tuple[float, Array]
) -> tuple[float, Array]:
    """Estimate the variance factors of the outlines and of the pose noise (K,) by restricted maximum likelihood.

    Args:
        blocks: linearised at the current solution.
        noise: the model of the pose noise.
        prior: (n, n) prior information on the common unknowns.
        prior_gradient: (n,) gradient of the prior at the current solution.
        start: current values.

    Source: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal",
    Biometrika 58(3), 1971. A wide prior on the logarithm of the outlines' factor limits the influence of few
    residuals.

    The pose noise grows at most fivefold at a time. If residuals are far larger than given, the minimiser's first
    step would otherwise make the poses carry no information, from which neither it nor the solution recovers.
    """
    n_free = len(start[1]) if noise.free else 0
    most = np.log(np.clip(_GROWTH * start[1][:n_free], max(noise.least, _POSE[0]) * _GROWTH, _POSE[1]))
    lower = [np.log(_FACTOR[0]) / 2, *([np.log(noise.least)] * n_free)]
    upper = [np.log(_FACTOR[1]) / 2, *most.tolist()]

    def cost(y: Array) -> float:
        factor = float(np.exp(2 * y[0]))
        scales = np.exp(y[1:]) if n_free else start[1]
        m = marginalise(blocks, noise.root(scales), factor)
        H, g = m.H + prior, m.g + prior_gradient
        # A common unknown on which these poses have no information, except by rounding, is left out.
        told = np.diag(H) > 0
        d = np.where(told, 1 / np.sqrt(np.where(told, np.diag(H), 1.0)), 0.0)
        values, vectors = np.linalg.eigh(H * np.outer(d, d))
        good = values > 1e-13
        projected = vectors.T @ (d * g)
        gain = float(np.sum(projected[good] ** 2 / values[good]))
        log_H = float(np.sum(np.log(values[good])) - 2 * np.sum(np.log(d[told])))
        return m.quadratic - gain + m.log_determinant + log_H + y[0] ** 2

    at = np.clip(
        np.concatenate([[0.5 * np.log(start[0])], np.log(np.maximum(start[1][:n_free], 1e-12))]), lower, upper
    )
    best = minimize(cost, at, method="L-BFGS-B", bounds=list(zip(lower, upper, strict=True)))
    y = np.asarray(best.x, dtype=np.float64)
    return float(np.exp(2 * y[0])), np.exp(y[1:]) if n_free else start[1]
