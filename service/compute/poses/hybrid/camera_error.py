"""Effect of a fixed camera's calibration error on hybrid poses; the error is common to tracks and outlines."""

from __future__ import annotations

import dataclasses

import numpy as np

from service.compute.camera_covariance import CameraCovariance
from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone
from service.compute.poses.hybrid.adjustment import BundleSolution
from service.compute.poses.hybrid.bundle import AdjustmentData, SphereSightings, normal_equations
from service.compute.poses.hybrid.rows import linearise
from service.core.geometry import Array

_RIM = 12  # rays of an outline that are recomputed


def camera_share(solution: BundleSolution, data: AdjustmentData, known: CameraCovariance) -> Array:
    """Covariance (n, n) of the frame parameters due to the camera's covariance, to be added to the solution's.

    For each deviation of the camera, this takes the step that the adjustment would make with that camera: robust
    weights fixed, points adjusted, cones recomputed from the outlines' pixels.
    """
    plain = linearise(solution.state, data, solution.sigmas)
    weighted = {name: rows.weighted(solution.weights[name]) for name, rows in plain.items()}
    total = np.zeros_like(solution.covariance)
    for camera in known.deviations(solution.state.camera):
        again = dataclasses.replace(data, sightings=_read_by(data.sightings, solution.state.camera, camera))
        other = linearise(dataclasses.replace(solution.state, camera=camera), again, solution.sigmas)
        changed = [
            dataclasses.replace(
                weighted[name],
                residual=np.repeat(np.sqrt(solution.weights[name]), plain[name].size)
                * (other[name].residual - plain[name].residual),
            )
            for name in plain
        ]
        step = normal_equations(changed).step(0.0)[0]
        total += np.outer(step, step)
    return total


def _read_by(sightings: SphereSightings | None, held: CameraModel, other: CameraModel) -> SphereSightings | None:
    """The outlines' cones recomputed from the same pixels with another camera model."""
    if sightings is None:
        return None
    azimuth = np.linspace(0.0, 2 * np.pi, _RIM, endpoint=False)
    seen = sightings.cones
    axes, halves = seen.axes.copy(), seen.half_angles.copy()
    for i, (axis, half) in enumerate(zip(seen.axes, seen.half_angles, strict=True)):
        cone = Cone(axis, float(half))
        pixels = held.project(np.vstack([axis, cone.rays(azimuth, np.full(_RIM, half))]))
        rays = np.column_stack([other.normalise(pixels), np.ones(_RIM + 1)])
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        axes[i] = rays[0]
        halves[i] = float(np.mean(np.arccos(np.clip(rays[1:] @ rays[0], -1, 1))))
    return dataclasses.replace(sightings, cones=dataclasses.replace(seen, axes=axes, half_angles=halves))
