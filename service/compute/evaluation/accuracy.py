"""Accuracy of a registration: the paper's two errors on control spheres, and the true error if truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.markers.records import SphereOutline
from service.compute.registration.cost import residuals
from service.compute.registration.identity import Assignment
from service.compute.registration.problem import (
    compress,
    inverse_symmetric,
    marginalise,
    pose_errors,
    solve_symmetric,
)
from service.compute.registration.result import (
    HeldOutRows,
    Prediction,
    RegistrationResult,
    Solution,
    held_out_rows,
    predict,
)
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, align_points, apply, inverse
from service.core.units import mm


@dataclass(frozen=True, slots=True)
class ControlSphereError:
    """One control sphere in one image."""

    image: int
    outline: int
    sphere: int
    radial_error_mm: float
    reprojection_error_px: float
    sigma_mm: float | None = None  # predicted rms of the radial error; None without given covariances
    normalised: float | None = None  # rms of its three residuals over their predicted sigmas


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Means over all outline points of all control spheres in all images."""

    mean_radial_error_mm: float
    mean_reprojection_error_px: float
    errors: tuple[ControlSphereError, ...]

    def per_sphere(self) -> dict[int, tuple[float, float, int]]:
        """Map each sphere to its mean radial error (mm), mean reprojection error (px) and number of images."""
        out: dict[int, tuple[float, float, int]] = {}
        for s in sorted({e.sphere for e in self.errors}):
            mine = [e for e in self.errors if e.sphere == s]
            radial = float(np.mean([e.radial_error_mm for e in mine]))
            out[s] = (radial, float(np.mean([e.reprojection_error_px for e in mine])), len(mine))
        return out


def radial_errors_m(points: Array, centre_camera_m: Array, radius_m: float) -> Array:
    """Return the distances (L,) between the rays through normalised points (L, 2) and the surface of the sphere."""
    rays = np.column_stack([points, np.ones(len(points))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = rays @ centre_camera_m
    return np.abs(np.linalg.norm(centre_camera_m - along[:, None] * rays, axis=1) - radius_m)


def evaluate(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    images: PosedImages,
    controls: ScanSpheres,
    *,
    registration: RegistrationResult | None = None,
) -> Evaluation:
    """Compute the errors of spheres that were not used in the registration.

    Args:
        outlines: the outlines of each image.
        assignments: outline → index into the control spheres' centres, for each image.
        images: the camera, and registered poses T_scan_camera, metric.
        controls: the control spheres as `centres_m`, with their covariance.
        registration: predicts the errors; its covariance gives `sigma_mm` and `normalised`. The poses must be its
            `T_scan_camera` or its `T_scan_camera_refined`.

    Both errors are the paper's: radial, the mean distance between the rays of the outline's points and the surface of
    the sphere; reprojection, the mean distance of the points from the projected outline (geometric, to first order).

    Raises:
        ComputeError: no control sphere was seen.
    """
    members = [(i, j, s) for i, a in enumerate(assignments) for j, s in sorted(a.markers.items())]
    if not members:
        raise ComputeError(
            "no control sphere was found in any image", remedy="Capture control images before the spheres are removed"
        )
    stated = None
    if registration is not None:
        refined = bool(np.allclose(images.poses, registration.T_scan_camera_refined, atol=1e-12, equal_nan=True))
        rows = held_out_rows(registration.solution, outlines, members, controls.centres_m)
        spread = None if controls.covariance_m2 is None else controls.covariance_m2[[s for _, _, s in members]]
        stated = predict(registration.solution, rows, refined=refined, centre_covariance_m2=spread)
    errors: list[ControlSphereError] = []
    for k, (i, j, s) in enumerate(members):
        centre = apply(inverse(images.poses[i]), controls.centres_m[s])
        distances = _distances(outlines[i][j].points, centre, controls.radius_m, images.camera)
        errors.append(_error((i, j, s), distances, centre, None if stated is None else stated[k]))
    return _summary(errors)


def leave_one_out(registration: RegistrationResult, *, refined: bool = False) -> Evaluation:
    """Evaluate each registration sphere as predicted from the others, for an evaluation without control spheres.

    Args:
        registration: the registration with its solution, from which each sphere's outlines are removed in turn (one
            linear step; the weights of the outlines and the variance components stay).
        refined: true to predict with the camera poses corrected by their errors, estimated from the other spheres.

    A sphere without which a station would see fewer than three is left out of the result.

    Raises:
        ComputeError: no sphere can be removed.
    """
    full = registration.solution
    problem = full.problem
    errors: list[ControlSphereError] = []
    for m in sorted(set(problem.marker.tolist())):
        out = problem.marker == m
        weights = np.where(out, 0.0, full.weights)
        if any(len(set(problem.marker[(weights > 0) & (problem.group == k)].tolist())) < 3
               for k in range(len(problem.groups))):  # fmt: skip
            continue
        rest = _without(full, weights)
        mine = np.nonzero(out & (full.weights > 0))[0]
        lines = full.linearised
        r = lines.r[mine] + lines.J[mine] @ rest.step
        rows = HeldOutRows(problem.image[mine], lines.J[mine], lines.A[mine], r, problem.whiten[mine])
        stated = predict(rest.solution, rows, refined=refined)
        T = rest.solution.state.cameras(problem, refined=refined)
        for o, prediction in zip(mine, stated, strict=True):
            i, j, _ = problem.members[o]
            base = rest.solution.state.bases[problem.group[o]]
            centre = apply(inverse(T[i]) @ base, problem.centres[m])
            distances = _distances(problem.outlines[o].points, centre, problem.radius_m, problem.camera)
            errors.append(_error((i, j, m), distances, centre, prediction))
    if not errors:
        raise ComputeError("no sphere can be left out: each is needed", remedy="Use more registration spheres")
    return _summary(errors)


@dataclass(frozen=True, slots=True)
class _PartialSolution:
    solution: Solution
    step: Array  # (n,) of the common unknowns


def _without(full: Solution, weights: Array) -> _PartialSolution:
    problem, lines, prior = full.problem, full.linearised, full.problem.prior()
    blocks = compress(lines.J, lines.A, lines.r, problem.image, problem.n_images, weights)
    marginal = marginalise(blocks, full.pose_root, full.outline_factor)
    H = marginal.H + prior
    dx = -solve_symmetric(H, marginal.g + prior @ full.state.prior_values(problem))
    state = full.state.moved(problem, dx, pose_errors(blocks, marginal, dx, full.outline_factor))
    solution = replace(
        full, state=state, weights=weights, blocks=blocks, marginal=marginal, covariance=inverse_symmetric(H)
    )
    return _PartialSolution(solution, dx)


def _distances(points: Array, centre: Array, radius_m: float, camera: CameraModel) -> tuple[float, float]:
    """Return the mean radial distance in metres and mean reprojection error in px of an outline's points."""
    radial = radial_errors_m(points, centre, radius_m)
    lifted = np.column_stack([points, np.ones(len(points))])
    distance = np.abs(residuals(lifted, np.broadcast_to(centre, lifted.shape), radius_m, "sampson"))
    return float(radial.mean()), float(distance.mean()) * 0.5 * (camera.fx + camera.fy)


def _error(
    member: tuple[int, int, int], distances: tuple[float, float], centre: Array, stated: Prediction | None
) -> ControlSphereError:
    """Return the record of one outline (image, outline, sphere)."""
    radial_m, reprojection_px = distances
    return ControlSphereError(
        *member,
        mm(radial_m),
        reprojection_px,
        None if stated is None else mm(stated.sigma_rad * float(np.linalg.norm(centre))),
        None if stated is None else stated.normalised,
    )


def _summary(errors: list[ControlSphereError]) -> Evaluation:
    return Evaluation(
        float(np.mean([e.radial_error_mm for e in errors])),
        float(np.mean([e.reprojection_error_px for e in errors])),
        tuple(errors),
    )


def true_error_m(T_scan_camera: Array, T_scan_camera_true: Array, centre_scan_m: Array) -> float:
    """Return the distance by which the scene's centre is misplaced when the cameras are aligned to the true ones.

    Args:
        T_scan_camera: (N, 4, 4) registered cameras in the scan frame, metric.
        T_scan_camera_true: (N, 4, 4) truth.
        centre_scan_m: (3,) a point of the scene, in the scan frame.

    The estimated camera positions are aligned to the true ones by a rigid fit T, because the world frame of structure
    from motion is arbitrary; the error is |T c - c|, metres.
    """
    good = np.all(np.isfinite(T_scan_camera.reshape(len(T_scan_camera), -1)), axis=1)
    T_true_estimated, _ = align_points(T_scan_camera_true[good, :3, 3], T_scan_camera[good, :3, 3])
    return float(np.linalg.norm(apply(T_true_estimated, centre_scan_m) - centre_scan_m))
