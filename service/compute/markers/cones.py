"""Describes the circular cone of rays of a sphere: its fit, its residuals, and a camera's pose from several."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.descent import gauss_newton
from service.core.geometry import Array, Transform, increment, skew


@dataclass(frozen=True, slots=True)
class Cone:
    """All rays that touch a sphere: `axis` (3,) is the unit vector to the sphere's centre, in the camera frame."""

    axis: Array
    half_angle_rad: float

    @property
    def conic(self) -> Array:
        """(3, 3) E with x^T E x = 0 for x = (x, y, 1) normalised, of unit Frobenius norm, negative inside.

        With E^-1 = P Q^-1 P^T for a sphere c, r in the camera frame: E ~ (|c|^2 - r^2) I - c c^T, which is
        cos^2(a) I - u u^T for u = c / |c| and sin(a) = r / |c|.
        """
        a = math.cos(self.half_angle_rad) ** 2
        norm = math.sqrt(3 * a**2 - 2 * a + 1)
        u = [float(v) for v in self.axis]
        entries = [[(a * (i == j) - u[i] * u[j]) / norm for j in range(3)] for i in range(3)]
        return np.array(entries, dtype=np.float64)

    def frame(self) -> Array:
        """Return (3, 3) with columns e1, e2, axis: an orthonormal frame; e1 lies in the plane of axis and image x."""
        x, y, z = (float(v) for v in self.axis)
        n = math.sqrt((1 - x * x) ** 2 + (x * y) ** 2 + (x * z) ** 2)
        a, b, c = (1 - x * x) / n, -x * y / n, -x * z / n
        return np.array([[a, y * c - z * b, x], [b, z * a - x * c, y], [c, x * b - y * a, z]])

    def rays(self, azimuth_rad: Array, angle_rad: Array) -> Array:
        """Return the unit rays (..., 3) at `angle_rad` from the axis and `azimuth_rad` around it (broadcast)."""
        local = np.stack(
            np.broadcast_arrays(
                np.sin(angle_rad) * np.cos(azimuth_rad), np.sin(angle_rad) * np.sin(azimuth_rad), np.cos(angle_rad)
            ),
            axis=-1,
        )
        return local @ self.frame().T


def cone_of_sphere(centre_camera_m: Array, radius_m: float) -> Cone:
    """Return the cone of a sphere with centre (3,) in the camera frame."""
    distance = float(np.linalg.norm(centre_camera_m))
    return Cone(centre_camera_m / distance, float(np.arcsin(radius_m / distance)))


@dataclass(frozen=True, slots=True)
class Ellipse:
    """An ellipse in normalised coordinates."""

    centre: Array  # (2,)
    semi_major: float
    semi_minor: float
    angle_rad: float

    def equidistant(self, n: int) -> Array:
        """Return (n, 2) points at equal arc length, the first one not repeated."""
        t = np.linspace(0.0, 2 * np.pi, 1441)
        local = np.stack([self.semi_major * np.cos(t), self.semi_minor * np.sin(t)], axis=1)
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(local, axis=0), axis=1))])
        at = np.interp(np.arange(n) * length[-1] / n, length, t)
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        x, y = self.semi_major * np.cos(at), self.semi_minor * np.sin(at)
        return np.stack([c * x - s * y, s * x + c * y], axis=1) + self.centre


def cone_ellipse(cone: Cone) -> Ellipse:
    """Return the ellipse in which the cone intersects the plane z = 1; the cone must lie in front of the camera."""
    E = cone.conic
    A, b, c = E[:2, :2], E[:2, 2], E[2, 2]
    centre = -np.linalg.solve(A, b).astype(np.float64)
    level = -(c + b @ centre)
    values, vectors = np.linalg.eigh(A / level)  # ascending: the first is the major axis
    return Ellipse(
        centre,
        float(1 / np.sqrt(values[0])),
        float(1 / np.sqrt(values[1])),
        float(np.arctan2(vectors[1, 0], vectors[0, 0])),
    )


def angles_to(cone: Cone, rays: Array) -> Array:
    """Return the angular distance (N,) of unit rays (N, 3) from the cone's surface, radians, positive outside."""
    along = rays @ cone.axis
    across = np.linalg.norm(rays - along[:, None] * cone.axis, axis=1)
    return np.arctan2(across, along) - cone.half_angle_rad


def fit_cone(rays: Array, weights: Array, start: Cone, iterations: int = 4) -> Cone:
    """Fit a cone to unit rays (N, 3) by weighted least squares of angular (geometric) distance; Gauss–Newton."""

    def step_at(cone: Cone) -> Array:
        local = rays @ cone.frame()
        J = distance_gradient(np.arctan2(local[:, 1], local[:, 0]))
        weighted = J.T * weights
        try:
            return np.asarray(np.linalg.solve(weighted @ J, -weighted @ angles_to(cone, rays)), dtype=np.float64)
        except np.linalg.LinAlgError:  # all points in one place: the cone stays
            return np.zeros(3)

    def moved(cone: Cone, step: Array) -> Cone:
        axis = cone.axis + cone.frame()[:, :2] @ step[:2]
        return Cone(axis / np.linalg.norm(axis), cone.half_angle_rad + float(step[2]))

    return gauss_newton(start, step_at, moved, most=iterations, settled=1e-8)


def distance_gradient(azimuth_rad: Array) -> Array:
    """Return (N, 3) derivative of the angular distance of rays at these azimuths by the axis's shift and h.

    Tilting the axis by t towards azimuth p reduces the distance of a ray at azimuth q by t cos(p - q).
    """
    return np.stack([-np.cos(azimuth_rad), -np.sin(azimuth_rad), -np.ones(len(azimuth_rad))], axis=1)


def cones_through(triples: Array) -> tuple[Array, Array]:
    """Return cones through triples of unit rays (K, 3, 3): axes (K, 3), half angles (K,); NaN if degenerate."""
    normal = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normal, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        axis = normal / np.where(length > 1e-15, length, np.nan)[:, None]
    cosine = np.einsum("kj,kj->k", axis, triples[:, 0])
    axis = axis * np.sign(cosine)[:, None]
    return axis, np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))


def ransac_cone(
    rays: Array,
    strengths: Array,
    slots: NDArray[np.int64],
    bounds: tuple[float, float],
    tolerance_rad: float,
    rng: np.random.Generator,
    trials: int = 400,
) -> tuple[Cone, NDArray[np.bool_]] | None:
    """Find the cone on which most edge points agree, by RANSAC, and which points (N,) do.

    Args:
        rays: (N, 3) unit rays of edge points.
        strengths: (N,) weight of a point's vote, 0..1.
        slots: (N,) azimuth slot of each point; a slot votes once, with its strongest agreeing point.
        bounds: smallest and largest half angle allowed.
        tolerance_rad: angular distance within which a point agrees.
        rng: random generator.
        trials: number of triples drawn.

    Returns None if no triple gives a cone within the bounds.
    """
    if len(rays) < 8:
        return None
    order = np.argsort(slots, kind="stable")
    rays, strengths, sorted_slots = rays[order], strengths[order], slots[order]
    # Triples spread around the whole outline; closer together for outlines visible only as an arc.
    first = rng.integers(0, len(rays), trials)
    apart = np.where(np.arange(trials) % 2 == 0, 1 / 3, 0.14)[:, None] * [[0.0, 1.0, 2.0]]
    shift = ((apart + rng.uniform(-0.05, 0.05, (trials, 3))) * len(rays)).astype(int)
    picks = (first[:, None] + shift) % len(rays)
    axis, half = cones_through(rays[picks])
    good = np.isfinite(half) & (half > bounds[0]) & (half < bounds[1])
    if not np.any(good):
        return None
    axis, half = axis[good], half[good]
    # |angle - half| < tolerance, in cosines, which decrease with the angle; single precision for speed.
    far, close = np.cos(half + tolerance_rad), np.cos(np.maximum(half - tolerance_rad, 0))
    off = np.abs((rays @ axis.T - 0.5 * (close + far)).astype(np.float32))  # (N, K)
    agree = off < (0.5 * (close - far)).astype(np.float32)
    votes = agree * strengths[:, None].astype(np.float32)
    starts = np.searchsorted(sorted_slots, np.unique(sorted_slots))
    total = np.maximum.reduceat(votes, starts, axis=0).sum(axis=0)
    best = int(np.argmax(total))
    cone = Cone(axis[best], float(half[best]))
    inlier_sorted = agree[:, best]
    for _ in range(3):
        if inlier_sorted.sum() < 8:
            return None
        cone = fit_cone(rays[inlier_sorted], strengths[inlier_sorted], cone)
        inlier_sorted = np.abs(angles_to(cone, rays)) < tolerance_rad
    if not bounds[0] < cone.half_angle_rad < bounds[1]:
        return None
    inlier = np.zeros(len(rays), dtype=bool)
    inlier[order] = inlier_sorted
    return cone, inlier


@dataclass(frozen=True, slots=True)
class ObservedCones:
    """O cones of spheres in the camera frame.

    Attributes:
        axes: (O, 3) unit vectors to the spheres' centres, which are not the ellipses' centres.
        half_angles: (O,) radians.
        directions: (O, 3, K) unit vectors, in columns, along which a tilt of the axis is measured.
    """

    axes: Array
    half_angles: Array
    directions: Array

    @classmethod
    def of(cls, cones: Iterable[Cone]) -> ObservedCones:
        """Collect cones, with tilts along the first two columns of `frame()`, as in SphereOutline.cone_covariance."""
        found = list(cones)
        return cls(
            np.array([c.axis for c in found], dtype=np.float64).reshape(-1, 3),
            np.array([c.half_angle_rad for c in found], dtype=np.float64),
            np.array([c.frame()[:, :2] for c in found], dtype=np.float64).reshape(-1, 3, 2),
        )

    @classmethod
    def with_chords(cls, axes: Array, half_angles: Array) -> ObservedCones:
        """Convert tilts to the camera's three axes, where they are differences of unit vectors."""
        return cls(axes, half_angles, np.broadcast_to(np.eye(3), (len(axes), 3, 3)))

    def __len__(self) -> int:
        """Return the number of cones."""
        return len(self.axes)

    def take(self, which: NDArray[np.int64]) -> ObservedCones:
        """Return the cones of these indices, which may repeat."""
        return ObservedCones(self.axes[which], self.half_angles[which], self.directions[which])

    def residuals(self, centres_camera_m: Array, radius_m: float) -> tuple[Array, Array]:
        """Return residuals (O, K + 1) in radians against spheres, and derivatives (O, K + 1, 3) by the centres.

        Args:
            centres_camera_m: (O, 3) predicted centres in the camera frame.
            radius_m: radius of the spheres.

        A sphere at c appears as the cone with the axis u = c / |c| and sin(a) = r / |c|. Its residual is the tilt of
        u along the directions, and a minus the observed half angle. With two directions across the axis, these three
        numbers hold all the information of an outline and are nearly linear in c.
        """
        distance = np.linalg.norm(centres_camera_m, axis=1)
        u = centres_camera_m / distance[:, None]
        half = np.arcsin(np.clip(radius_m / distance, 0.0, 0.999))
        across = np.einsum("oik,oi->ok", self.directions, u - self.axes)
        r = np.column_stack([across, half - self.half_angles])
        tangent = np.eye(3) - u[:, :, None] * u[:, None, :]
        tilt = np.einsum("oik,oij->okj", self.directions, tangent) / distance[:, None, None]
        shrink = -np.tan(half)[:, None] * u / distance[:, None]
        return r, np.concatenate([tilt, shrink[:, None, :]], axis=1)


def fit_pose(
    cones: ObservedCones, centres_m: Array, radius_m: float, start: Transform, iterations: int = 12
) -> Transform:
    """Return T_camera_scan from cones, by robust Gauss–Newton on their directions and sizes.

    Args:
        cones: N ≥ 3.
        centres_m: (N, 3) centres of the spheres, scan frame.
        radius_m: radius of the spheres.
        start: initial T_camera_scan.
        iterations: largest number of iterations.
    """
    seen = ObservedCones.with_chords(cones.axes, cones.half_angles)
    try:
        return gauss_newton(
            start,
            lambda pose: _pose_step(pose, seen, centres_m, radius_m),
            lambda pose, step: increment(pose, step[:3], step[3:]),
            most=iterations,
            settled=1e-9,
        )
    except _InsideSphereError:
        return start


class _InsideSphereError(Exception):
    """The camera would be inside a sphere."""


def _pose_step(pose: Transform, seen: ObservedCones, centres_m: Array, radius_m: float) -> Array:
    """Return one Gauss–Newton step (6,) of translation and rotation. Raises _InsideSphereError."""
    rotated = centres_m @ pose[:3, :3].T
    c = rotated + pose[:3, 3]
    if np.any(np.linalg.norm(c, axis=1) < 1.5 * radius_m):
        raise _InsideSphereError
    r, slope = seen.residuals(c, radius_m)
    residual = r / seen.half_angles[:, None]  # (N, 4) in radii
    by_centre = slope / seen.half_angles[:, None, None]  # (N, 4, 3)
    J = np.concatenate([by_centre, -by_centre @ skew(rotated)], axis=2)
    error = np.linalg.norm(residual, axis=1)
    scale = max(0.01, 1.5 * float(np.median(error)))
    weight = 1 / (1 + (error / scale) ** 2)
    H = np.einsum("n,nki,nkj->ij", weight, J, J)
    g = np.einsum("n,nki,nk->i", weight, J, residual)
    d = 1 / np.sqrt(np.maximum(np.diag(H), 1e-12))
    return -d * np.linalg.lstsq(H * np.outer(d, d), d * g, rcond=1e-12)[0]
