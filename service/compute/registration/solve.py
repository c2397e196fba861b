"""Registration: the pose of the scan in the world from sphere outlines in posed images of all stations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.markers.records import SphereOutline
from service.compute.registration.cost import Cost
from service.compute.registration.identification.identity import Assignment
from service.compute.registration.normal_equations import (
    Blocks,
    compress,
    inverse_symmetric,
    marginalise,
    outline_and_pose_shares,
    pose_errors,
    solve_symmetric,
)
from service.compute.registration.problem import Linearised, Problem, State, assemble, linearise
from service.compute.registration.result import OutlineResidual, RegistrationResult, Solution
from service.compute.registration.settings import RegistrationSettings
from service.compute.registration.variance_components import (
    PoseNoise,
    estimate,
    given_pose_noise,
    no_pose_noise,
    unknown_pose_noise,
)
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, apply, inverse, transform

_ROUNDS = 8
_STEPS = 25
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
    start = _start(problem, assignments, images.poses, images.stations)
    noise = _noise(problem, settings.pose_covariance, start.scale)
    solution = _solve(problem, start, noise, robust=settings.robust, cost=settings.cost)
    return _result(solution, images.stations, settings.cost)


def _noise(problem: Problem, given: Array | Literal["estimate", "exact"], scale: float) -> PoseNoise:
    n = problem.n_images
    if isinstance(given, str):
        return unknown_pose_noise(n) if given == "estimate" else no_pose_noise(n)
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


def _start(problem: Problem, assignments: Sequence[Assignment], poses: Array, groups: NDArray[np.int64]) -> State:
    """Initial bases and scale from the assignments' poses: the median image of each group."""
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
    """Initial scale from the assignments' poses: R_i c_i + scale p_i (positions p_i) is equal for all i."""
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


@dataclass(frozen=True, slots=True)
class _Weighting:
    """The current weighting of the rows."""

    outlines: Array  # (O,)
    pose_root: Array  # (N, 6, 6)
    factor: float


def _blocks(problem: Problem, rows: Linearised, weights: Array) -> Blocks:
    return compress(rows.J, rows.A, rows.r, problem.image, problem.n_images, weights)


def _descend(problem: Problem, state: State, weighting: _Weighting, cost: Cost) -> State:
    """Gauss–Newton; a step that would increase the objective is halved.

    Halving, not damping: the poses' errors are eliminated with their own covariance, and a shorter step shortens them
    in proportion.
    """
    prior = problem.prior()
    previous, best, dx, poses = np.inf, state, np.zeros(problem.size), state.poses
    share = 1.0
    for _ in range(_STEPS):
        rows = linearise(problem, state, cost)
        blocks = _blocks(problem, rows, weighting.outlines)
        m = marginalise(blocks, weighting.pose_root, weighting.factor)
        held = state.prior_values(problem)
        objective = m.quadratic + float(held @ prior @ held)
        if not np.isfinite(objective):
            raise ComputeError("the registration did not converge", remedy="Check the camera poses and the spheres")
        if objective > previous * (1 + 1e-9) + 1e-9 and share > 1e-3:
            share /= 2
            state = best.moved(problem, share * dx, best.poses + share * (poses - best.poses))
            continue
        previous, best, share = objective, state, 1.0
        g = m.g + prior @ held
        dx = -solve_symmetric(m.H + prior, g)
        poses = pose_errors(blocks, m, dx, weighting.factor)
        state = state.moved(problem, dx, poses)
        # A hundred-thousandth of a standard deviation: converged.
        if float(-g @ dx) < 1e-10:
            return state
    return state


def _solve(problem: Problem, start: State, noise: PoseNoise, *, robust: bool, cost: Cost) -> Solution:
    n = len(problem.members)
    prior = problem.prior()
    scales, factor = np.full(len(noise.parts), 1.0), 1.0
    root = noise.root(scales)
    state = _begin(problem, start)
    keep, weights = np.ones(n, dtype=bool), np.ones(n)
    for turn in range(_ROUNDS if robust else 3):
        rows = linearise(problem, state, "cone")
        blocks = _blocks(problem, rows, weights)
        if robust:
            d, px = _distances(problem, rows, blocks, state, root, factor)
            typical = float(np.median(px[keep]))
            typical_d = float(np.median(d[keep])) / 1.54  # the median norm of three standard normals
            new_keep = px < max(5.0 * typical, 0.8)
            new_weights = np.where(new_keep, np.minimum(1.0, 3.0 * typical_d / np.maximum(d, 1e-12)), 0.0)
            settled = turn > 1 and np.array_equal(new_keep, keep) and np.abs(new_weights - weights).max() < 0.02
            keep, weights = new_keep, new_weights
            _require(problem, keep)
            blocks = _blocks(problem, rows, weights)
        else:
            settled = False
        before = np.maximum(scales, 0.3)
        factor, scales = estimate(blocks, noise, prior, prior @ state.prior_values(problem), (factor, before))
        settled = settled and bool(np.all(scales < 2 * before))
        root = noise.root(scales)
        state = _descend(problem, state, _Weighting(weights, root, factor), "cone")
        if settled:
            break
    if cost != "cone":
        state = _descend(problem, state, _Weighting(weights, root, factor), cost)
    rows = linearise(problem, state, "cone")
    blocks = _blocks(problem, rows, weights)
    m = marginalise(blocks, root, factor)
    return Solution(
        problem, state, weights, blocks, m, rows, inverse_symmetric(m.H + prior), root, factor,
    )  # fmt: skip


def _begin(problem: Problem, start: State) -> State:
    """From the assignments' poses to the neighbourhood of the answer, outlines weighted equally but robustly."""
    state, none = start, np.zeros((problem.n_images, 6, 6))
    for _ in range(4):
        rows = linearise(problem, state, "cone")
        seen = np.linalg.norm(np.linalg.solve(problem.whiten, rows.r[:, :, None])[:, :2, 0], axis=1)
        # From a tenth of a radius on, an outline is doubtful; stated covariances are not used here.
        soft = 1 / (1 + (seen / problem.half_angles / 0.1) ** 2)
        size = np.einsum("oij,oij->o", problem.whiten, problem.whiten)
        weights = soft / size * float(np.median(size))
        state = _descend(problem, state, _Weighting(weights, none, 1.0), "cone")
    return state


def _distances(
    problem: Problem, rows: Linearised, blocks: Blocks, state: State, root: Array, factor: float
) -> tuple[Array, Array]:
    """Norm of each outline's residual (O,), in its standard deviations and in px, with pose errors removed."""
    m = marginalise(blocks, root, factor)
    xi = pose_errors(blocks, m, np.zeros(problem.size), factor)
    r = rows.r + np.einsum("okj,oj->ok", rows.A, xi[problem.image])
    return np.linalg.norm(r, axis=1) / np.sqrt(factor), rms_px(problem, r)


def rms_px(problem: Problem, whitened: Array) -> Array:
    """RMS (O,) in px, over an outline, of its cone's displacement, given as whitened rows (O, 3)."""
    r = np.linalg.solve(problem.whiten, whitened[:, :, None])[:, :, 0]
    # Angles are stretched in the image plane by 1 / cos^2 in the radial direction and by 1 / cos across it.
    stretch = problem.focal_px / problem.axes[:, 2] ** 1.5
    return stretch * np.sqrt(np.sum(r[:, :2] ** 2, axis=1) / 2 + r[:, 2] ** 2)


def _result(s: Solution, groups: NDArray[np.int64], cost: Cost) -> RegistrationResult:
    problem, state = s.problem, s.state
    given = rms_px(problem, s.linearised.r)
    own = s.linearised.r + np.einsum("okj,oj->ok", s.linearised.A, state.poses[problem.image])
    refined = rms_px(problem, own)
    keep = s.weights > 0
    typical = float(np.median(refined[keep]))
    records = tuple(
        OutlineResidual(
            i, j, m, float(given[o]), not bool(keep[o]),
            "" if keep[o] else f"{refined[o]:.1f} px from its predicted outline, the others {typical:.2f} px",
            float(refined[o]),
        )
        for o, (i, j, m) in enumerate(problem.members)
    )  # fmt: skip
    pick = [*range(6), problem.scale_column] if problem.with_scale else list(range(6))
    n_groups = len(problem.groups)
    position = {g: k for k, g in enumerate(problem.groups)}
    cameras: list[Array] = []
    for refine in (False, True):
        T = state.cameras(problem, refined=refine)
        cameras.append(
            np.array(
                [
                    inverse(state.bases[position[int(g)]]) @ T[i] if int(g) in position else np.full((4, 4), np.nan)
                    for i, g in enumerate(groups)
                ]
            )
        )
    plain = marginalise(s.blocks, s.pose_root, 1.0)
    free = max(1.0, 3.0 * float(np.sum(np.minimum(s.weights, 1.0))) - 6 * n_groups - int(problem.with_scale))
    variances = np.diagonal(s.pose_root @ s.pose_root.transpose(0, 2, 1), axis1=1, axis2=2)
    return RegistrationResult(
        T_world_scan=state.bases[0],
        scale=state.scale,
        T_world_group={g: state.bases[0] @ inverse(state.bases[k]) for k, g in enumerate(problem.groups)},
        covariance=s.covariance[np.ix_(pick, pick)],
        rms_px=float(np.sqrt(np.mean(given[keep] ** 2))),
        residuals=records,
        T_scan_camera=cameras[0],
        chi2_reduced=plain.quadratic / free,
        n_images=len({r.image for r in records if not r.excluded}),
        cost=cost,
        components={name: part[np.ix_(pick, pick)] for name, part in _components(s).items()},
        group_covariance={
            g: s.covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k, g in enumerate(problem.groups)
        },
        T_scan_camera_refined=cameras[1],
        pose_sigma=(float(np.sqrt(variances[:, :3].mean())), float(np.sqrt(variances[:, 3:].mean()))),
        outline_factor=s.outline_factor,
        sphere_offsets_m=state.spheres,
        common_px=state.common[:6],
        solution=s,
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
    return {name: s.covariance @ part @ s.covariance for name, part in parts.items()}
