"""Registration: the pose of the scan in the world from sphere outlines in posed images of all stations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from service.compute.descent import halved_gauss_newton
from service.compute.markers.records import SphereOutline
from service.compute.registration.identification.identity import Assignment
from service.compute.registration.least_squares.cost import Cost
from service.compute.registration.least_squares.normal_equations import (
    Blocks,
    compress,
    inverse_symmetric,
    marginalise,
    outline_and_pose_shares,
    pose_errors,
    solve_symmetric,
)
from service.compute.registration.least_squares.problem import Linearised, Problem, State, assemble, linearise
from service.compute.registration.least_squares.start import starting_state
from service.compute.registration.least_squares.variance_components import (
    PoseNoise,
    estimate,
    free_poses,
    given_pose_noise,
    no_pose_noise,
    unknown_pose_noise,
)
from service.compute.registration.result import OutlineResidual, RegistrationResult, Solution
from service.compute.registration.settings import RegistrationSettings
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, inverse

_ROUNDS = 8
_REWEIGHTED = 3  # times, in the approach to the answer
_STEPS = 25
_CONVERGED = 1e-10  # decrement: a hundred-thousandth of a standard deviation
_DEFAULT = RegistrationSettings()

__all__ = ["OutlineResidual", "RegistrationResult", "register"]


def register(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    images: PosedImages,
    spheres: ScanSpheres,
    settings: RegistrationSettings = _DEFAULT,
) -> RegistrationResult:
    """Estimate T_world_scan (and scale, and every station's base) by Gauss–Newton over all outlines.

    An outline contributes its three parameters, weighted by their covariance. Errors of the camera poses, which move
    all spheres of an image together, are marginalised, with their size as stated or estimated from the residuals.
    Errors of the spheres, of the intrinsics and those shared by all outlines are estimated, with their stated sizes
    as priors.

    Args:
        outlines: per image, from the detector.
        assignments: per image, outline index → marker index, and an initial pose (from `identify`).
        images: with their poses; images of one station share a base frame.
        spheres: the registration spheres.
        settings: what is estimated, by which residual, and how well the inputs are known.

    Raises:
        ComputeError: the outlines do not determine the answer, or no convergence.
        DataError: a covariance has the wrong shape.
    """
    problem = assemble(outlines, assignments, images, spheres, settings)
    _require(problem, np.ones(len(problem.members), dtype=bool))
    start = starting_state(problem, assignments, images)
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
        state: of the common unknowns and the pose errors.
        rows: of the outlines there.
        objective: weighted sum of squares, with the priors.
        dx: (n,) step of the common unknowns.
        poses: (N, 6) pose errors after the whole step.
        decrement: of the objective by the step, if the problem were linear.
    """

    state: State
    rows: Linearised
    objective: float
    dx: Array
    poses: Array
    decrement: float


def _descend(problem: Problem, start: State, weighting: _Weighting, cost: Cost) -> _Iterate:
    """Gauss–Newton; a step that would increase the objective is halved.

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
    """Decrease of the objective; growth by rounding alone does not count."""
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
        # From a tenth of a radius on, an outline is doubtful; stated covariances are not used here.
        soft = 1 / (1 + (seen / problem.cones.half_angles / 0.1) ** 2)
        return _Weighting(soft / size * float(np.median(size)), none, 1.0)

    here = _descend(problem, start, weighted(linearise(problem, start, "cone")), "cone")
    for _ in range(_REWEIGHTED):
        here = _descend(problem, here.state, weighted(here.rows), "cone")
    return here


def _robust_weights(
    problem: Problem, here: _Iterate, weighting: _Weighting, keep: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], Array]:
    """Which outlines to keep (O,), by the median of those kept so far, and the weights (O,), 0 for the rest."""
    d, px = _distances(problem, here, weighting)
    typical = float(np.median(px[keep]))
    typical_d = float(np.median(d[keep])) / 1.54  # the median norm of three standard normals
    kept = px < max(5.0 * typical, 0.8)
    return kept, np.where(kept, np.minimum(1.0, 3.0 * typical_d / np.maximum(d, 1e-12)), 0.0)


def _distances(problem: Problem, here: _Iterate, weighting: _Weighting) -> tuple[Array, Array]:
    """Norm of each outline's residual (O,), in its standard deviations and in px, with pose errors removed."""
    blocks = _blocks(problem, here.rows, weighting.outlines)
    m = marginalise(blocks, weighting.pose_root, weighting.factor)
    xi = pose_errors(blocks, m, np.zeros(problem.size), weighting.factor)
    r = here.rows.r + np.einsum("okj,oj->ok", here.rows.A, xi[problem.image])
    return np.linalg.norm(r, axis=1) / np.sqrt(weighting.factor), rms_px(problem, r)


def rms_px(problem: Problem, whitened: Array) -> Array:
    """RMS (O,) in px, over an outline, of its cone's displacement, given as whitened rows (O, 3)."""
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
    """The outlines' residuals; excluded ones with their reason. `given_px` (O,) is with the camera poses as given."""
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
    """T_scan_camera (N, 4, 4), each through the base of its station; NaN for stations without outlines."""
    T = s.state.cameras(s.problem, refined=refined)
    position = {g: k for k, g in enumerate(s.problem.groups)}
    return np.array(
        [
            inverse(s.state.bases[position[int(g)]]) @ T[i] if int(g) in position else np.full((4, 4), np.nan)
            for i, g in enumerate(stations)
        ]
    )


def _components(s: Solution) -> dict[str, Array]:
    """(n, n) parts of the common unknowns' covariance by source, from each source's share of the information."""
    outline, pose = outline_and_pose_shares(s.blocks, s.marginal, s.pose_root, s.outline_factor)
    prior, p = s.problem.prior(), s.problem
    spheres, common = np.zeros_like(prior), np.zeros_like(prior)
    inside = slice(p.sphere_column, p.common_column)
    spheres[inside, inside] = prior[inside, inside]
    common[p.common_column :, p.common_column :] = prior[p.common_column :, p.common_column :]
    parts = {"outlines": outline, "common": common, "poses": pose, "spheres": spheres}
    caused = {name: s.covariance @ part @ s.covariance for name, part in parts.items()}
    return {**caused, "spheres": caused["spheres"] + s.by_own_light()}
