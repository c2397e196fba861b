"""Predicts the target error of taken and planned views, and suggests those that bring it below its limit soonest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, ObservedCones, cone_of_sphere
from service.compute.markers.records import SphereOutline
from service.compute.scene import ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse, place_jacobian, skew

_PRIOR_VIEWS = 2.0  # weight of the arm's nominal scatter, in views
_OUTLIER = 25.0  # squared Mahalanobis distance of an outline from the solution, including the arm's scatter


@dataclass(frozen=True, slots=True)
class ViewInformation:
    """One view: information (6, 6) of its outlines, and the scan's offset (6,), as (d, w), from them alone."""

    information: Array = field(repr=False)
    offset: Array
    spheres: int


def view_information(
    T_base_camera: Transform,
    T_base_scan: Transform,
    outlines: Sequence[SphereOutline],
    markers: Mapping[int, int],
    spheres: ScanSpheres,
    centre_m: Array,
    pose_sigma_m: float,
) -> ViewInformation:
    """Compute the information of one image's assigned outlines about T_base_scan, linearised there.

    Args:
        T_base_camera: pose of the camera.
        T_base_scan: the pose at which it is linearised.
        outlines: the image's outlines.
        markers: outline → sphere.
        spheres: the spheres in the scan frame.
        centre_m: (3,) centre of the scene, base frame.
        pose_sigma_m: the arm's nominal scatter; outlines that contradict the solution by much more are excluded.
    """
    base = apply(T_base_scan, spheres.centres_m)
    normal, b, used = np.zeros((6, 6)), np.zeros(6), 0
    for o, m in markers.items():
        outline = outlines[o]
        residual, J = cone_rows(T_base_camera, base[m], centre_m, spheres.radius_m, outline.cone)
        slack = pose_sigma_m**2 * (J[:, :3] @ J[:, :3].T)
        if residual @ np.linalg.solve(outline.cone_covariance + slack, residual) > _OUTLIER:
            continue
        weight = np.linalg.inv(outline.cone_covariance)
        normal += J.T @ weight @ J
        b -= J.T @ weight @ residual
        used += 1
    offset = np.linalg.lstsq(normal, b, rcond=1e-12)[0] if used >= 3 else np.full(6, np.nan)
    return ViewInformation(normal, np.asarray(offset, dtype=np.float64), used)


def predicted_information(
    T_base_camera: Transform, spheres_base_m: Array, radius_m: float, centre_m: Array, cone_covariance: Array
) -> Array:
    """Predict the information (6, 6) of a view of spheres (K, 3) with outlines of this covariance (3, 3)."""
    normal = np.zeros((6, 6))
    weight = np.linalg.inv(cone_covariance)
    for sphere in spheres_base_m:
        seen = cone_of_sphere(apply(inverse(T_base_camera), sphere), radius_m)
        _, J = cone_rows(T_base_camera, sphere, centre_m, radius_m, seen)
        normal += J.T @ weight @ J
    return normal


def cone_rows(
    T_base_camera: Transform, sphere_base_m: Array, centre_m: Array, radius_m: float, seen: Cone
) -> tuple[Array, Array]:
    """Return the residual (3,) in radians of a sphere's cone as seen, and its derivative (3, 6) by (d, w)."""
    c = apply(inverse(T_base_camera), sphere_base_m)
    residual, by_centre = ObservedCones.of([seen]).residuals(c[None], radius_m)
    move = T_base_camera[:3, :3].T @ np.hstack([np.eye(3), -skew(sphere_base_m - centre_m)])  # (3, 6) of c
    return residual[0], by_centre[0] @ move


def pose_scatter(views: Sequence[ViewInformation], sigma_m: float, sigma_rad: float) -> Array:
    """Return the covariance P (6, 6) of a station's camera poses, from the views' scatter and the nominal scatter.

    Args:
        views: their offsets scatter by the arm's error and the noise of their outlines.
        sigma_m, sigma_rad: nominal scatter in 3D, with the weight of two views.
    """
    nominal = np.diag([sigma_m**2 / 3] * 3 + [sigma_rad**2 / 3] * 3)
    offsets = np.array([v.offset for v in views if v.spheres >= 4]).reshape(-1, 6)
    if len(offsets) < 2:
        return nominal
    deviations = offsets - offsets.mean(axis=0)
    scatter = deviations.T @ deviations
    return (_PRIOR_VIEWS * nominal + scatter) / (_PRIOR_VIEWS + len(offsets) - 1)


def pose_covariance(informations: Iterable[Array], P: Array) -> Array:
    """Return the covariance (6, 6) of the scan's pose from views with these informations and pose errors P each.

    Raises:
        ComputeError: the views together do not determine the pose.
    """
    normal, middle = np.zeros((6, 6)), np.zeros((6, 6))
    for information in informations:
        normal += information
        middle += information + information @ P @ information
    d = np.sqrt(np.diag(normal))
    if not np.all(d > 0) or np.linalg.cond(normal / np.outer(d, d)) > 1e12:
        raise ComputeError(
            "the views do not determine the pose of the scan", remedy="Take images that show more spheres"
        )
    inverse_normal = np.linalg.inv(normal / np.outer(d, d)) / np.outer(d, d)
    return inverse_normal @ middle @ inverse_normal


def mounting_covariance(
    views: Iterable[tuple[Array, Transform]], T_flange_camera: Transform, covariance: Array, centre_m: Array
) -> Array:
    """Return the covariance (6, 6) of the scan's pose due to the uncertain camera mount, which all views share.

    Args:
        views: information (6, 6) and T_base_camera of each; together they must determine the pose.
        covariance: (6, 6) covariance of T_flange_camera, as (d, w) in flange axes with R → exp(w) R, t → t + d.
        centre_m: (3,) base frame.
    """
    normal, moved = np.zeros((6, 6)), np.zeros((6, 6))
    for information, T_base_camera in views:
        R = T_base_camera[:3, :3] @ T_flange_camera[:3, :3].T
        lever = skew(centre_m - T_base_camera[:3, 3])
        normal += information
        moved += information @ np.block([[R, -lever @ R], [np.zeros((3, 3)), R]])
    d = np.sqrt(np.diag(normal))
    M = np.linalg.solve(normal / np.outer(d, d), moved / d[:, None]) / d[:, None]
    return M @ covariance @ M.T


def lens_covariance_of_pose(
    views: Iterable[tuple[Array, Transform]], camera: CameraModel, covariance: Array, centre_m: Array
) -> Array:
    """Return the covariance (6, 6) of the scan's pose due to the uncertain calibration, which all views share.

    A focal length too long by a share puts the scan nearer by this share of its distance, and a principal point that
    is off puts it aside.

    Args:
        views: information (6, 6) and T_base_camera of each; together they must determine the pose.
        camera: intrinsics.
        covariance: (4, 4) covariance of fx, fy, cx, cy or (8, 8) with the distortion, which counts for nothing at the
            centre.
        centre_m: (3,) base frame.
    """
    normal, moved = np.zeros((6, 6)), np.zeros((6, 4))
    for information, T_base_camera in views:
        c = apply(inverse(T_base_camera), centre_m)
        aside = np.zeros((3, 4))
        aside[2, :2] = -c[2] / (2 * np.array([camera.fx, camera.fy]))
        aside[:2, 2:] = -c[2] * np.diag([1 / camera.fx, 1 / camera.fy])
        normal += information
        moved += information[:, :3] @ T_base_camera[:3, :3] @ aside
    d = np.sqrt(np.diag(normal))
    M = np.linalg.solve(normal / np.outer(d, d), moved / d[:, None]) / d[:, None]
    return M @ covariance[:4, :4] @ M.T


def point_sigmas_m(covariance: Array, points_m: Array) -> Array:
    """Return 3D sigmas (N,), metres, at points (N, 3) from the centre, for a covariance (6, 6) of (d, w)."""
    J = place_jacobian(points_m)
    return np.sqrt(np.einsum("nij,jk,nik->n", J, covariance, J))


_AS_GOOD = 1.01  # errors within 1 % count as equal; coverage and travel then decide


@dataclass(frozen=True, slots=True)
class ViewGain:
    """A possible viewpoint and its predicted gain."""

    name: str
    information: Array = field(repr=False)  # (6, 6), see planning.information
    seen: NDArray[np.bool_] = field(repr=False)  # (N,) points of the coverage surface that it sees
    travel_s: float = 0.0


@dataclass(frozen=True, slots=True)
class CurrentInformation:
    """The information from the station's images so far."""

    informations: tuple[Array, ...] = field(repr=False)
    pose_covariance: Array = field(repr=False)  # P (6, 6), the arm's scatter
    targets_m: Array = field(repr=False)  # (T, 3) target points relative to the scene's centre, base axes
    seen_count: NDArray[np.int64] = field(repr=False)  # (N,) views of each surface point from all stations
    min_views: int = 2
    shared: Array | None = field(default=None, repr=False)  # (6, 6) covariance that further views do not reduce

    def error_m(self, *more: Array) -> float:
        """Predict the worst target's error, m, with this further information added; infinite if undetermined."""
        try:
            covariance = pose_covariance([*self.informations, *more], self.pose_covariance)
        except ComputeError:
            return float("inf")
        if self.shared is not None:
            covariance = covariance + self.shared
        return float(point_sigmas_m(covariance, self.targets_m).max())


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A suggested viewpoint, and the predicted results once it and those before it are taken."""

    name: str
    predicted_error_m: float
    coverage: float


def next_best_views(
    present: CurrentInformation,
    candidates: Sequence[ViewGain],
    *,
    limit_m: float,
    min_coverage: float,
    at_most: int = 6,
) -> tuple[Suggestion, ...]:
    """Choose a short list of viewpoints greedily that brings error and coverage within limits, or `at_most` of them.

    While the error exceeds its limit, each choice minimises it; among equals, the one with the largest coverage, then
    the nearest wins. After that, each choice maximises coverage.
    """
    chosen: list[Suggestion] = []
    informations: list[Array] = []
    count = present.seen_count.copy()
    error = present.error_m()
    left = list(candidates)
    while left and len(chosen) < at_most:
        coverage = _covered(count, present.min_views)
        if error <= limit_m and coverage >= min_coverage:
            break
        errors = np.array([present.error_m(*informations, c.information) for c in left])
        gains = np.array([_gain(count, c.seen, present.min_views) for c in left])
        if error > limit_m and np.isfinite(errors.min()):
            equal = [i for i in range(len(left)) if errors[i] <= _AS_GOOD * errors.min()]
        else:
            equal = list(range(len(left)))
        best = min(equal, key=lambda i: (-round(float(gains[i]), 3), left[i].travel_s, left[i].name))
        pick = left.pop(best)
        informations.append(pick.information)
        count = count + pick.seen
        error = float(errors[best])
        chosen.append(Suggestion(pick.name, error, _covered(count, present.min_views)))
    return tuple(chosen)


def _covered(count: NDArray[np.int64], min_views: int) -> float:
    return float(np.mean(count >= min_views)) if len(count) else 0.0


def _gain(count: NDArray[np.int64], seen: NDArray[np.bool_], min_views: int) -> float:
    """Return the progress of all points towards `min_views`, so that a first view of a point counts too."""
    if not len(count):
        return 0.0
    return float(np.mean(np.minimum(count + seen, min_views) - np.minimum(count, min_views))) / min_views
