"""Matches outlines to spheres if the camera pose is known well enough: the nearest one, within a gate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.markers.observed_cones import ObservedCones
from service.compute.markers.records import SphereOutline
from service.core.geometry import Array, Transform, apply

_FLOOR_RAD = 1.2e-4  # error from sphere list and lens, added to an outline's own: 0.1 mm at a metre and less


@dataclass(frozen=True, slots=True)
class MatchGate:
    """Largest deviation of an outline from the predicted sphere that it is matched to."""

    place: float  # in units of the sphere's apparent radius
    size: float  # relative


ROBOT_GATE = MatchGate(0.5, 0.12)  # wide enough for a robot that is off by millimetres
CONTROL_GATE = MatchGate(0.5, 0.15)  # if a sphere is farther from its prediction, the registration is wrong


@dataclass(frozen=True, slots=True)
class Sightings:
    """The geometry of one image's detections: cones, and positions from the known radius."""

    cones: ObservedCones  # (D,)
    positions_m: Array  # (D, 3) in the camera frame, precise across the ray, imprecise along it
    depth_sigma_m: Array  # (D,)
    sigma_rad: Array  # (D, 3) of tilt, tilt and half angle


def sightings(outlines: Sequence[SphereOutline], radius_m: float, camera: CameraModel) -> Sightings:
    """The geometry of one image's outlines."""
    cones = ObservedCones.of(o.cone for o in outlines)
    distance = radius_m / np.sin(cones.half_angles)
    # Half a pixel of the radius covers an outline's systematic error; more if only a part is visible.
    sigma = 0.5 / camera.fx / np.array([max(o.coverage, 0.2) for o in outlines])
    own = np.array([np.diag(o.cone_covariance) for o in outlines], dtype=np.float64).reshape(-1, 3)
    return Sightings(
        cones, cones.axes * distance[:, None], distance * sigma / cones.half_angles, np.sqrt(own + _FLOOR_RAD**2)
    )


def match(seen: Sightings, centres_camera_m: Array, radius_m: float, gate: MatchGate) -> list[tuple[int, int, float]]:
    """Pair detections with markers that are mutually nearest and within the gate.

    The markers' centres (M, 3) are in the camera frame. Returns (detection, marker, angle in radians) of each pair.
    """
    if len(seen.cones) == 0:
        return []
    distance = np.linalg.norm(centres_camera_m, axis=1)
    front = (centres_camera_m[:, 2] > 0) & (distance > 2 * radius_m)
    safe = np.maximum(distance, 2 * radius_m)
    half = np.arcsin(radius_m / safe)
    angle = np.arccos(np.clip(seen.cones.axes @ (centres_camera_m / safe[:, None]).T, -1, 1))
    ratio = seen.cones.half_angles[:, None] / half
    angle[(angle > gate.place * half) | (np.abs(ratio - 1) > gate.size) | ~front[None, :]] = np.inf
    nearest = np.argmin(angle, axis=1)
    back = np.argmin(angle, axis=0)
    return [
        (d, int(m), float(angle[d, m]))
        for d, m in enumerate(nearest)
        if np.isfinite(angle[d, m]) and int(back[m]) == d
    ]


def paired(
    outlines: Sequence[SphereOutline],
    T_camera_scan: Transform,
    spheres_m: Array,
    radius_m: float,
    camera: CameraModel,
    gate: MatchGate = ROBOT_GATE,
) -> dict[int, int]:
    """Outline → sphere (M, 3) of the scan frame, matched by predicted directions and sizes."""
    pairs = match(sightings(outlines, radius_m, camera), apply(T_camera_scan, spheres_m), radius_m, gate)
    return {d: m for d, m, _ in pairs}
