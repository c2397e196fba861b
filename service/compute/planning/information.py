"""Information of images about the scan's pose, and the target error that follows, for taken and planned views.

A view is one measurement of the scan's pose in the base frame: its outlines have an information matrix I (6, 6), and
the camera pose has a covariance P (6, 6), which all spheres of the view share. Both refer to a perturbation (d, w) of
the scan about the scene's centre c: p → c + d + exp(w) (p − c), in base axes, metres and radians. The registration
weights views by I, so the covariance of its result is H⁻¹ (Σ I + I P I) H⁻¹ with H = Σ I (the sandwich estimator of
weighted least squares with errors shared within groups).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

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
    """Information of one image's assigned outlines about T_base_scan, linearised there.

    Args:
        T_base_camera: pose of the camera.
        T_base_scan: where it is linearised.
        outlines: of the image.
        markers: outline → sphere.
        spheres: in the scan frame.
        centre_m: (3,) base frame.
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
    """Information (6, 6) predicted for a view of spheres (K, 3) with outlines of this covariance (3, 3)."""
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
    """Residual (3,) in radians of a sphere's cone as seen, and its derivative (3, 6) by (d, w)."""
    c = apply(inverse(T_base_camera), sphere_base_m)
    residual, by_centre = ObservedCones.of([seen]).residuals(c[None], radius_m)
    move = T_base_camera[:3, :3].T @ np.hstack([np.eye(3), -skew(sphere_base_m - centre_m)])  # (3, 6) of c
    return residual[0], by_centre[0] @ move


def pose_scatter(views: Sequence[ViewInformation], sigma_m: float, sigma_rad: float) -> Array:
    """Covariance P (6, 6) of a station's camera poses, from the views' scatter and the nominal scatter.

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
    """Covariance (6, 6) of the scan's pose from views with these informations (6, 6) and pose errors P each.

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
    """Covariance (6, 6) of the scan's pose due to the uncertain camera mount, which all views share.

    Args:
        views: information (6, 6) and T_base_camera of each; together they must determine the pose.
        covariance: (6, 6) of T_flange_camera, as (d, w) in flange axes with R → exp(w) R, t → t + d.
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
    """Covariance (6, 6) of the scan's pose due to the uncertain calibration, which all views share.

    A focal length too long by a share puts the scan nearer by this share of its distance, and a principal point that
    is off puts it aside.

    Args:
        views: information (6, 6) and T_base_camera of each; together they must determine the pose.
        camera: intrinsics.
        covariance: (4, 4) of fx, fy, cx, cy or (8, 8) with the distortion, which counts for nothing at the centre.
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
    """Standard deviation (N,) in 3D, metres, at points (N, 3) from the centre, for a covariance (6, 6) of (d, w)."""
    J = place_jacobian(points_m)
    return np.sqrt(np.einsum("nij,jk,nik->n", J, covariance, J))
