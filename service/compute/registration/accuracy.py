"""Accuracy of a registration: the paper's two errors, constellations compared, the true error, the error budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.descent import gauss_newton
from service.compute.markers.cones import ObservedCones
from service.compute.markers.records import SphereOutline
from service.compute.registration.identity import Assignment
from service.compute.registration.problem import (
    compress,
    inverse_symmetric,
    marginalise,
    pose_errors,
    residuals,
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
from service.core.geometry import Array, Transform, align_points, apply, increment, inverse, place_jacobian
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


_MAX_STEPS = 20
_OUTLIER_SIGMA = 4.0


@dataclass(frozen=True, slots=True)
class TriangulatedSphere:
    """A sphere located from images alone: centre (3,) and covariance (3, 3) in the scan frame, metres."""

    centre_m: Array
    covariance_m2: Array = field(repr=False)
    n_images: int


@dataclass(frozen=True, slots=True)
class Closure:
    """Comparison of two measurements of the same spheres.

    Attributes:
        n: number of spheres compared.
        rms_m: root mean square of the distances (3D), after the alignment if there is one.
        predicted_m: rms predicted from the covariances.
        normalised_chi2: squared Mahalanobis distance per degree of freedom; near 1 if the covariances are right.
    """

    n: int
    rms_m: float
    predicted_m: float
    normalised_chi2: float


@dataclass(frozen=True, slots=True)
class Alignment:
    """T_a_b and its covariance (6, 6) of (d, w): exp(w) R, t + d, in the axes of a, metres and radians."""

    T_a_b: Transform
    covariance: Array = field(repr=False)

    def covariance_at_m2(self, points_b_m: Array) -> Array:
        """Return (n, 3, 3) covariance, in the axes of a, that the alignment's error adds to points (n, 3) of b."""
        J = place_jacobian(points_b_m @ self.T_a_b[:3, :3].T)
        return J @ self.covariance @ J.transpose(0, 2, 1)


def locate_in_images(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    T_scan_camera: Array,
    starts_scan_m: Array,
    radius_m: float,
    *,
    least_images: int = 3,
) -> dict[int, TriangulatedSphere]:
    """Locate the centres of spheres from their outlines and the registered cameras, each sphere on its own.

    Weighted least squares of the cones' three parameters (`ObservedCones`); outlines more than 4 sigma from the
    others of their sphere are excluded. The covariance follows from the outlines', inflated if they scatter more.

    Args:
        outlines: the outlines of each image.
        assignments: outline → index into `starts_scan_m`, for each image.
        T_scan_camera: (N, 4, 4), metric.
        starts_scan_m: (M, 3) approximate centres.
        radius_m: radius of the spheres.
        least_images: spheres seen in fewer images are not returned.
    """
    seen: dict[int, list[tuple[int, SphereOutline]]] = {}
    for i, assignment in enumerate(assignments):
        for j, m in assignment.markers.items():
            seen.setdefault(m, []).append((i, outlines[i][j]))
    found = {
        m: _intersect(mine, T_scan_camera, starts_scan_m[m], radius_m, least_images)
        for m, mine in sorted(seen.items())
        if len(mine) >= least_images
    }
    return {m: sphere for m, sphere in found.items() if sphere.n_images >= least_images}


def _intersect(
    seen: Sequence[tuple[int, SphereOutline]], T_scan_camera: Array, start: Array, radius_m: float, least: int
) -> TriangulatedSphere:
    """Intersect the viewing cones of one sphere by Gauss–Newton.

    Inliers and the variance factor are chosen again before each step, so there is no fixed cost that
    `service.compute.descent` could minimise, and the covariance is that of the last step's equations.
    """
    T = T_scan_camera[[i for i, _ in seen]]
    cones = ObservedCones.of(o.cone for _, o in seen)
    whiten = np.array([np.linalg.inv(np.linalg.cholesky(o.cone_covariance)) for _, o in seen])
    centre, keep, factor = start.copy(), np.ones(len(seen), dtype=bool), 1.0
    information: Array = np.eye(3)
    for _ in range(_MAX_STEPS):
        camera_m = np.einsum("oji,oj->oi", T[:, :3, :3], centre - T[:, :3, 3])
        r, D = cones.residuals(camera_m, radius_m)
        r = np.einsum("oij,oj->oi", whiten, r)
        J = whiten @ D @ T[:, :3, :3].transpose(0, 2, 1)
        square = np.sum(r**2, axis=1)
        factor = max(1.0, float(np.median(square)) / 2.366)  # the median of chi square with three degrees of freedom
        nearest = np.argsort(square)[:least]
        keep = square < 3 * factor * _OUTLIER_SIGMA**2
        keep[nearest] = True
        information = np.einsum("oki,okj->ij", J[keep], J[keep])
        step = -np.linalg.solve(information, np.einsum("oki,ok->i", J[keep], r[keep]))
        centre = centre + step
        if float(np.linalg.norm(step)) < 1e-9:
            break
    return TriangulatedSphere(centre, factor * np.linalg.inv(information).astype(np.float64), int(keep.sum()))


def compare_in_frame(a: Array, covariance_a: Array, b: Array, covariance_b: Array) -> Closure:
    """Compare two measurements (n, 3) of the same points in the same frame, with covariances (n, 3, 3) in m²."""
    r = a - b
    C = covariance_a + covariance_b
    square = np.einsum("ni,nij,nj->n", r, np.linalg.inv(C), r)
    return Closure(
        len(a),
        float(np.sqrt(np.mean(np.sum(r**2, axis=1)))),
        float(np.sqrt(np.mean(np.trace(C, axis1=1, axis2=2)))),
        float(square.sum()) / (3 * len(a)),
    )


def compare_shapes(a: Array, covariance_a: Array, b: Array, covariance_b: Array) -> tuple[Closure, Alignment]:
    """Compare two constellations (n, 3) of the same spheres in different frames; return the aligning T_a_b too.

    The alignment is weighted by the covariances (n, 3, 3), m²; its six degrees of freedom are subtracted.

    Raises:
        ComputeError: fewer than four spheres, which leave nothing to compare.
    """
    if len(a) < 4:
        raise ComputeError(f"{len(a)} common spheres do not close a loop; four are needed")

    def parts(T: Transform) -> tuple[Array, Array, Array]:
        R = T[:3, :3]
        return a - apply(T, b), place_jacobian(b @ R.T), covariance_a + R @ covariance_b @ R.T

    def equations(T: Transform) -> tuple[Array, Array]:
        r, slope, covariance = parts(T)
        weight = np.linalg.inv(covariance)
        information = np.einsum("nki,nkl,nlj->ij", slope, weight, slope)
        return information, np.einsum("nki,nkl,nl->i", slope, weight, r)

    T_a_b = gauss_newton(
        align_points(a, b)[0],
        lambda T: np.asarray(np.linalg.solve(*equations(T)), dtype=np.float64),
        lambda T, step: increment(T, step[:3], step[3:]),
        most=_MAX_STEPS,
        settled=1e-12,
    )
    r, slope, covariance = parts(T_a_b)
    information = equations(T_a_b)[0]
    left = covariance - slope @ np.linalg.inv(information) @ slope.transpose(
        0, 2, 1
    )  # of a residual, the alignment being fitted
    square = np.einsum("ni,nij,nj->n", r, np.linalg.inv(covariance), r)
    closure = Closure(
        len(a),
        float(np.sqrt(np.mean(np.sum(r**2, axis=1)))),
        float(np.sqrt(np.mean(np.trace(left, axis1=1, axis2=2)))),
        float(square.sum()) / (3 * len(a) - 6),
    )
    return closure, Alignment(T_a_b, np.linalg.inv(information).astype(np.float64))


CONTROL_SPHERES = "control spheres"
HONEST = (0.5, 2.0)  # range of normalised chi square in which the covariances agree with the observation

_HOW = {
    "outlines": "covariances of the outlines from their edge points, scaled to the residuals",
    "common": "errors that all outlines of the capture may share (edge bias)",
    "intrinsics": "covariance of the camera calibration, poses fixed (poses from the same images absorb part)",
    "unexplained": "how far the scan moves if the errors that all outlines share are left free, and bias by blur",
    "outlines and poses": "covariances of the outlines, scaled to the residuals, each camera pose refined by its own",
    "poses": "covariance of the camera poses, their scatter estimated from the spheres' residuals",
    "spheres": "covariances of the sphere centres in the scan",
    "adjustment": "covariance of the joint adjustment of tracks, robot poses and sphere outlines",
}


@dataclass(frozen=True, slots=True)
class Contribution:
    """One source of error at the target, as a 3D standard deviation, and how it was determined."""

    name: str
    sigma_m: float
    how: str
    counted: bool = True  # in the total


@dataclass(frozen=True, slots=True)
class Observation:
    """A comparison of independent measurements with its predicted size."""

    name: str
    observed_m: float
    predicted_m: float
    normalised_chi2: float
    n: int
    how: str
    hides_common: bool = False  # errors common to all spheres cancel in this comparison

    @property
    def verdict(self) -> str:
        """The text that says whether the given covariances agree with the observation."""
        low, high = HONEST
        if self.normalised_chi2 > high:
            factor = float(np.sqrt(self.normalised_chi2))
            return f"larger than predicted: the stated errors are {factor:.1f} times too small here"
        if self.normalised_chi2 < low and self.hides_common:
            return "smaller than predicted: errors common to all spheres do not show here"
        if self.normalised_chi2 < low:
            factor = float(1 / np.sqrt(max(self.normalised_chi2, 1e-12)))
            return f"smaller than predicted: the stated errors are {factor:.1f} times too large here"
        return "as predicted"


@dataclass(frozen=True, slots=True)
class MeasuredSpheres:
    """Sphere centres (n, 3) of a scan or a CT in its own frame, covariances (n, 3, 3), and the fit's residual."""

    centres_m: Array
    covariance_m2: Array
    surface_rms_m: float  # rms distance of the surface points from the fitted spheres


@dataclass(frozen=True, slots=True)
class ErrorBudget:
    """Contributions, their root sum of squares, and the observations that check them."""

    contributions: tuple[Contribution, ...]
    observations: tuple[Observation, ...]

    @property
    def total_m(self) -> float:
        """Root sum of squares of the counted contributions, metres."""
        return float(np.sqrt(sum(c.sigma_m**2 for c in self.contributions if c.counted)))


def contributions(
    registration_m: Mapping[str, float], scan: MeasuredSpheres, ct: MeasuredSpheres | None
) -> tuple[Contribution, ...]:
    """List every source of error at a target; `registration_m` holds the registration's part there, as 3D sigmas.

    The total is for a point of the scan's surface in the images: the registration's components and the scan's own
    noise. The CT is listed but not counted, since it only matters where its surface is used.
    """
    out = [
        Contribution(name, sigma_m, _HOW.get(name, "component of the registration's covariance"))
        for name, sigma_m in registration_m.items()
    ]
    out.append(
        Contribution("scan", scan.surface_rms_m, "rms distance of the scan's points on the spheres from the spheres")
    )
    if ct is not None:
        how = "rms distance of the CT surface on the spheres from the spheres; counts only where the CT is used"
        out.append(Contribution("ct", ct.surface_rms_m, how, counted=False))
    return tuple(out)


def control_observation(
    registration: Alignment, seen: Mapping[int, TriangulatedSphere], control: MeasuredSpheres
) -> Observation:
    """Return the control spheres located in the images, compared with their positions by scan and registration.

    Control and registration spheres are seen by the same camera, so an error that moves all outlines alike moves both
    and cancels.

    Args:
        registration: T_world_scan with its covariance, without such common errors.
        seen: spheres located in the images through the registered cameras, by index into `control`; scan frame.
        control: measured by the scanner; scan frame.
    """
    index = sorted(seen)
    R = registration.T_a_b[:3, :3]
    uncertain = R.T @ registration.covariance_at_m2(control.centres_m[index]) @ R
    closure = compare_in_frame(
        np.array([seen[m].centre_m for m in index]),
        np.array([seen[m].covariance_m2 for m in index]),
        control.centres_m[index],
        uncertain + control.covariance_m2[index],
    )
    how = "spheres that took no part in the registration, located in the images alone"
    return replace(_observation(CONTROL_SPHERES, closure, how), hides_common=True)


def loop_observations(
    seen: Mapping[int, TriangulatedSphere], scan: MeasuredSpheres, ct_in_scan_order: MeasuredSpheres | None
) -> tuple[Observation, ...]:
    """Return the closures camera ↔ scan, scan ↔ CT and camera ↔ CT: shapes of the spheres that each pair shares.

    Three pairs instead of one loop, because alignments on the same spheres cancel one another whatever their errors.

    Args:
        seen: spheres located in the images, by index into the scan's spheres.
        scan: the spheres of the registered scan.
        ct_in_scan_order: the CT's spheres, one for each of the scan's; rows of NaN where the CT has none.
    """
    index = sorted(seen)
    images = MeasuredSpheres(
        np.array([seen[m].centre_m for m in index]), np.array([seen[m].covariance_m2 for m in index]), 0.0
    )
    out: list[Observation] = []
    if len(index) >= 4:
        out.append(_shapes("camera ↔ scan", images, _pick(scan, index)))
    if ct_in_scan_order is None:
        return tuple(out)
    known = np.all(np.isfinite(ct_in_scan_order.centres_m), axis=1).tolist()
    both = [m for m, there in enumerate(known) if there]
    if len(both) >= 4:
        out.append(_shapes("scan ↔ CT", _pick(scan, both), _pick(ct_in_scan_order, both)))
    shared = [m for m in index if known[m]]
    if len(shared) >= 4:
        rows = [index.index(m) for m in shared]
        out.append(_shapes("camera ↔ CT", _pick(images, rows), _pick(ct_in_scan_order, shared)))
    return tuple(out)


def _pick(spheres: MeasuredSpheres, index: Sequence[int]) -> MeasuredSpheres:
    rows = list(index)
    return MeasuredSpheres(spheres.centres_m[rows], spheres.covariance_m2[rows], spheres.surface_rms_m)


def _shapes(name: str, a: MeasuredSpheres, b: MeasuredSpheres) -> Observation:
    closure, _ = compare_shapes(a.centres_m, a.covariance_m2, b.centres_m, b.covariance_m2)
    return _observation(name, closure, f"{closure.n} sphere centres after the best rigid alignment")


def _observation(name: str, closure: Closure, how: str) -> Observation:
    return Observation(name, closure.rms_m, closure.predicted_m, closure.normalised_chi2, closure.n, how)
