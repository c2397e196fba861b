"""The pose of the scan in the world from sphere outlines in posed images, over all images, markers and stations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.markers.records import SphereOutline
from service.compute.registration.cost import Cost, left_jacobian, residuals, residuals_and_derivative, skew
from service.compute.registration.identity import Assignment
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse, transform


@dataclass(frozen=True, slots=True)
class OutlineResidual:
    """One outline against the solution."""

    image: int
    outline: int  # index in the image's outlines
    marker: int
    rms_px: float
    excluded: bool
    reason: str = ""


@dataclass(frozen=True, slots=True)
class RegistrationResult:
    """The solution.

    `T_world_scan` with world = the base frame of the first group, in metres; camera positions given are multiplied
    by `scale` first. `T_world_group[g]` maps base frame g to the world. `covariance` is (6, 6), or (7, 7) with
    scale, of (x, y, z in metres, rotation vector in radians[, ln scale]) of a perturbation exp(w) R, t + d in world
    axes: 200 points of an outline count as the three numbers that it determines, and residuals larger than the
    outlines' own noise inflate it. `rms_px` is over the points of the outlines that were not excluded.
    """

    T_world_scan: Transform
    scale: float
    T_world_group: dict[int, Transform]
    covariance: Array
    rms_px: float
    residuals: tuple[OutlineResidual, ...]
    T_scan_camera: Array = field(repr=False)  # (N, 4, 4) metric, every image through its own group
    chi2_reduced: float = 1.0
    n_images: int = 0
    cost: str = "sampson"

    @property
    def excluded(self) -> tuple[OutlineResidual, ...]:
        """Outlines left out, with the reason."""
        return tuple(r for r in self.residuals if r.excluded)

    def sigma_at_m(self, point_scan_m: Array) -> float:
        """Predicted standard deviation (3D) of a point (3,) of the scan: the target registration error, in metres."""
        J = np.hstack([np.eye(3), -skew(self.T_world_scan[:3, :3] @ point_scan_m)])
        return float(np.sqrt(np.trace(J @ self.covariance[:6, :6] @ J.T)))


@dataclass(slots=True)
class _Problem:
    """Stacked outlines and the present linearisation point."""

    points: list[Array]  # (L, 3) each
    image: NDArray[np.int64]
    marker: NDArray[np.int64]
    group: NDArray[np.int64]  # position in `groups`
    groups: list[int]
    T_base_camera: Array  # (N, 4, 4)
    centres: Array
    radius_m: float
    axes: Array  # (O, 3) unit directions to the sphere centres
    half_angles: Array  # (O,)
    sigma: Array  # (O,) of one of the L points as an independent measurement, normalised units
    with_scale: bool
    cost: Cost

    def camera_centres(self, bases: Array, scale: float) -> Array:
        """(O, 3) sphere centres in their cameras for `bases` (G, 4, 4) = T_base_scan of each group."""
        base = (
            np.einsum("oij,oj->oi", bases[self.group, :3, :3], self.centres[self.marker]) + bases[self.group, :3, 3]
        )
        T = self.T_base_camera[self.image]
        return np.einsum("oji,oj->oi", T[:, :3, :3], base - scale * T[:, :3, 3])

    def point_residuals(self, bases: Array, scale: float, cost: Cost) -> list[Array]:
        return [
            residuals(p, np.broadcast_to(c, p.shape), self.radius_m, cost)
            for p, c in zip(self.points, self.camera_centres(bases, scale), strict=True)
        ]


def register(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    poses: Array,
    groups: Sequence[int] | NDArray[np.int64],
    centres_scan_m: Array,
    radius_m: float,
    camera: CameraModel,
    *,
    estimate_scale: bool = False,
    cost: Cost = "sampson",
    robust: bool = True,
) -> RegistrationResult:
    """Solve T_world_scan (and scale, and every station's base) by Levenberg–Marquardt over all outlines.

    Args:
        outlines: per image, what the detector found.
        assignments: per image, outline index → marker index, and a starting pose (from `identify`).
        poses: (N, 4, 4) T_world_camera; for groups, T_base_camera of the image's own base.
        groups: (N,) station of each image; images of one group share a base frame.
        centres_scan_m: (M, 3) sphere centres in the scan frame, metres.
        radius_m: of the spheres.
        camera: intrinsics of all images.
        estimate_scale: the camera positions are not metric (structure from motion).
        cost: `sampson` weights points by geometric distance; `algebraic` is the paper's plain x^T E x.
        robust: Huber weights per outline and exclusion of outlines that contradict the rest.

    Raises:
        ComputeError: too few outlines to determine the answer, or no convergence.
    """
    problem, members = _assemble(outlines, assignments, poses, groups, centres_scan_m, radius_m, camera)
    problem.with_scale, problem.cost = estimate_scale, cost
    bases, scale = _start(problem, assignments, poses, np.asarray(groups))
    f = 0.5 * (camera.fx + camera.fy)
    keep = np.ones(len(members), dtype=bool)
    weights = np.ones(len(members))
    bases, scale = _solve(problem, bases, scale, weights)
    rms = np.zeros(len(members))
    for _ in range(6 if robust else 0):
        rms = f * np.array([np.sqrt(np.mean(r**2)) for r in problem.point_residuals(bases, scale, "sampson")])
        typical = float(np.median(rms[keep]))
        new_keep = rms < max(5.0 * typical, 0.8)
        # Huber on the outline as a whole: its 200 points err together.
        new_weights = np.where(new_keep, np.minimum(1.0, 2.0 * max(typical, 0.05) / np.maximum(rms, 1e-9)), 0.0)
        settled = bool(np.array_equal(new_keep, keep) and np.abs(new_weights - weights).max() < 0.02)
        keep, weights = new_keep, new_weights
        _require(problem, keep, members)
        bases, scale = _solve(problem, bases, scale, weights)
        if settled:
            break
    rms = f * np.array([np.sqrt(np.mean(r**2)) for r in problem.point_residuals(bases, scale, "sampson")])
    covariance, chi2 = _covariance(problem, bases, scale, weights)
    T_world_group = {g: bases[0] @ inverse(bases[k]) for k, g in enumerate(problem.groups)}
    metric = np.array(poses, dtype=np.float64)
    metric[:, :3, 3] *= scale
    position = {g: k for k, g in enumerate(problem.groups)}
    T_scan_camera = np.array(
        [
            inverse(bases[position[int(g)]]) @ T if int(g) in position else np.full((4, 4), np.nan)
            for g, T in zip(groups, metric, strict=True)
        ]
    )
    typical = float(np.median(rms[keep]))
    records = tuple(
        OutlineResidual(
            i, j, m, float(rms[o]), not bool(keep[o]),
            "" if keep[o] else f"{rms[o]:.1f} px from its predicted outline, the others {typical:.2f} px",
        )
        for o, (i, j, m) in enumerate(members)
    )  # fmt: skip
    return RegistrationResult(
        T_world_scan=bases[0],
        scale=scale,
        T_world_group=T_world_group,
        covariance=covariance,
        rms_px=float(np.sqrt(np.mean(rms[keep] ** 2))),
        residuals=records,
        T_scan_camera=T_scan_camera,
        chi2_reduced=chi2,
        n_images=len({r.image for r in records if not r.excluded}),
        cost=cost,
    )


def _assemble(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    poses: Array,
    groups: Sequence[int] | NDArray[np.int64],
    centres: Array,
    radius_m: float,
    camera: CameraModel,
) -> tuple[_Problem, list[tuple[int, int, int]]]:
    members = [(i, j, m) for i, a in enumerate(assignments) for j, m in sorted(a.markers.items())]
    if len(members) < 3 or len({m for _, _, m in members}) < 3:
        raise ComputeError(
            f"{len(members)} outlines of {len({m for _, _, m in members})} markers do not determine a registration",
            remedy="Use images in which at least four registration spheres are visible",
        )
    f = 0.5 * (camera.fx + camera.fy)
    points: list[Array] = []
    sigma: list[float] = []
    for i, j, _ in members:
        o = outlines[i][j]
        points.append(np.column_stack([o.points, np.ones(len(o.points))]))
        # L points on a fitted conic carry the information of its n edge points, no more.
        # Beyond it an outline errs as a whole; two of its parameters share each such error.
        variance = max(o.sigma_px, 0.03) ** 2 / max(o.n_edges, 12) + o.systematic_px**2 / 2
        sigma.append(float(np.sqrt(variance * len(o.points))) / f)
    used_groups = [int(groups[i]) for i, _, _ in members]
    first = int(groups[0])
    order = sorted(set(used_groups), key=lambda g: (g != first, g))
    problem = _Problem(
        points=points,
        image=np.array([i for i, _, _ in members]),
        marker=np.array([m for _, _, m in members]),
        group=np.array([order.index(g) for g in used_groups]),
        groups=order,
        T_base_camera=np.asarray(poses, dtype=np.float64),
        centres=centres,
        radius_m=radius_m,
        axes=np.array([outlines[i][j].cone.axis for i, j, _ in members]),
        half_angles=np.array([outlines[i][j].cone.half_angle_rad for i, j, _ in members]),
        sigma=np.array(sigma),
        with_scale=False,
        cost="sampson",
    )
    _require(problem, np.ones(len(members), dtype=bool), members)
    return problem, members


def _require(problem: _Problem, keep: NDArray[np.bool_], members: list[tuple[int, int, int]]) -> None:
    for k, g in enumerate(problem.groups):
        here = keep & (problem.group == k)
        seen = {members[o][2] for o in np.nonzero(here)[0]}
        if len(seen) < 3:
            raise ComputeError(
                f"station {g} has only {len(seen)} markers whose outlines agree with one another; three are needed",
                where=f"station {g}",
                remedy="Check the camera poses of this station, the sphere list and the radius",
            )


def _start(
    problem: _Problem, assignments: Sequence[Assignment], poses: Array, groups: NDArray[np.int64]
) -> tuple[Array, float]:
    """Bases (G, 4, 4) and scale from the assignments' poses: the median image of each group."""
    scale = 1.0
    if problem.with_scale:
        scales = [a.scale for a in assignments if a.scale is not None]
        if scales:
            scale = float(np.median(scales))
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
    return np.array(bases), scale


def _solve(problem: _Problem, bases: Array, scale: float, weights: Array) -> tuple[Array, float]:
    active = [o for o in range(len(weights)) if weights[o] > 0]
    P = np.concatenate([problem.points[o] for o in active])
    count = np.array([len(problem.points[o]) for o in active])
    owner = np.repeat(np.arange(len(active)), count)
    row = np.repeat(np.sqrt(weights[active]) / problem.sigma[active], count)
    unit = 1.0
    if problem.cost == "algebraic":
        # Only a common factor: the algebraic cost keeps its own weighting of the outlines.
        unit = float(np.median(problem.sigma)) / np.sqrt(float(np.mean(count)))
        row = np.repeat(np.sqrt(weights[active]), count) / (unit * 0.1)
    group = problem.group[active]
    T = problem.T_base_camera[problem.image[active]]
    model = problem.centres[problem.marker[active]]
    n_groups = len(problem.groups)
    n = 6 * n_groups + int(problem.with_scale)
    axes, half = problem.axes[active], problem.half_angles[active]

    def unpack(x: Array) -> tuple[Array, float]:
        out = np.tile(np.eye(4), (n_groups, 1, 1))
        for k in range(n_groups):
            d = x[6 * k : 6 * k + 6]
            out[k, :3, :3] = Rotation.from_rotvec(d[3:]).as_matrix() @ bases[k, :3, :3]
            out[k, :3, 3] = bases[k, :3, 3] + d[:3]
        return out, scale * float(np.exp(x[-1])) if problem.with_scale else scale

    def centres(x: Array) -> tuple[Array, Array, float]:
        now, s = unpack(x)
        rotated = np.einsum("oij,oj->oi", now[group, :3, :3], model)
        base = rotated + now[group, :3, 3] - s * T[:, :3, 3]
        return np.einsum("oji,oj->oi", T[:, :3, :3], base), rotated, s

    def directions(x: Array) -> Array:
        c = centres(x)[0]
        distance = np.linalg.norm(c, axis=1)
        return (((c / distance[:, None] - axes) / half[:, None]) * np.sqrt(weights[active])[:, None]).ravel()

    def fun(x: Array) -> Array:
        return residuals(P, centres(x)[0][owner], problem.radius_m, problem.cost) * row

    def jac(x: Array) -> Array:
        c, rotated, s = centres(x)
        slope = residuals_and_derivative(P, c[owner], problem.radius_m, problem.cost)[1] * row[:, None]
        slope = np.einsum("nj,nij->ni", slope, T[owner, :3, :3])  # derivative in base axes
        J = np.zeros((len(P), n))
        for k in range(n_groups):
            here = group[owner] == k
            J[here, 6 * k : 6 * k + 3] = slope[here]
            turn = -skew(rotated) @ left_jacobian(x[6 * k + 3 : 6 * k + 6])
            J[here, 6 * k + 3 : 6 * k + 6] = np.einsum("ni,nij->nj", slope[here], turn[owner[here]])
        if problem.with_scale:
            J[:, -1] = -s * np.einsum("ni,ni->n", slope, T[owner, :3, 3])
        return J

    # The outlines' cost is convex only within a radius: the directions of the centres come first.
    start = least_squares(directions, np.zeros(n), loss="soft_l1", f_scale=0.1, x_scale="jac").x
    tight = 1e-12
    fit = least_squares(
        fun, start, jac=jac, method="lm", x_scale="jac", max_nfev=200, ftol=tight, xtol=tight, gtol=tight
    )
    if not np.all(np.isfinite(fit.x)):
        raise ComputeError("the registration did not converge", remedy="Check the camera poses and the sphere list")
    return unpack(np.asarray(fit.x))


def _covariance(problem: _Problem, bases: Array, scale: float, weights: Array) -> tuple[Array, float]:
    """Covariance of the first group's pose [and ln scale], and the reduced chi square per outline degree of freedom.

    Always in the geometric cost: it is what the outlines' noise means, whichever cost was minimised.
    """
    n_groups = len(problem.groups)
    n = 6 * n_groups + int(problem.with_scale)
    information = np.zeros((n, n))
    chi2, used = 0.0, 0
    centres = problem.camera_centres(bases, scale)
    for o in np.nonzero(weights > 0)[0]:
        p = problem.points[o]
        r, slope = residuals_and_derivative(p, np.broadcast_to(centres[o], p.shape), problem.radius_m, "sampson")
        T = problem.T_base_camera[problem.image[o]]
        k = int(problem.group[o])
        rotated = bases[k, :3, :3] @ problem.centres[problem.marker[o]]
        slope = slope @ T[:3, :3].T
        J = np.zeros((len(p), n))
        J[:, 6 * k : 6 * k + 3] = slope
        J[:, 6 * k + 3 : 6 * k + 6] = slope @ -skew(rotated)
        if problem.with_scale:
            J[:, -1] = -scale * slope @ T[:3, 3]
        information += weights[o] * J.T @ J / problem.sigma[o] ** 2
        chi2 += float(weights[o] * np.sum(r**2) / problem.sigma[o] ** 2)
        used += 1
    free = max(1, 3 * used - n)
    reduced = chi2 / free
    d = 1 / np.sqrt(np.diag(information))
    full = np.linalg.pinv(information * np.outer(d, d)) * np.outer(d, d) * max(1.0, reduced)
    pick = [*range(6), n - 1] if problem.with_scale else list(range(6))
    return full[np.ix_(pick, pick)], reduced
