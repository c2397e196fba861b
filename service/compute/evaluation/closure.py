"""Loop closures: the same spheres measured by images, scan and CT, compared with their predicted differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from service.compute.descent import gauss_newton
from service.compute.markers.observed_cones import ObservedCones
from service.compute.markers.records import SphereOutline
from service.compute.registration.identification.identity import Assignment
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, align_points, apply, increment, place_jacobian

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
        """(n, 3, 3) covariance, in the axes of a, that the alignment's error adds to points (n, 3) of b."""
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
    """Centres of spheres from their outlines and the registered cameras, each sphere on its own.

    Weighted least squares of the cones' three parameters (`ObservedCones`); outlines more than 4 sigma from the
    others of their sphere are excluded. The covariance follows from the outlines', inflated if they scatter more.

    Args:
        outlines: per image.
        assignments: per image, outline → index into `starts_scan_m`.
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
    """Closure of two measurements (n, 3) of the same points in the same frame, with covariances (n, 3, 3) in m²."""
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
    """Closure of two constellations (n, 3) of the same spheres in different frames, and the aligning T_a_b.

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
