"""How good a registration is: the paper's two errors on control spheres, and the true error where truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.markers.records import SphereOutline
from service.compute.registration.cost import residuals
from service.compute.registration.identity import Assignment
from service.core.errors import ComputeError
from service.core.geometry import Array, align_points, apply, inverse


@dataclass(frozen=True, slots=True)
class ControlError:
    """One control sphere in one image."""

    image: int
    outline: int
    sphere: int
    radial_error_mm: float
    reprojection_error_px: float


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Means over all outline points of all control spheres in all images."""

    mean_radial_error_mm: float
    mean_reprojection_error_px: float
    errors: tuple[ControlError, ...]

    def per_sphere(self) -> dict[int, tuple[float, float, int]]:
        """Sphere → mean radial error (mm), mean reprojection error (px), number of images."""
        out: dict[int, tuple[float, float, int]] = {}
        for s in sorted({e.sphere for e in self.errors}):
            mine = [e for e in self.errors if e.sphere == s]
            radial = float(np.mean([e.radial_error_mm for e in mine]))
            out[s] = (radial, float(np.mean([e.reprojection_error_px for e in mine])), len(mine))
        return out


def radial_errors_m(points: Array, centre_camera_m: Array, radius_m: float) -> Array:
    """Distances (L,) between the rays through normalised points (L, 2) and the hull of the sphere."""
    rays = np.column_stack([points, np.ones(len(points))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = rays @ centre_camera_m
    return np.abs(np.linalg.norm(centre_camera_m - along[:, None] * rays, axis=1) - radius_m)


def evaluate(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    T_scan_camera: Array,
    centres_scan_m: Array,
    radius_m: float,
    camera: CameraModel,
) -> Evaluation:
    """Errors of spheres that took no part in the registration.

    Args:
        outlines: per image.
        assignments: per image, outline → index into `centres_scan_m`.
        T_scan_camera: (N, 4, 4) the registered cameras, metric.
        centres_scan_m: (C, 3) control spheres.
        radius_m: of the control spheres.
        camera: intrinsics.

    Raises:
        ComputeError: no control sphere was seen.
    """
    errors: list[ControlError] = []
    for i, assignment in enumerate(assignments):
        for j, s in sorted(assignment.markers.items()):
            centre = apply(inverse(T_scan_camera[i]), centres_scan_m[s])
            points = outlines[i][j].points
            radial = radial_errors_m(points, centre, radius_m)
            lifted = np.column_stack([points, np.ones(len(points))])
            distance = np.abs(residuals(lifted, np.broadcast_to(centre, lifted.shape), radius_m, "sampson"))
            errors.append(
                ControlError(
                    i, j, s, float(radial.mean()) * 1e3, float(distance.mean()) * 0.5 * (camera.fx + camera.fy)
                )
            )
    if not errors:
        raise ComputeError(
            "no control sphere was found in any image", remedy="Capture control images before the spheres are removed"
        )
    return Evaluation(
        float(np.mean([e.radial_error_mm for e in errors])),
        float(np.mean([e.reprojection_error_px for e in errors])),
        tuple(errors),
    )


def true_error_m(T_scan_camera: Array, T_scan_camera_true: Array, centre_scan_m: Array) -> float:
    """Distance by which the scene's centre is misplaced, the cameras being laid over the true ones.

    Args:
        T_scan_camera: (N, 4, 4) registered cameras in the scan frame, metric.
        T_scan_camera_true: (N, 4, 4) truth.
        centre_scan_m: (3,) a point of the scene, in the scan frame.

    The estimated camera positions are aligned to the true ones by a rigid fit (the world frame of structure from
    motion is arbitrary); with T that fit, the error is |T c - c|.
    """
    good = np.all(np.isfinite(T_scan_camera.reshape(len(T_scan_camera), -1)), axis=1)
    T_true_estimated, _ = align_points(T_scan_camera_true[good, :3, 3], T_scan_camera[good, :3, 3])
    return float(np.linalg.norm(apply(T_true_estimated, centre_scan_m) - centre_scan_m))
